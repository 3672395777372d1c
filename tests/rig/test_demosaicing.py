"""Where demosaicing puts what a colour camera sees: pylon's by half a pixel elsewhere, OpenCV's nowhere."""

import cv2
import numpy as np
import pytest

pylon = pytest.importorskip("pypylon.pylon", reason="pypylon is not installed (extra: rig)")
HEIGHT, WIDTH = 240, 320
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(float)


def raw(center: tuple[float, float]) -> np.ndarray:
    """A grey disc, soft by 2 px, as a colour camera reads it out: a grey thing is as bright in all colours."""
    depth = 60 - np.hypot(COLUMNS - center[0], ROWS - center[1])
    return np.round(40 + 160 * np.clip(0.5 + depth / 2, 0, 1)).astype(np.uint8)


def centroid(grey: np.ndarray) -> np.ndarray:
    weights = grey.astype(float)[4:-4, 4:-4] - 40  # the rim of the picture has no neighbours
    return np.array([(weights * COLUMNS[4:-4, 4:-4]).sum(), (weights * ROWS[4:-4, 4:-4]).sum()]) / weights.sum()


def by_pylon(mosaic: np.ndarray) -> np.ndarray:
    image, converter = pylon.PylonImage(), pylon.ImageFormatConverter()
    image.AttachArray(np.ascontiguousarray(mosaic), pylon.PixelType_BayerRG8)
    converter.OutputPixelFormat = pylon.PixelType_Mono8
    return np.asarray(converter.Convert(image).GetArray())


def by_opencv(mosaic: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2GRAY))


@pytest.mark.parametrize(("demosaiced", "shift"), [(by_pylon, -0.5), (by_opencv, 0.0)])
def test_demosaicing_shifts_the_picture(demosaiced: object, shift: float) -> None:
    assert callable(demosaiced)
    for center in ((160.0, 120.0), (160.3, 119.6), (159.5, 120.5)):
        np.testing.assert_allclose(centroid(demosaiced(raw(center))) - center, shift, atol=0.02)
