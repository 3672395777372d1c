"""What the cells of result tables may hold: one model a schema, for CSV, JSON lines, Parquet and journals alike."""

from collections.abc import Callable
from functools import lru_cache
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from torchpose.config import problem_of
from torchpose.config.kinds import Number, Size, Word
from torchpose.io.rows import NEWER, Row, Schema
from torchpose.results import Status

_STATUSES = tuple(status.name.lower() for status in Status)
_MOST_COUNT = 1_000_000  # markers or copies in a frame (convention): more than any frame has room for


def _file_name(name: str) -> str:
    """Line ends and all that a file system takes are parts of a name, halves of surrogate pairs are none."""
    if "\0" in name or any("\ud800" <= character <= "\udfff" for character in name):
        raise ValueError("is not the name of a file; write the name of the frame")
    return name


FileName = Annotated[str, Field(min_length=1, max_length=4096), AfterValidator(_file_name)]
_Count = Annotated[int, Field(ge=0, le=_MOST_COUNT)]
_Six = Annotated[list[Number], Field(min_length=6, max_length=6)]
_Matrix = Annotated[list[_Six], Field(min_length=6, max_length=6)]
_Place = Annotated[list[Number | None], Field(min_length=5, max_length=5)]
_Quaternion = Annotated[list[Number], Field(min_length=4, max_length=4)]
_Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]


class CellError(ValueError):
    """A cell is of another kind; the message is ``COLUMN: what is wrong; the fix``."""


class _Solution(BaseModel):
    model_config = ConfigDict(extra="forbid")
    translation: _Vector
    rotation: _Vector
    quaternion: _Quaternion
    rms_px: Size | None
    chi2: Number | None


class _Share(BaseModel):
    model_config = ConfigDict(extra="forbid")
    camera: Word
    share: Number


class _File(BaseModel):
    """A table's row, lax where cells are text."""

    model_config = ConfigDict(extra="ignore")


_LISTS: dict[str, Any] = {
    **dict.fromkeys(("covariance", "noise_covariance", "base_covariance"), _Matrix),
    "systematic": Annotated[list[list[Number]], Field(min_length=6, max_length=6)],
    "place": list[_Place | None],
    "quaternion": _Quaternion,
    "shares": list[_Share],
    "solutions": Annotated[list[_Solution], Field(max_length=2)],
}
_NEEDED: dict[str, Any] = {"frame": FileName, "target": Word, "status": Literal[_STATUSES]}
# of a pose table; in others such names may mean something else
_DEVIATIONS = ("rms_px", *(f"{part}{axis}" for part in "sn" for axis in ("x", "y", "z", "rx", "ry", "rz")))


def _kind(column: str, plain: type, of_poses: bool) -> Any:
    name = column.removeprefix("base_") if of_poses else ""
    if plain is list:
        return _LISTS.get(column, list[Number])
    if plain is float:
        return Size if name in _DEVIATIONS else Number
    return _Count if plain is int else Annotated[str, Field(max_length=4096), AfterValidator(_file_name)]


@lru_cache
def _model(columns: tuple[tuple[str, type], ...]) -> type[BaseModel]:
    """The model of rows with these columns; cells may be None but for the names and the status."""
    of_poses = ("status", str) in columns
    fields: dict[str, Any] = {
        column: (_NEEDED[column], ...)
        if column in _NEEDED
        else (_kind(column, plain, of_poses) | None, NEWER.get(column))
        for column, plain in columns
    }
    return create_model("Row", __base__=_File, **fields)


def row_check(schema: Schema, *, text: bool = False) -> Callable[[Row], Row]:
    """A function that gives a row with the cells of the schema alone, each of its kind.

    Args:
        schema: of the table.
        text: whether cells are text, as those of a CSV file.

    Returns:
        It raises `CellError`.
    """
    model = _model(tuple(schema.items()))

    def check(row: Row) -> Row:
        try:
            return model.model_validate(row, strict=not text).model_dump()
        except ValidationError as caught:
            field, problem = problem_of(caught, model)
        raise CellError(f"{field}: {problem}")

    return check
