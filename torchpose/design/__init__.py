"""Target design: from camera, working volume and accuracy to a target, its predicted precision and a print sheet."""

from torchpose.design.precision import (
    Need,
    Precision,
    PrecisionMap,
    precision_map,
    predict_volume,
    share_that_counts,
    surroundings,
)
from torchpose.design.predict import (
    Imaging,
    best_focus,
    deviations,
    edge_covariance,
    predicted_covariance,
    sharp_range,
)
from torchpose.design.printing import MEASURING_VIEWS, PRINTS, PrintClass, measured, print_of, scale_deviation
from torchpose.design.search import Design, design_target
from torchpose.design.sheet import Sheet, make_sheet, plate_around
from torchpose.design.tiles import PAPERS, save_tiles, tile_sheet
from torchpose.design.volume import WorkingVolume

__all__ = [
    "MEASURING_VIEWS",
    "PAPERS",
    "PRINTS",
    "Design",
    "Imaging",
    "Need",
    "Precision",
    "PrecisionMap",
    "PrintClass",
    "Sheet",
    "WorkingVolume",
    "best_focus",
    "design_target",
    "deviations",
    "edge_covariance",
    "make_sheet",
    "measured",
    "plate_around",
    "precision_map",
    "predict_volume",
    "predicted_covariance",
    "print_of",
    "save_tiles",
    "scale_deviation",
    "share_that_counts",
    "sharp_range",
    "surroundings",
    "tile_sheet",
]
