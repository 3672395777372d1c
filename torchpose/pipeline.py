"""PoseEstimator: frames in, poses out. The only file that knows the order of the stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchpose.camera import Camera
from torchpose.detect import find_candidates
from torchpose.errors import ConfigError, FrameError
from torchpose.identify import Identified, MarkerTable, crossed_out, identify, look_again
from torchpose.pose import (
    MIN_MARKERS,
    Evidence,
    Solutions,
    center_rms,
    common_center,
    compensate,
    gather_evidence,
    intrinsics_covariance,
    outcome,
    solve_poses,
)
from torchpose.refine import decide, decide_on_grey, refine_centers, refine_edges, refine_photometric
from torchpose.results import Poses, Reason, Status
from torchpose.rings import Rings, measure_rings
from torchpose.target import Target

_FRAME_TYPES = (torch.uint8, torch.uint16, torch.float16, torch.bfloat16, torch.float32, torch.float64)
Method = Literal["photometric", "edges", "centers", "paper"]
_LEAST_KEPT = 0.5  # of the pixels around the edges that must follow the model for a refinement to count


class PoseEstimator(nn.Module):
    """Poses of one or more targets in batches of frames (paper, Algorithm 1).

    Args:
        camera: intrinsics and distortion; frames must have its size.
        target: one target or several; each gets a row for every frame.
        method: "photometric" refines every pose on the grey values around its rings, "edges" on all their edge points;
            "centers" stops at the pose of the centres of their ellipses; "paper" is the paper's chain: Zernike edges as
            read, centres by eq. (7), PnP.
        float_range: grey value of white in floating-point frames: 1.0 or 255.0.
        srgb: the grey values are sRGB-encoded and are taken back to linear ones first. Edges are half-way in linear
            grey, so encoded frames that are taken as linear ones shift them (docs/precision.md).

    Raises:
        ConfigError: no target, or two of one name; an unknown method.
    """

    def __init__(
        self,
        camera: Camera,
        target: Target | Sequence[Target],
        *,
        method: Method = "photometric",
        float_range: float = 1.0,
        srgb: bool = False,
    ) -> None:
        super().__init__()
        self.camera = camera
        self.targets = (target,) if isinstance(target, Target) else tuple(target)
        if not self.targets:
            raise ConfigError("target: none given; pass at least one Target")
        names = [t.name for t in self.targets]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ConfigError(f"target: name {twice[0]!r} given twice; rename one, rows are told apart by it")
        if not float_range > 0:
            raise ConfigError(f"float_range: {float_range} is not positive; use 1.0 or 255.0")
        if method not in get_args(Method):
            raise ConfigError(f"method: {method!r} is not known; choose one of {', '.join(get_args(Method))}")
        self.method = method
        self.float_range = float_range
        self.srgb = srgb
        self._table = MarkerTable.of(self.targets)

    def extra_repr(self) -> str:
        names = ", ".join(t.name for t in self.targets)
        return f"camera={self.camera.width}x{self.camera.height}, targets=[{names}]"

    @torch.no_grad()
    def forward(self, frames: Tensor) -> Poses:
        """Poses of every target in every frame.

        Args:
            frames: (B, H, W) or (B, 1, H, W) grey; uint8, uint16, or floating point with white at ``float_range``.

        Returns:
            B * T rows, frame-major, on the device of the frames.

        Raises:
            FrameError: wrong shape, size or dtype.
        """
        frames = self._checked(frames)
        table = self._table.to(frames.device)
        camera = self.camera.to(frames.device)
        batch, count = frames.shape[0], len(self.targets)
        candidates = find_candidates(frames)
        candidates = candidates[torch.isin(candidates.polarity, table.polarity)]
        rings = measure_rings(frames, candidates, camera, correct=self.method != "paper")
        identified = identify(rings, table, camera, batch)
        target = torch.arange(batch * count, device=frames.device) % count
        evidence, solvable, solutions = self._solved(rings, identified, table, target, camera)
        before = len(rings)
        rings, identified = self._second_look(frames, rings, identified, table, camera, solvable, solutions)
        if len(rings) > before:
            evidence, solvable, solutions = self._solved(rings, identified, table, target, camera)
        solutions = self._doubted(solutions, evidence[solvable], solvable // count, rings, table, target[solvable])
        if self.method != "paper":
            solutions = decide(solutions, evidence[solvable])
        shapes = _raw_ellipses(rings, identified.ring[solvable])
        if self.method == "photometric":
            solutions = decide_on_grey(solutions, evidence[solvable], frames, camera, solvable // count, shapes)
        refined = self.method in ("photometric", "edges")
        if refined:
            solutions = self._refined(
                frames,
                solutions,
                evidence[solvable],
                solvable // count,
                rings,
                identified.ring[solvable],
                shapes,
                camera,
            )
        elif self.method == "centers":
            solutions = _on_centers(solutions, evidence[solvable])
        if camera.covariance is not None:
            wider = intrinsics_covariance(evidence[solvable], solutions, camera, refined=refined)
            solutions = replace(solutions, covariance=solutions.covariance + wider)
        return outcome(target, solvable, solutions, evidence, identified, rings, table, camera)

    def _checked(self, frames: Tensor) -> Tensor:
        if frames.ndim == 4 and frames.shape[1] == 1:
            frames = frames[:, 0]
        if frames.ndim != 3:
            raise FrameError(f"frames: shape {tuple(frames.shape)}; pass grey frames (B, H, W) or (B, 1, H, W)")
        if frames.dtype not in _FRAME_TYPES:
            raise FrameError(f"frames: dtype {frames.dtype}; pass uint8, uint16 or floating point")
        size = (self.camera.height, self.camera.width)
        if tuple(frames.shape[1:]) != size:
            got, need = f"{frames.shape[2]} x {frames.shape[1]}", f"{size[1]} x {size[0]}"
            raise FrameError(f"frames: size {got}, but the camera has {need}; use the camera file of these frames")
        if self.srgb:
            frames = _linear(frames, self.float_range)
        elif frames.is_floating_point():
            # the detector's least contrast counts in 1/255 of white
            frames = frames.float() * (255.0 / self.float_range)
        return frames.contiguous()

    def _solved(
        self, rings: Rings, identified: Identified, table: MarkerTable, target: Tensor, camera: Camera
    ) -> tuple[Evidence, Tensor, Solutions]:
        """Evidence of every row, which rows (S,) have enough of it, and the solutions of these."""
        evidence = self._evidence(rings, identified, table, target, camera)
        solvable = (evidence.mask.sum(-1) >= MIN_MARKERS).nonzero()[:, 0]
        rough = identified.R[solvable], identified.t[solvable]
        return evidence, solvable, solve_poses(evidence[solvable], rough)

    def _second_look(
        self,
        frames: Tensor,
        rings: Rings,
        identified: Identified,
        table: MarkerTable,
        camera: Camera,
        solvable: Tensor,
        s: Solutions,
    ) -> tuple[Rings, Identified]:
        """Looks for missing markers where the solutions put them, or the rough pose where there is none."""
        solved = s.status != Status.REJECTED
        index = solvable[solved]
        seen = (identified.ring >= 0).index_copy(0, index, s.mask[solved])
        nowhere = torch.full_like(identified.R, torch.nan), torch.full_like(identified.t, torch.nan)
        R, t = (torch.stack(v, 1) for v in zip((identified.R, identified.t), nowhere, strict=True))
        twofold = (s.status[solved] == Status.AMBIGUOUS)[:, None]
        alternative = torch.where(twofold[..., None], s.R_alt[solved], torch.nan)
        R = R.index_copy(0, index, torch.stack([s.R[solved], alternative], 1))
        t = t.index_copy(0, index, torch.stack([s.t[solved], s.t_alt[solved]], 1))
        return look_again(frames, rings, identified, table, camera, seen, R, t, correct=self.method != "paper")

    def _evidence(
        self, rings: Rings, identified: Identified, table: MarkerTable, target: Tensor, camera: Camera
    ) -> Evidence:
        ring, mask = identified.ring, identified.ring >= 0
        row, marker = mask.nonzero().unbind(-1)
        radii = table.radii[target]
        index = ring[row, marker]
        locate = compensate if self.method == "paper" else common_center
        center, covariance = locate(rings.outer[index], rings.inner[index], radii[row, marker])
        centers = torch.full((*ring.shape, 2), torch.nan, dtype=torch.float64, device=ring.device)
        covariances = torch.full((*ring.shape, 2, 2), torch.nan, dtype=torch.float64, device=ring.device)
        centers[row, marker], covariances[row, marker] = center, covariance
        return gather_evidence(
            rings,
            ring,
            centers,
            covariances,
            table.centers[target],
            table.normals[target],
            radii,
            table.coplanar[target],
            camera.matrix,
        )

    def _doubted(
        self, s: Solutions, e: Evidence, frame: Tensor, rings: Rings, table: MarkerTable, target: Tensor
    ) -> Solutions:
        """Rejects poses from three markers that put a fourth across a ring: three centres fit many a mix-up."""
        seen = s.mask | ~table.valid[target]
        across = crossed_out(rings, frame, s.R, s.t, e.points, e.radii, seen, self.camera)
        bad = across & (s.mask.sum(-1) == MIN_MARKERS) & (s.status != Status.REJECTED)
        status = torch.where(bad, int(Status.REJECTED), s.status)
        return replace(s, status=status, reason=torch.where(bad, int(Reason.RESIDUAL), s.reason))

    def _refined(
        self,
        frames: Tensor,
        s: Solutions,
        e: Evidence,
        frame: Tensor,
        rings: Rings,
        ring: Tensor,
        shapes: Tensor,
        camera: Camera,
    ) -> Solutions:
        """Solutions whose poses are refined on the frames themselves, where the refinement holds."""
        solved = (s.status != Status.REJECTED).nonzero()[:, 0]
        index = ring[solved].clamp_min(0)
        some = replace(e[solved], mask=s.mask[solved])
        start = (frames, camera, frame[solved], s.R[solved], s.t[solved], some.mask, shapes[solved])
        model = (some.points, some.normals, some.radii)
        if self.method == "edges":
            refined = refine_edges(*start, rings.polarity[index], *model)
        else:
            refined = refine_photometric(*start, *model)
        good = refined.good & (refined.kept > _LEAST_KEPT)
        index = solved[good]
        rms = center_rms(some, refined.R, refined.t)
        return replace(
            s,
            R=s.R.index_copy(0, index, refined.R[good]),
            t=s.t.index_copy(0, index, refined.t[good]),
            covariance=s.covariance.index_copy(0, index, refined.covariance[good]),
            rms=s.rms.index_copy(0, index, rms[good]),
        )


def _on_centers(s: Solutions, e: Evidence) -> Solutions:
    """Solutions refined on the ellipses' own centres, where that holds."""
    r, t, covariance, _, good = refine_centers(replace(e, mask=s.mask), s.R, s.t)
    better = good & (s.status != Status.REJECTED)
    return replace(
        s,
        R=torch.where(better[:, None, None], r, s.R),
        t=torch.where(better[:, None], t, s.t),
        covariance=torch.where(better[:, None, None], covariance, s.covariance),
    )


def _raw_ellipses(rings: Rings, ring: Tensor) -> Tensor:
    """Ellipses (N, M, 2, 5) in raw pixels, outer and inner, of the rings (N, M); anything where it is -1."""
    both = torch.stack([rings.outer_raw, rings.inner_raw], 1)
    return both[ring.clamp_min(0)] if len(rings) else both.new_ones(*ring.shape, 2, 5)


def _linear(frames: Tensor, white: float) -> Tensor:
    """sRGB-encoded frames as linear grey, float32 with white at 255 (IEC 61966-2-1)."""
    if not frames.is_floating_point():
        white = float(torch.iinfo(frames.dtype).max)
    x = (frames.float() / white).nan_to_num(nan=0.0)
    return 255.0 * torch.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055).clamp_min(0).pow(2.4))
