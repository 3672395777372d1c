"""Calibration: intrinsics from views of a target or a board, hand-eye from robot poses, each with its covariance."""

from torchpose.calibration.hand_eye import HandEyeFit, calibrate_hand_eye
from torchpose.calibration.intrinsics import LENS_MODELS, Calibration, calibrate_intrinsics
from torchpose.calibration.views import Views

__all__ = ["LENS_MODELS", "Calibration", "HandEyeFit", "Views", "calibrate_hand_eye", "calibrate_intrinsics"]
