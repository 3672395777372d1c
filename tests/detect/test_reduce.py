"""Area reduction against block means, for every dtype and awkward size."""

from __future__ import annotations

import pytest
import torch

from torchpose.detect import reduce
from torchpose.detect.reduce import REDUCED_PIXELS, area_reduce, reduction_factor


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.int32, torch.float32, torch.float64])
def test_block_means(factor: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(factor)
    frames = torch.randint(0, 256, (3, 31, 42), generator=generator).to(dtype)
    reduced = area_reduce(frames, factor)
    h, w = 31 // factor, 42 // factor
    blocks = frames[:, : h * factor, : w * factor].double().unflatten(1, (h, factor)).unflatten(3, (w, factor))
    assert reduced.dtype == (torch.uint8 if dtype == torch.uint8 else torch.float32)
    assert reduced.shape == (3, h, w)
    # 8 and 16 bit stay integers until they are small, rounded once for each factor of 2
    rounding = {1: 0.0, 2: 0.5, 3: 0.5, 4: 1.0}[factor] if dtype in (torch.uint8, torch.uint16) else 1e-4
    assert (reduced.double() - blocks.mean((2, 4))).abs().max() <= rounding


@pytest.mark.parametrize("factor", [*range(2, 14), 15, 22, 26])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("exact", [False, True])
def test_every_device_rounds_alike(
    factor: int, dtype: torch.dtype, exact: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What other devices do, done on the CPU, is what the CPU does in its own way, to the last bit."""
    generator = torch.Generator().manual_seed(factor)
    size = (2, 7 * factor + 1, 39 * factor + 2)
    if dtype.is_floating_point:
        frames = (255 * torch.rand(size, generator=generator)).to(dtype)
    else:
        frames = torch.randint(0, torch.iinfo(dtype).max + 1, size, generator=generator).to(dtype)
    here = area_reduce(frames, factor, exact=exact)
    monkeypatch.setattr(reduce, "_in_parts", reduce._at_once)
    elsewhere = area_reduce(frames, factor, exact=exact)
    assert here.dtype == elsewhere.dtype
    assert torch.equal(here, elsewhere)


@pytest.mark.parametrize("by", range(3, 10, 2))
def test_16_bit_sums_round_right_through_opencv(by: int) -> None:
    """All sums next to a border between two levels."""
    area = by * by
    border = area * torch.arange(65535) + area // 2
    blocks = torch.stack([border, border + 1]).flatten()[:, None] // area + (
        torch.arange(area) < torch.stack([border, border + 1]).flatten()[:, None] % area
    )
    frames = blocks.unflatten(1, (by, by)).transpose(0, 1).flatten(1)[None].to(torch.uint16)
    expected = torch.stack([torch.arange(65535), torch.arange(1, 65536)]).flatten()
    assert torch.equal(area_reduce(frames, by).flatten().long(), expected)


def test_16_bit_range() -> None:
    frames = torch.tensor([[[65535, 65535, 0, 1], [65535, 65535, 2, 3]]]).to(torch.uint16)
    torch.testing.assert_close(area_reduce(frames, 2), torch.tensor([[[65535.0, 2.0]]]))


def test_frames_do_not_mix() -> None:
    frames = torch.randint(0, 256, (4, 30, 41), dtype=torch.uint8)
    for k in range(4):
        torch.testing.assert_close(area_reduce(frames[k : k + 1], 4)[0], area_reduce(frames, 4)[k], rtol=0, atol=0)


def test_strided_frames() -> None:
    wide = torch.randint(0, 256, (2, 24, 60), dtype=torch.uint8)
    torch.testing.assert_close(area_reduce(wide[:, :, 7:47], 4), area_reduce(wide[:, :, 7:47].contiguous(), 4))


@pytest.mark.parametrize("shape", [(0, 20, 30), (2, 0, 30), (2, 3, 30), (2, 30, 1), (2, 0, 0)])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_nothing_left(shape: tuple[int, int, int], dtype: torch.dtype) -> None:
    assert area_reduce(torch.zeros(shape, dtype=dtype), 4).shape == (shape[0], shape[1] // 4, shape[2] // 4)


@pytest.mark.parametrize(("size", "factor"), [((3648, 5472), 4), ((2048, 2448), 2), ((1216, 1824), 2), ((480, 640), 1)])
def test_automatic_factor(size: tuple[int, int], factor: int) -> None:
    assert reduction_factor(*size) == factor
    assert (size[0] // factor) * (size[1] // factor) <= REDUCED_PIXELS
