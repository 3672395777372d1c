"""``torchpose estimate``: frames in, one row a frame and target out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from torchpose.cli.common import INTERRUPTED, check_outputs, cores, report_unreadable
from torchpose.errors import ConfigError

if TYPE_CHECKING:  # imported where they are used: torch takes more than a second, which --help need not wait for
    from torchpose.camera import Camera
    from torchpose.handeye import HandEye
    from torchpose.io.reader import Batch
    from torchpose.io.rows import Row
    from torchpose.io.sources import Source
    from torchpose.pipeline import PoseEstimator
    from torchpose.report.overlay import Overlay
    from torchpose.results import Poses
    from torchpose.target import Target


EPILOG = """
Examples:

`torchpose estimate frames/ --camera camera.yaml --target quad40 --out poses.csv`

`torchpose estimate a.png b.tif --camera rig.yaml#cam1 --target left.yaml --target right.yaml --out poses.parquet`

`torchpose estimate run/manifest.jsonl --camera camera.yaml --target quad40 --hand-eye handeye.yaml --out poses.jsonl`

Exit codes: 0 every frame was processed, whatever its status; 1 a frame could not be read; 2 a usage or configuration
error; 130 interrupted (go on with `--resume`).
"""


def estimate(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT...",
            help="Image files (PNG, TIFF, BMP, JPEG, PGM; 8 or 16 bit, grey or colour), folders of them, searched "
            "recursively and taken in natural order, or capture manifests (.jsonl).",
        ),
    ],
    camera: Annotated[
        str,
        typer.Option(
            help="Camera file: OpenCV YAML or JSON, ROS camera_info, Kalibr camchain, COLMAP cameras.txt. "
            "FILE#cam1 or FILE#2 picks one of several."
        ),
    ],
    target: Annotated[list[str], typer.Option(help="Target file or name of a built-in target; repeat for several.")],
    out: Annotated[Path, typer.Option(help="Table of the poses: .csv, .jsonl or .parquet.")],
    detections: Annotated[
        Path | None, typer.Option(help="Table of the markers found: .csv, .jsonl or .parquet.")
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for pictures of what was found, one a frame.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the frames that an earlier run finished and do the rest.")
    ] = False,
    hand_eye: Annotated[
        Path | None,
        typer.Option(help="Calibrated camera-to-base or camera-to-tool transform; adds the poses in the robot base."),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            metavar="photometric|edges|centers|paper",
            help="Last stage: grey values, edge points, ring centres, or the paper's own chain.",
        ),
    ] = "photometric",
    srgb: Annotated[bool, typer.Option("--srgb", help="The frames are sRGB-encoded: linearise them first.")] = False,
    batch: Annotated[int | None, typer.Option(min=1, help="Frames at once; by default chosen by their size.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads to use; by default one a core.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar and no summary.")] = False,
) -> int:
    """Measure the pose of ring targets in every frame, with its uncertainty.

    One row a frame and target: status, translation in mm, rotation vector in rad (target to camera), their standard
    deviations, reprojection RMS in px, number of markers.
    """
    from torchpose.camera import Camera
    from torchpose.cli.terminal import native_stderr_silenced
    from torchpose.io.sources import find_sources
    from torchpose.io.writers import check_table_path
    from torchpose.target import Target

    for path, option in ((out, "--out"), (detections, "--detections")):
        if path is not None:
            check_table_path(path, option)
    camera_model = Camera.load(camera)
    targets = [Target.load(name) for name in target]
    sources = find_sources(inputs)
    calibration = _load_hand_eye(hand_eye, sources)
    check_outputs(inputs, sources, [p for p in (out, detections) if p is not None], overlay)
    with native_stderr_silenced():
        return _run(
            camera_model,
            targets,
            sources,
            out,
            detections=detections,
            overlay=overlay,
            resume=resume,
            hand_eye=calibration,
            method=method,
            srgb=srgb,
            batch=batch,
            threads=threads or cores(),
            quiet=quiet,
        )


def _run(
    camera: Camera,
    targets: list[Target],
    sources: list[Source],
    out: Path,
    *,
    detections: Path | None,
    overlay: Path | None,
    resume: bool,
    hand_eye: HandEye | None,
    method: str,
    srgb: bool,
    batch: int | None,
    threads: int,
    quiet: bool,
) -> int:
    """Estimates what is not done yet and writes the tables; returns the exit code."""
    import cv2
    import torch

    from torchpose.cli.terminal import FrameProgress
    from torchpose.io.reader import FrameReader, default_batch, in_batches
    from torchpose.io.rows import BASE_SCHEMA, POSE_SCHEMA
    from torchpose.io.store import ResultStore
    from torchpose.pipeline import PoseEstimator
    from torchpose.report.overlay import Overlay

    cv2.setNumThreads(1)  # frames are decoded side by side; threads inside of one would only compete
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # decoding is the larger part of the work; torch's threads wait actively and would take its cores away
    torch.set_num_threads(max(1, threads // 2))
    estimator = PoseEstimator(camera, targets, method=method, srgb=srgb)  # type: ignore[arg-type]  # it checks
    painter = None if overlay is None else Overlay(camera, targets, overlay, threads=threads)
    store = ResultStore(
        out,
        detections,
        schema=POSE_SCHEMA | (BASE_SCHEMA if hand_eye else {}),
        targets=len(targets),
        origin=_origin(camera, targets, sources, hand_eye, method, srgb, detections is not None),
        resume=resume,
    )
    # a resumed run works on the same batches as one that was not interrupted, so that rows agree to the last bit
    batches = in_batches(sources, batch or default_batch(camera.width, camera.height))
    pending = [one for one in batches if any(source.name not in store for source in one)]
    reader = FrameReader(pending, camera.width, camera.height, threads=threads)
    try:
        with FrameProgress(len(sources), len(store), quiet=quiet) as progress, torch.inference_mode():
            for frames in reader:
                records = _records(frames, estimator, targets, hand_eye, painter)
                new = [record for record in records if record["frame"] not in store]
                store.append(new)
                progress.advance(len(new), store.counts)
        store.finish([source.name for source in sources])
    except KeyboardInterrupt:
        kept = f"{len(store)} of {len(sources)} frames are kept"
        typer.echo(f"torchpose: error: interrupted: {kept}; add --resume to go on", err=True)
        return INTERRUPTED
    finally:
        store.close()
    progress.summary(store.counts, out)
    if store.unreadable:
        report_unreadable(store.unreadable)
        return 1
    return 0


def _records(
    batch: Batch,
    estimator: PoseEstimator,
    targets: list[Target],
    hand_eye: HandEye | None,
    painter: Overlay | None,
) -> list[Row]:
    """Rows and detections of every frame of a batch, see `ResultStore.append`."""
    from torchpose.io.rows import detection_rows, fault_row, pose_rows

    names = [target.name for target in targets]
    records: list[Row] = [{"frame": source.name, "rows": [], "detections": []} for source in batch.sources]
    for position, fault in batch.faults.items():
        frame = batch.sources[position].name
        records[position]["rows"] = [fault_row(frame, name, fault.status, fault.reason) for name in names]
    by_name = {record["frame"]: record for record in records}
    for positions, frames in batch.groups:
        sources = [batch.sources[position] for position in positions]
        frame_names = [source.name for source in sources]
        poses = estimator(frames).cpu()
        if painter is not None:
            painter.write(frames, poses, frame_names)
        given = _of_parts(poses, targets)
        rows = pose_rows(given, frame_names, names)
        if hand_eye is not None:
            _add_base_cells(rows, given, sources, hand_eye)
        for row in rows:
            by_name[row["frame"]]["rows"].append(row)
        for row in detection_rows(poses.detections, frame_names, names):
            by_name[row["frame"]]["detections"].append(row)
    return records


def _of_parts(poses: Poses, targets: list[Target]) -> Poses:
    """Poses of the parts, for the targets that say where their part is."""
    import torch

    parts = [target.part_from_target for target in targets]
    if not any(parts):
        return poses
    still = (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    rotation, translation = (torch.stack(tensors) for tensors in zip(*(part or still for part in parts), strict=True))
    return poses.moved(rotation[poses.target], translation[poses.target])


def _add_base_cells(rows: list[Row], poses: Poses, sources: Sequence[Source], hand_eye: HandEye) -> None:
    """Adds the poses in the robot base; cells stay empty where a camera on the tool has no robot pose."""
    from dataclasses import replace

    import torch

    from torchpose.geometry import rotations
    from torchpose.io.rows import base_cells

    robot = None
    if hand_eye.mount == "tool":
        unknown = (float("nan"),) * 6
        tool = torch.tensor([source.robot_pose or unknown for source in sources], dtype=torch.float64)[poses.frame]
        robot = (rotations.exp(tool[:, 3:]), tool[:, :3])
    based = poses.seen_from(*hand_eye.base_from_camera(robot))
    based = replace(based, covariance=based.covariance + hand_eye.base_covariance(based.t, robot))
    cells = base_cells(based)
    for row, extra in zip(rows, cells, strict=True):
        row.update(extra)


def _load_hand_eye(path: Path | None, sources: Sequence[Source]) -> HandEye | None:
    if path is None:
        return None
    from torchpose.handeye import HandEye

    hand_eye = HandEye.load(path)
    without = [source for source in sources if source.robot_pose is None]
    if hand_eye.mount == "tool" and without:
        raise ConfigError(
            f"{without[0].path}: robot_pose: missing for {len(without)} of {len(sources)} frames, but the camera of "
            f"{path} is on the tool; give a capture manifest with robot poses as INPUT"
        )
    return hand_eye


def _origin(
    camera: Camera,
    targets: Sequence[Target],
    sources: Sequence[Source],
    hand_eye: HandEye | None,
    method: str,
    srgb: bool,
    detections: bool,
) -> dict[str, Any]:
    """What the rows depend on, for `ResultStore`. Names are those that its error messages shall say."""
    from importlib.metadata import version

    return {
        "torchpose version": version("torchpose"),
        "--camera": _digest(camera),
        "--target": [[target.name, _digest(target)] for target in targets],
        "--hand-eye": None if hand_eye is None else _digest(hand_eye),
        "--method": method,
        "--srgb": srgb,
        "--detections": detections,
        "INPUT": sorted({str(source.root) for source in sources}),
    }


def _digest(model: Any) -> str:
    """SHA-256 of the values of a dataclass: the same for the same numbers, however the file is laid out."""
    import hashlib
    from dataclasses import fields

    values = [(field.name, getattr(model, field.name)) for field in fields(model) if field.name != "source"]
    plain = [(name, value.tolist() if hasattr(value, "tolist") else value) for name, value in values]
    return hashlib.sha256(repr(plain).encode()).hexdigest()
