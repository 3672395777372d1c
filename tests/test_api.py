"""The public surface: a name added or lost here is a decision, not an accident."""

from __future__ import annotations

import inspect

import torchpose as tp

PUBLIC = [
    "ArgumentError", "Camera", "CameraRig", "ConfigError", "Detections", "FrameError", "HandEye", "Misfit",
    "Motions", "PoseEstimator", "Poses", "Reason", "Status", "Target", "TorchposeError", "Tracker", "analysis",
    "calibration", "centers", "design", "detect", "ellipse", "pnp", "sim", "zernike",
]  # fmt: skip


def test_surface() -> None:
    assert sorted(tp.__all__) == PUBLIC
    for name in PUBLIC:
        assert inspect.getdoc(getattr(tp, name)), f"{name} has no docstring"


def test_contract_of_the_names_outside_checks_use() -> None:
    assert [s.name.lower() for s in tp.Status] == [
        "ok", "no_target", "too_few_markers", "ambiguous", "rejected", "unreadable", "wrong_size",
    ]  # fmt: skip
    assert list(inspect.signature(tp.ellipse.fit).parameters)[:3] == ["points", "index", "count"]
    assert list(inspect.signature(tp.pnp.solve).parameters)[:3] == ["object_points", "image_points", "camera"]
    assert list(inspect.signature(tp.PoseEstimator).parameters)[:2] == ["camera", "target"]
    assert {"R", "t", "covariance", "rms", "status"} <= set(tp.Poses.__dataclass_fields__)
