"""Pictures of several cameras: which of them are of one moment, read side by side, and the rows of moments.

A folder has one folder a camera, named as the rig's file names them, and pictures of one name are of one moment. In a
capture manifest the name of a picture without its camera's is that of the moment: `images/0007_left.png` and
`images/0007_right.png` are `images/0007.png`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpose.camera import LINEAR, CameraRig
from torchpose.errors import ConfigError
from torchpose.io.estimates import Estimation, digest
from torchpose.io.manifest import read_manifest
from torchpose.io.reader import Batch, FrameReader
from torchpose.io.rows import DETECTION_SCHEMA, POSE_SCHEMA, Row, Schema, detection_rows, fault_row, finite
from torchpose.io.sources import FRAME_SUFFIXES, MANIFEST_SUFFIX, Source, find_sources, natural_key
from torchpose.io.store import ResultStore, Stamp
from torchpose.pipeline import PoseEstimator
from torchpose.results import Poses, Status

RIG_SCHEMA: Schema = {
    "cameras": int,
    "consistency": float,
    "consistency_p": float,
    "odd_camera": str,
    "shares": list,
}
"""Further columns of several cameras.

How many of them contribute; chi-squared of what they say against each other over its degrees of freedom, and how likely
one as large is by chance; the camera that contradicts all others, where that is clear; and of every camera its name and
share of the information about the pose.
"""
RIG_DETECTION_SCHEMA: Schema = DETECTION_SCHEMA | {"camera": str}
"""One row a marker and camera; `frame` is the moment."""
_APART = 1e-3  # s (convention): pictures of one moment that lie farther apart are told
Paint = Callable[[Sequence[Tensor], Tensor, Poses, list[str]], None]
"""Is given the frames of every camera, which of them are pictures, the poses and the names of moments."""
_TELL = 1e15  # of times in ns: so many digits of each are told apart


class MomentStore(ResultStore):
    """The rows of moments, and the markers of all their pictures."""

    marks = RIG_DETECTION_SCHEMA


@dataclass(frozen=True)
class Moment:
    """The pictures of one moment: its name, and of each camera of the rig the picture or None."""

    name: str
    sources: tuple[Source | None, ...]

    @property
    def first(self) -> Source:
        """A picture of it, that of a camera with a robot pose if there is one, under the name of the moment."""
        there = [source for source in self.sources if source is not None]
        best = next((source for source in there if source.robot_pose is not None), there[0])
        return replace(best, name=self.name)

    @property
    def stamp(self) -> Stamp | None:
        """Changes when any of the pictures does, or one comes or goes."""
        stamps = [None if source is None else source.stamp() for source in self.sources]
        known = [(k, stamp) for k, stamp in enumerate(stamps, 1) if stamp is not None]
        if not known:
            return None
        return [sum(stamp[0] for _, stamp in known), int(sum(k * (stamp[1] % _TELL) for k, stamp in known))]


def find_moments(given: Path, rig: CameraRig, tell: Callable[[str], None] = lambda line: None) -> list[Moment]:
    """The moments of a folder with one folder a camera, or of a capture manifest, in natural order.

    Args:
        given: the folder or manifest.
        rig: which names the cameras.
        tell: is given a line for what is passed over.

    Raises:
        ConfigError: there is no picture of any camera.
    """
    of_camera = _in_manifest if given.suffix.lower() == MANIFEST_SUFFIX else _in_folders
    pictures = of_camera(given, rig, tell)
    names = sorted({name for one in pictures for name in one}, key=natural_key)
    if sum(map(bool, pictures)) > 1 and sum(map(len, pictures)) == len(names):
        first, second = [next(iter(one)) for one in pictures if one][:2]
        tell(
            f"{given}: no two cameras have a picture of one name ({first}, {second}), so every row is that of one "
            "camera alone; give pictures of one moment the same name, its ending included"
        )
    return [Moment(name, tuple(one.get(name) for one in pictures)) for name in names]


def _in_folders(given: Path, rig: CameraRig, tell: Callable[[str], None]) -> list[dict[str, Source]]:
    """Pictures by name, of every camera."""
    if not given.is_dir():
        raise ConfigError(f"{given}: INPUT: is no folder; give one with a folder a camera, or a capture manifest")
    missing = [name for name in rig.names if not (given / name).is_dir()]
    if len(missing) == len(rig):
        raise ConfigError(
            f"{given}: INPUT: has none of the folders {', '.join(rig.names)}; name them as the cameras of --cameras"
        )
    if missing:
        tell(f"{given}: has no folder {', '.join(missing)}: these cameras contribute nothing")
    other = sorted(p.name for p in given.iterdir() if p.is_dir() and p.name not in rig.names and p.name[0] != ".")
    loose = sum(p.suffix.lower() in FRAME_SUFFIXES and p.is_file() for p in given.iterdir())
    if other:
        tell(f"{given}: passed over {', '.join(other)}, which --cameras does not name")
    if loose:
        tell(f"{given}: passed over {loose} pictures that lie in no folder of a camera")
    folders = [given / name for name in rig.names]
    return [{s.name: s for s in find_sources([f], tell)} if f.is_dir() else {} for f in folders]


def _in_manifest(given: Path, rig: CameraRig, tell: Callable[[str], None]) -> list[dict[str, Source]]:
    root, pictures = given.parent.resolve(), []
    known = {name for name in rig.names if _has_camera(given, name)}
    times: dict[str, list[float]] = {}
    if not known:
        raise ConfigError(f"{given}: INPUT: has no frame of the cameras {', '.join(rig.names)}; name them alike")
    for name in rig.names:
        own: dict[str, Source] = {}
        for frame in read_manifest(given, name) if name in known else []:
            moment = _without(frame.image, name)
            if moment in own:
                raise ConfigError(
                    f"{given}: INPUT: {own[moment].path} and {frame.image} of camera {name} are both of moment "
                    f"{moment}; give them names that differ beside the camera's"
                )
            own[moment] = Source(moment, given.parent / frame.image, root, frame.robot_pose)
            if frame.trigger_time_s is not None:
                times.setdefault(moment, []).append(frame.trigger_time_s)
        pictures.append(own)
    if len(known) < len(rig):
        tell(f"{given}: has no frame of {', '.join(n for n in rig.names if n not in known)}, which contribute nothing")
    if line := _apart(times):
        tell(f"{given}: {line}")
    return pictures


def _apart(times: Mapping[str, list[float]]) -> str:
    """Tells of moments whose pictures were not taken at one time; empty where all were."""
    spans = {moment: max(of) - min(of) for moment, of in times.items()}
    late = [moment for moment, span in spans.items() if span > _APART]
    if not late:
        return ""
    worst = max(late, key=spans.__getitem__)
    return (
        f"pictures of {len(late)} of {len(spans)} moments were triggered up to {1e3 * spans[worst]:.3g} ms apart "
        f"({worst}): one pose is right only where the target was at rest"
    )


def _has_camera(given: Path, name: str) -> bool:
    try:
        return bool(read_manifest(given, name))
    except ConfigError as error:
        if "has no frame of camera" in str(error):
            return False
        raise


def _without(image: str, camera: str) -> str:
    """The name of a picture without its camera's: a folder of that name, or the end or beginning of its own."""
    *folders, file = image.split("/")
    stem, dot, suffix = file.rpartition(".")
    stem = stem.removesuffix(f"_{camera}").removeprefix(f"{camera}_")
    return "/".join([*(folder for folder in folders if folder != camera), f"{stem}{dot}{suffix}"])


@dataclass(frozen=True)
class Pictures:
    """The pictures of some moments, decoded.

    Attributes:
        moments: these B.
        frames: of each camera (B, H, W), where it has any.
        seen: (C, B) bool, which of them are pictures.
        faults: what could not be used: moment, camera and why.
    """

    moments: Sequence[Moment]
    frames: list[Tensor]
    seen: Tensor
    faults: list[tuple[int, int, Status, str]]


@dataclass(frozen=True)
class MomentReader:
    """Iterates over `Pictures`: one reader a camera, side by side."""

    batches: Sequence[Sequence[Moment]]
    rig: CameraRig
    threads: int = field(kw_only=True)

    def __iter__(self) -> Iterator[Pictures]:
        readers = []
        for number, camera in enumerate(self.rig.cameras):
            own = [[s for m in batch if (s := m.sources[number]) is not None] for batch in self.batches]
            reader = FrameReader(own, camera.width, camera.height, threads=self.threads, tone=camera.tone or LINEAR)
            readers.append(iter(reader))
        for moments in self.batches:
            yield self._joined(moments, [next(reader) for reader in readers])

    def _joined(self, moments: Sequence[Moment], batches: list[Batch]) -> Pictures:
        seen = torch.zeros(len(self.rig), len(moments), dtype=torch.bool)
        frames, faults = [], []
        for number, (camera, batch) in enumerate(zip(self.rig.cameras, batches, strict=True)):
            there = [k for k, moment in enumerate(moments) if moment.sources[number] is not None]
            faults += [(there[k], number, fault.status, fault.reason) for k, fault in batch.faults.items()]
            groups = [([there[k] for k in positions], values) for positions, values in batch.groups]
            for positions, _ in groups:
                seen[number, positions] = True
            frames.append(_laid_out(groups, (len(moments), camera.height, camera.width)))
        return Pictures(moments, frames, seen, faults)


def _laid_out(groups: list[tuple[list[int], Tensor]], shape: tuple[int, int, int]) -> Tensor:
    """The frames of a camera in one tensor; those of another depth beside deeper ones are brought to that."""
    if len(groups) == 1 and len(groups[0][0]) == shape[0]:
        return groups[0][1]
    deep = any(values.dtype == torch.uint16 for _, values in groups)
    out = torch.zeros(shape, dtype=torch.uint16 if deep else torch.uint8)
    for positions, values in groups:
        if deep and values.dtype == torch.uint8:
            values = (values.int() * 257).to(torch.uint16)  # white to white
        for k, position in enumerate(positions):
            out[position] = values[k]
    return out


@dataclass(frozen=True)
class RigEstimation:
    """What the rows of a run with several cameras depend on: the cameras, and the rest as with one."""

    rig: CameraRig
    rest: Estimation

    @property
    def schema(self) -> Schema:
        """Columns of the rows; those of cameras stand before those of the hand-eye calibration."""
        more = {name: kind for name, kind in self.rest.schema.items() if name not in POSE_SCHEMA}
        return POSE_SCHEMA | RIG_SCHEMA | more

    def origin(self, roots: Sequence[str], *, detections: bool) -> dict[str, Any]:
        """As `Estimation.origin`."""
        cameras = [digest(camera) for camera in self.rig.cameras]
        places = digest(replace(self.rig, cameras=self.rig.cameras[:1] * len(self.rig)))
        base = self.rest.origin(roots, detections=detections)
        return {"--cameras": [cameras, places], **{name: value for name, value in base.items() if name != "--camera"}}

    def estimator(self) -> PoseEstimator:
        """Of linear frames: the reader hands on such ones."""
        linear = [replace(camera, tone=None) for camera in self.rig.cameras]
        method: Any = self.rest.method  # it checks
        rig = CameraRig(linear, self.rig.R, self.rig.t, self.rig.covariance, self.rig.names)
        return PoseEstimator(rig, self.rest.targets, method=method)

    def records(self, pictures: Pictures, estimator: PoseEstimator, paint: Paint | None = None) -> list[Row]:
        """Rows and detections of every moment, see `ResultStore.append`."""
        moments = pictures.moments
        records: dict[str, Row] = {m.name: {"frame": m.name, "rows": [], "detections": []} for m in moments}
        usable = pictures.seen.any(0)
        for number in (~usable).nonzero()[:, 0].tolist():
            why = [(status, self._why(c, reason)) for k, c, status, reason in pictures.faults if k == number]
            status = Status.UNREADABLE if any(s == Status.UNREADABLE for s, _ in why) else Status.WRONG_SIZE
            name = moments[number].name
            reason = ", ".join(text for _, text in why)
            empty = dict.fromkeys(RIG_SCHEMA) | {"cameras": 0}
            records[name]["rows"] = [fault_row(name, t.name, status, reason) | empty for t in self.rest.rows_of]
        index = usable.nonzero()[:, 0]
        if len(index):
            whole = len(index) == len(moments)
            frames = pictures.frames if whole else [of_camera[index] for of_camera in pictures.frames]
            poses = estimator(frames, pictures.seen[:, index]).cpu()
            sources = [moments[k].first for k in index.tolist()]
            rows = self.rest.rows(poses, sources)
            cells = rig_cells(poses, self.rig.names)
            if len(rows) != len(cells):  # with a reference that has no rows
                keep = [t.name != self.rest.relative_to for t in self.rest.targets]
                cells = [cell for cell, target in zip(cells, poses.target.tolist(), strict=True) if keep[target]]
            for row, cell in zip(rows, cells, strict=True):
                records[row["frame"]]["rows"].append(row | cell)
            for row in self._marks(poses, [source.name for source in sources]):
                records[row["frame"]]["detections"].append(row)
            if paint is not None:
                paint(frames, pictures.seen[:, index], poses, [source.name for source in sources])
        return list(records.values())

    def _marks(self, poses: Poses, names: Sequence[str]) -> list[Row]:
        """Rows of `RIG_DETECTION_SCHEMA`, camera by camera."""
        targets, found = [target.name for target in self.rest.targets], poses.detections
        return [
            row | {"camera": name}
            for number, name in enumerate(self.rig.names)
            for row in detection_rows(found[found.camera == number], names, targets)
        ]

    def _why(self, camera: int, reason: str) -> str:
        return f"{self.rig.names[camera]}: {reason}"


def rig_cells(poses: Poses, names: Sequence[str]) -> list[Row]:
    """Cells of `RIG_SCHEMA` of every pose."""
    assert poses.share is not None
    assert poses.consistency is not None
    assert poses.odd is not None
    chi2, freedom = poses.consistency.unbind(1)
    over = torch.where(freedom > 0, chi2 / freedom, torch.nan)
    by_chance = torch.where(freedom > 0, torch.special.gammaincc(0.5 * freedom.clamp_min(1), 0.5 * chi2), torch.nan)
    shares = [
        [{"camera": name, "share": finite(share) or 0.0} for name, share in zip(names, row, strict=True)]
        for row in poses.share.tolist()
    ]
    return [
        {
            "cameras": cameras,
            "consistency": finite(ratio),
            "consistency_p": finite(chance),
            "odd_camera": names[odd] if odd >= 0 else None,
            "shares": share,
        }
        for cameras, ratio, chance, odd, share in zip(
            poses.cameras.tolist(), over.tolist(), by_chance.tolist(), poses.odd.tolist(), shares, strict=True
        )
    ]


def batches_of(moments: Sequence[Moment], rig: CameraRig, size: int) -> list[Sequence[Moment]]:
    """Moments in runs that need about as much memory as ``size`` frames of the largest camera."""
    largest = max(camera.width * camera.height for camera in rig.cameras)
    several = sum(camera.width * camera.height for camera in rig.cameras) / largest
    step = max(1, int(size / several))
    return [moments[k : k + step] for k in range(0, len(moments), step)]
