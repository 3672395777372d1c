"""Stage: one pose a target and frame from its identified markers, with covariance and status."""

from torchpose.pose.boards import right_way_round, still_open
from torchpose.pose.centers import common_center, compensate, raw_centers
from torchpose.pose.copies import best_copies
from torchpose.pose.covariance import pose_covariance
from torchpose.pose.doubt import crossed_out
from torchpose.pose.evidence import CENTER_RMS, SHAPE_FLOOR, Evidence, center_rms, gather_evidence, shape_chi2
from torchpose.pose.outcome import Found, outcome
from torchpose.pose.solutions import AMBIGUOUS_CHI2, PLACE, Solutions
from torchpose.pose.solve import solve_poses
from torchpose.pose.systematic import MarkerNormals, OnPrint, Setting, center_normals, displaced, on_print

__all__ = [
    "AMBIGUOUS_CHI2",
    "CENTER_RMS",
    "PLACE",
    "SHAPE_FLOOR",
    "Evidence",
    "Found",
    "MarkerNormals",
    "OnPrint",
    "Setting",
    "Solutions",
    "best_copies",
    "center_normals",
    "center_rms",
    "common_center",
    "compensate",
    "crossed_out",
    "displaced",
    "gather_evidence",
    "on_print",
    "outcome",
    "pose_covariance",
    "raw_centers",
    "right_way_round",
    "shape_chi2",
    "solve_poses",
    "still_open",
]
