"""The target: coded concentric rings on a part, or equal marks on a grid, and its file."""

from __future__ import annotations

import os
import unicodedata
from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, field_validator
from torch import Tensor

from torchpose.config import format_list, format_number, quoted, read_yaml, validate, within, write_text
from torchpose.config.kinds import Length, Number, RotationVector, Text, check_turn
from torchpose.errors import ConfigError
from torchpose.geometry import rotations
from torchpose.geometry.covariance import covariance_fault
from torchpose.grids import GRID_EXAMPLES, Grid

MIN_RATIO_GAP = 0.05  # smallest difference between the inner/outer ratios of two markers that can be told apart
RATIO_RANGE = (0.15, 0.9)  # inner/outer: a smaller hole or a thinner ring is not readable
MAX_DEVIATION = 1e3  # mm, of a place or edge (convention): far beyond any part, and its square is still a number
MIN_SPREAD = 1e-2  # second / first singular value of the centred marker centres; below, they count as collinear

MOST_MARKERS = 1000  # of a target (convention): their ratios tell a dozen apart
_FROZEN = ConfigDict(extra="forbid", frozen=True)
Vector = Annotated[list[Length], Field(min_length=3, max_length=3)]
Deviation = Annotated[FiniteFloat, Field(ge=0, le=MAX_DEVIATION)]
Deviations = Annotated[
    list[Deviation],
    BeforeValidator(lambda value: [value] * 3 if isinstance(value, int | float) else value),
    Field(min_length=3, max_length=3),
]
"""Of a printed centre along x, y, z, mm; in a file one number may stand for all three."""


class RigidTransformFile(BaseModel):
    """A pose in a file: rotation vector in rad, translation in mm."""

    model_config = _FROZEN
    rotation: RotationVector
    translation: Vector


class _MarkerFile(BaseModel):
    model_config = _FROZEN
    id: Annotated[int, Field(le=2**63 - 1)]
    center: list[Length]
    outer_radius: Length
    inner_radius: Length
    normal: Vector = [0.0, 0.0, 1.0]
    center_sigma: Deviations | None = None

    @field_validator("center")
    @classmethod
    def _in_space(cls, value: list[float]) -> list[float]:
        if len(value) not in (2, 3):
            raise ValueError(f"has {len(value)} entries; give [x, y, z], or [x, y] for z = 0")
        return value if len(value) == 3 else [*value, 0.0]


class _MatrixFile(BaseModel):
    model_config = _FROZEN
    rows: int
    cols: int
    data: list[Number]


class _TargetFile(BaseModel):
    model_config = _FROZEN
    name: str
    units: Literal["mm"]
    background: Literal["light", "dark"]
    markers: Annotated[list[_MarkerFile], Field(max_length=MOST_MARKERS)]
    part_from_target: RigidTransformFile | None = None
    center_sigma: Deviations | None = None
    edge_gain: Length = 0.0
    edge_gain_sigma: Deviation | None = None
    centers_covariance: _MatrixFile | None = None
    scale_sigma: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.0
    adjustment: Text | None = None
    camera_cross_covariance: _MatrixFile | None = None
    board: Text | None = None

    @field_validator("units", mode="before")
    @classmethod
    def _millimetres(cls, value: Any) -> Any:
        if value != "mm":
            raise ValueError(f"is {value!r}; convert all lengths to millimetres and write mm")
        return value


@dataclass(frozen=True, eq=False)
class Target:
    """M concentric-ring markers in the target's frame. Their ids are told apart by (inner/outer)^2, or by their places.

    Attributes:
        name: goes into result tables and file names.
        background: tone around the rings and in their holes; the rings themselves are of the other one.
        ids: (M,) int64, unique, not negative.
        centers: (M, 3) float64, mm.
        normals: (M, 3) float64, unit, perpendicular to each ring and away from whoever sees its printed side: a
            camera with R = I, whose z axis points at the target, sees the default [0, 0, 1].
        radii: (M, 2) float64, outer and inner radius, mm.
        part_rotation: (3,) float64 rotation vector in rad that maps target coordinates to those of the part.
        part_translation: (3,) float64, mm, of the same map; both or neither.
        edge_gain: mm, by which the print moved every edge of dark areas outwards, as far as it is known (dot gain):
            `printed_radii` are those of the circles on the part.
        covariance: (3 M + 1, 3 M + 1) float64, mm^2, of the centres on the part, x, y, z by marker, and last of the
            edge gain; None where the file claims a perfect target.
        scale_sigma: relative standard deviation of the scale of all lengths, places and radii alike, which
            ``covariance`` leaves out.
        adjustment: name of the adjustment that measured the target and a camera together, None where there was none.
        cross_covariance: (3 M + 1, 4 + n) float64, of the same and that camera's fx, fy, cx, cy and distortion; it
            holds for a `Camera` of the same ``adjustment``.
        grid: of a board of equal rings or discs, that are told apart by their places on it: ids are the numbers of its
            marks, row by row, and marks whose numbers are not among them are not on the board. Discs have the inner
            radius 0. None for coded rings.

    Raises:
        ConfigError: duplicate ids, rings that cannot be told apart or read, overlapping markers, fewer than 3 markers,
            (nearly) collinear centres, or another inconsistency; named as in the file.
    """

    name: str
    background: Literal["light", "dark"]
    ids: Tensor
    centers: Tensor
    normals: Tensor
    radii: Tensor
    part_rotation: Tensor | None = None
    part_translation: Tensor | None = None
    edge_gain: float = 0.0
    covariance: Tensor | None = None
    adjustment: str | None = None
    cross_covariance: Tensor | None = None
    scale_sigma: float = 0.0
    grid: Grid | None = None

    def __post_init__(self) -> None:
        _check_name(self.name)
        if self.background not in ("light", "dark"):
            raise ConfigError(f"background: is {self.background!r}; write light or dark")
        m = len(self.ids)
        for field, shape in (("ids", (m,)), ("centers", (m, 3)), ("normals", (m, 3)), ("radii", (m, 2))):
            if getattr(self, field).shape != shape:
                raise ConfigError(f"{field}: has shape {tuple(getattr(self, field).shape)}; give {shape}")
        if (self.part_rotation is None) != (self.part_translation is None):
            raise ConfigError("part_from_target: is half given; give both rotation and translation")
        if self.part_rotation is not None:
            try:
                check_turn(self.part_rotation.tolist())
            except ValueError as error:
                raise ConfigError(f"part_from_target.rotation: {error}") from None
        self._check_markers()
        if self.covariance is not None:
            _check_covariance(self.covariance.detach(), 3 * m + 1)
        if self.cross_covariance is not None:
            _check_cross(self.cross_covariance, 3 * m + 1, self.adjustment)
        printed = self.printed_radii
        if not bool((printed[:, 0] > 0).all() & (self.discs | (printed[:, 1] > 0)).all() & (printed.diff() < 0).all()):
            raise ConfigError(
                f"edge_gain: {self.edge_gain:g} mm leaves a ring without width or hole; give an edge shift in mm"
            )

    def _check_markers(self) -> None:
        ids = self.ids.tolist()
        if len(ids) < 3:
            raise ConfigError(f"markers: {len(ids)} given; a pose needs at least 3")
        for i, marker in enumerate(ids):
            if marker < 0:
                raise ConfigError(f"markers[{i}].id: is {marker}; give an integer from 0")
            if marker in ids[:i]:
                raise ConfigError(f"markers[{i}].id: {marker} is given twice; number the markers differently")
        if not bool(torch.cat([self.centers, self.normals, self.radii], -1).isfinite().all()):
            raise ConfigError("markers: NaN or infinity; write finite numbers")
        for i, (outer, inner) in enumerate(self.radii.tolist()):
            for field, radius in (("outer_radius", outer), ("inner_radius", inner)):
                if radius <= 0 and not (field == "inner_radius" and radius == 0 and self.discs):
                    raise ConfigError(f"markers[{i}].{field}: is {radius:g}; give a positive length in mm")
            if inner >= outer:
                raise ConfigError(
                    f"markers[{i}].inner_radius: {inner:g} is not below the outer {outer:g}; swap or shrink"
                )
            if not self.discs and not RATIO_RANGE[0] - 1e-6 <= inner / outer <= RATIO_RANGE[1] + 1e-6:
                raise ConfigError(
                    f"markers[{i}].inner_radius: inner/outer is {inner / outer:.3g}; "
                    f"rings are readable from {RATIO_RANGE[0]} to {RATIO_RANGE[1]}"
                )
        lengths = self.normals.norm(dim=-1).tolist()
        for i, length in enumerate(lengths):
            if abs(length - 1) > 1e-5:
                raise ConfigError(f"markers[{i}].normal: has length {length:.3g}; give a unit vector")
        ratio, order = (self.radii[:, 1] / self.radii[:, 0]).sort()
        gap, k = ratio.diff().min(0)
        if self.grid is not None:
            _check_board(self.grid, ids)
        elif float(gap) < MIN_RATIO_GAP - 1e-6:
            a, b = sorted((ids[int(order[k])], ids[int(order[k + 1])]))
            raise ConfigError(
                f"markers: ids {a} and {b} cannot be told apart (inner/outer differ by {float(gap):.3g}); "
                f"make them differ by at least {MIN_RATIO_GAP}"
            )
        spread = torch.linalg.svdvals(self.centers - self.centers.mean(0))
        if bool(spread[1] <= MIN_SPREAD * spread[0]):
            raise ConfigError("markers: the centers lie on one line; move one of them off it")
        self._check_overlap(ids)

    def _check_overlap(self, ids: list[int]) -> None:
        # discs in one plane; discs in different planes (a corner of a box) may come as near as they like
        offset = self.centers[None] - self.centers[:, None]
        same_plane = (self.normals @ self.normals.T > 1 - 1e-6) & (
            (offset * self.normals[:, None]).sum(-1).abs() < 1e-3 * self.radii[:, 0, None]
        )
        reach = self.radii[:, None, 0] + self.radii[None, :, 0]
        overlap = (same_plane & (offset.norm(dim=-1) < reach * (1 - 1e-6))).triu(1).nonzero().tolist()
        if overlap:
            a, b = overlap[0]
            raise ConfigError(f"markers: ids {ids[a]} and {ids[b]} overlap; move them apart or shrink outer_radius")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def discs(self) -> bool:
        """Whether its marks are discs, without a hole."""
        return self.grid is not None and self.grid.discs

    @property
    def codes(self) -> Tensor:
        """(M,) float64 ring codes (inner/outer)^2, the ratio of the areas of the two circles."""
        return (self.radii[:, 1] / self.radii[:, 0]).square()

    @property
    def printed_radii(self) -> Tensor:
        """(M, 2) radii on the part, mm: a dark ring's edges lie outwards by the edge gain, a light one's inwards."""
        outwards = self.edge_gain if self.background == "light" else -self.edge_gain
        return self.radii + outwards * self.radii.new_tensor([1.0, 0.0 if self.discs else -1.0])

    @property
    def part_from_target(self) -> tuple[Tensor, Tensor] | None:
        """R (3, 3), t (3,) mm with X_part = R X_target + t, for `Poses.moved`; None where the file has none."""
        if self.part_rotation is None or self.part_translation is None:
            return None
        return rotations.exp(self.part_rotation), self.part_translation

    @property
    def coplanar(self) -> bool:
        """Whether all rings lie in one plane and face the same way, to 1e-6 of the target's extent."""
        offset = self.centers - self.centers[0]
        scale = offset.norm(dim=-1).max()
        one_normal = (self.normals - self.normals[0]).norm(dim=-1).max() < 1e-6
        return bool(one_normal & ((offset @ self.normals[0]).abs().max() < 1e-6 * scale))

    def upright(self) -> Target:
        """The same where boards that look the same after a turn are taken to be upright (`Grid.upright`)."""
        return self if self.grid is None else replace(self, grid=replace(self.grid, upright=True))

    def of_markers(self, kept: Tensor) -> Target:
        """The board with some of its marks, by a mask (M,); as far as a file claims a perfect one.

        Raises:
            ConfigError: too few are left.
        """
        assert self.grid is not None  # of coded rings each counts
        grid = self.grid.without(tuple(sorted({*self.grid.missing, *self.ids[~kept].tolist()})))
        parts = {name: getattr(self, name)[kept] for name in ("ids", "centers", "normals", "radii")}
        return replace(self, **parts, grid=grid, covariance=None, adjustment=None, cross_covariance=None)

    def to(self, *args: Any, **kwargs: Any) -> Target:
        """Same as `Tensor.to` on every tensor; ids keep their dtype."""

        moved = {f.name: v.to(*args, **kwargs) for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        moved["ids"] = moved["ids"].to(self.ids.dtype)
        return replace(self, **moved)  # type: ignore[arg-type]

    @staticmethod
    def builtin_names() -> list[str]:
        """Names of the targets that come with the package, for `load`."""
        folder = resources.files("torchpose") / "targets"
        return sorted(Path(f.name).stem for f in folder.iterdir() if f.name.endswith(".yaml"))

    @classmethod
    def of_grid(cls, grid: Grid, background: Literal["light", "dark"] = "light") -> Target:
        """A board of equal marks as it is named, flat and regular, its first mark at the origin.

        Raises:
            ConfigError: the board does not say how large its discs are.
        """
        if grid.radii is None:
            raise ConfigError(
                f"{grid}: does not say the radius of its discs, which a pose needs; write {grid}:4mm, or measure the "
                "board: torchpose calibrate --board ... --measure-target"
            )
        ids = torch.tensor([k for k in range(len(grid.points)) if k not in grid.missing])
        centers = grid.points[ids]
        radii = centers.new_tensor(grid.radii).repeat(len(ids), 1)
        return cls(_board_name(grid), background, ids, centers, _facing(centers), radii, grid=grid)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Target:
        """Reads a target file, or a built-in target by its name where no such file exists, or a board by what it is.

        A board, such as ``rings:10x7:20mm:6mm:3mm`` (`Grid.parse`), is dark on light.

        Raises:
            ConfigError: one line ``FILE: FIELD: what is wrong; the fix``.
        """
        source = Path(path)
        if not os.path.exists(source):  # names that no file can have, too
            if os.fspath(path) in cls.builtin_names():
                with resources.as_file(resources.files("torchpose") / "targets" / f"{os.fspath(path)}.yaml") as builtin:
                    return cls._read(builtin)
            if (grid := Grid.parse(os.fspath(path))) is not None:
                return cls.of_grid(grid)
            if source.suffix == "" and source.parent == Path():
                known = ", ".join(cls.builtin_names())
                raise ConfigError(f"{path}: target: is neither a file nor built in; give a path or one of {known}")
        return cls._read(source)

    @classmethod
    def _read(cls, path: Path) -> Target:
        data = validate(_TargetFile, read_yaml(path), path)
        normals = _floats([m.normal for m in data.markers]).reshape(-1, 3)
        lengths = normals.norm(dim=-1, keepdim=True)
        if bool((lengths == 0).any()):
            i = int((lengths[:, 0] == 0).nonzero()[0])
            raise ConfigError(
                f"{path}: markers[{i}].normal: is zero; give the direction into the printed plane, such as [0, 0, 1]"
            )
        pose = data.part_from_target
        with within(f"{path}: "):
            covariance = _covariance(data)
            grid = None if data.board is None else _board(data.board, [m.id for m in data.markers])
            return cls(
                name=data.name,
                background=data.background,
                ids=torch.tensor([m.id for m in data.markers], dtype=torch.int64),
                centers=_floats([m.center for m in data.markers]).reshape(-1, 3),
                normals=normals / lengths,
                radii=_floats([[m.outer_radius, m.inner_radius] for m in data.markers]).reshape(-1, 2),
                part_rotation=None if pose is None else _floats(pose.rotation),
                part_translation=None if pose is None else _floats(pose.translation),
                edge_gain=data.edge_gain,
                covariance=covariance,
                scale_sigma=data.scale_sigma,
                adjustment=data.adjustment,
                cross_covariance=_cross_covariance(data),
                grid=grid,
            )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a target file in one piece; centers, radii and the part's pose read back exactly.

        Raises:
            ConfigError: the folder does not exist or cannot be written.
        """
        board = [] if self.grid is None else [f'board: "{self.grid}"']
        lines = [f"name: {quoted(self.name)}", "units: mm", f"background: {self.background}", *board, "markers:"]
        markers = zip(self.ids.tolist(), self.centers.tolist(), self.radii.tolist(), self.normals.tolist(), strict=True)
        for marker, center, (outer, inner), normal in markers:
            facing = "" if normal == [0, 0, 1] else f", normal: {format_list(normal)}"
            lines.append(
                f"  - {{id: {marker}, center: {format_list(center)}, outer_radius: {format_number(outer)}, "
                f"inner_radius: {format_number(inner)}{facing}}}"
            )
        if self.part_rotation is not None and self.part_translation is not None:
            rotation, translation = map(format_list, (self.part_rotation.tolist(), self.part_translation.tolist()))
            lines.append(f"part_from_target: {{rotation: {rotation}, translation: {translation}}}")
        if self.edge_gain:
            lines.append(f"edge_gain: {format_number(self.edge_gain)}")
        if self.covariance is not None:
            places, gain = self.covariance[:-1, :-1], float(self.covariance[-1, -1])
            lines.append(f"edge_gain_sigma: {format_number(gain**0.5)}")
            if bool(places.any()):
                lines.append(_stated_places(places))
        if self.scale_sigma:
            lines.append(f"scale_sigma: {format_number(self.scale_sigma)}")
        if self.adjustment is not None:
            lines.append(f"adjustment: {quoted(self.adjustment)}")
        if self.cross_covariance is not None:
            (rows, cols), data = self.cross_covariance.shape, format_list(self.cross_covariance.flatten().tolist())
            lines.append(f"camera_cross_covariance: {{rows: {rows}, cols: {cols}, data: {data}}}")
        write_text(path, "\n".join(lines) + "\n")


def _board(text: str, ids: list[int]) -> Grid:
    """The board of a file with the markers that it has.

    Raises:
        ConfigError: it is none.
    """
    with within("board: "):
        grid = Grid.parse(text)
    if grid is None:
        raise ConfigError(f"board: {text!r} is no grid; write {GRID_EXAMPLES}")
    return grid.without(tuple(k for k in range(len(grid.points)) if k not in ids))


def _check_board(grid: Grid, ids: list[int]) -> None:
    count = len(grid.points)
    if max(ids) >= count:
        raise ConfigError(f"markers: id {max(ids)} is not on the board {grid.name}, whose marks are 0 to {count - 1}")
    if sorted(ids) != [k for k in range(count) if k not in grid.missing]:
        raise ConfigError("markers: are not those of the board; leave marks out of its grid, too")


def _board_name(grid: Grid) -> str:
    return f"{grid.kind}-{grid.columns}x{grid.rows}"


def _facing(centers: Tensor) -> Tensor:
    """Normals (M, 3) of markers seen along the z axis."""
    return centers.new_tensor([0.0, 0.0, 1.0]).expand_as(centers)


def _covariance(data: _TargetFile) -> Tensor | None:
    """Of the centres and the edge gain, as `Target.covariance`; what a file with some of the keys leaves out is 0.

    Raises:
        ConfigError: two keys state the same, or a table has not the size of the markers.
    """
    sigmas = [data.center_sigma if m.center_sigma is None else m.center_sigma for m in data.markers]
    stated, table, size = any(s is not None for s in sigmas), data.centers_covariance, 3 * len(data.markers)
    if not stated and table is None and data.edge_gain_sigma is None:
        return None
    covariance = torch.zeros(size + 1, size + 1, dtype=torch.float64)
    if table is not None:
        if stated:
            raise ConfigError("center_sigma: stands beside centers_covariance, which says the same; remove one of them")
        if (table.rows, table.cols) != (size, size) or len(table.data) != size * size:
            raise ConfigError(
                f"centers_covariance: is {table.rows} x {table.cols} with {len(table.data)} numbers; "
                f"{len(data.markers)} markers have {size} x {size}"
            )
        covariance[:-1, :-1] = _floats(table.data).view(size, size)
    else:
        covariance[:-1, :-1] = torch.diag(_floats([s or [0.0] * 3 for s in sigmas]).flatten().square())
    covariance[-1, -1] = (data.edge_gain_sigma or 0.0) ** 2
    return covariance


def _stated_places(places: Tensor) -> str:
    """The line of a file that states the covariance of places: one deviation for all where that says it."""
    variance = places.diagonal().unflatten(0, (-1, 3))
    if bool((variance == variance[0]).all()) and torch.equal(places, torch.diag(places.diagonal())):
        sigma = variance[0].sqrt().tolist()
        return f"center_sigma: {format_number(sigma[0]) if len(set(sigma)) == 1 else format_list(sigma)}"
    data = format_list(places.flatten().tolist())
    return f"centers_covariance: {{rows: {len(places)}, cols: {len(places)}, data: {data}}}"


def _cross_covariance(data: _TargetFile) -> Tensor | None:
    table = data.camera_cross_covariance
    if table is None:
        return None
    if table.rows < 1 or table.cols < 1 or len(table.data) != table.rows * table.cols:
        raise ConfigError(
            f"camera_cross_covariance: {len(table.data)} numbers for {table.rows} x {table.cols}; measure again"
        )
    return _floats(table.data).view(table.rows, table.cols)


def _check_cross(table: Tensor, size: int, adjustment: str | None) -> None:
    field = "camera_cross_covariance"
    if table.ndim != 2 or len(table) != size or table.shape[1] < 4:
        raise ConfigError(f"{field}: has shape {tuple(table.shape)}; give {size} rows, of fx fy cx cy and distortion")
    if not bool(table.isfinite().all()):
        raise ConfigError(f"{field}: holds NaN or infinity; measure the target again")
    if adjustment is None:
        raise ConfigError(f"{field}: stands without adjustment, the name that the camera file shares; measure again")


def _check_covariance(covariance: Tensor, size: int) -> None:
    field = "centers_covariance"
    if covariance.shape != (size, size):
        raise ConfigError(f"{field}: has shape {tuple(covariance.shape)} with the edge gain; give {size} x {size}")
    if not bool(covariance.isfinite().all()):
        raise ConfigError(f"{field}: holds NaN or infinity; measure the target again or state center_sigma")
    scale = covariance.diagonal().abs().max().clamp_min(1e-30)
    if bool(scale > MAX_DEVIATION**2):
        raise ConfigError(f"{field}: has a variance of {float(scale):.3g} mm^2; write it in mm^2, up to 1e6")
    if fault := covariance_fault(covariance):
        raise ConfigError(f"{field}: {fault}; write the whole table as it was measured")


def _floats(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _check_name(name: str) -> None:
    if not name or name != name.strip() or name in (".", ".."):
        raise ConfigError(f"name: is {name!r}; give a word, it goes into result tables and file names")
    for character in name:
        if character in ',/\\"' or (unicodedata.category(character)[0] in "CZ" and character != " "):
            raise ConfigError(f"name: has the character {character!r}; use letters, digits, _ and -")
