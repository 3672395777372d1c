"""Pictures and manifests in object stores, read as those on a disk are."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from torchpose.errors import ConfigError
from torchpose.io import images
from torchpose.io.images import UnreadableImageError
from torchpose.io.manifest import ManifestFrame, read_manifest
from torchpose.io.storage import Place, StorageError, refused, told

_MOST_PICTURE = 1 << 33  # bytes (convention): more than any picture or stack that fits into memory
_MOST_MANIFEST = 1 << 30  # bytes (convention): a million frames


def decode(place: Place, *, threads: int = 1, directory: int = 0, size: tuple[int, int] | None = None) -> np.ndarray:
    """Grey values (H, W), see `images.decode`.

    Raises:
        UnreadableImageError: with the reason; ``missing``, ``denied`` or ``storage`` where the store is at fault.
        WrongSizeError: its header states another size.
    """
    with _reading():
        data = place.contents(_MOST_PICTURE)
    return images.decode_open(BytesIO(data), threads=threads, directory=directory, size=size)


def pages(place: Place) -> list[int]:
    """See `images.pages`."""
    try:
        with _reading(), place.open() as file:
            return images.pages_open(file)
    except UnreadableImageError:
        return [0]


def likely_encoded(place: Place) -> bool:
    """See `images.likely_encoded`."""
    try:
        with _reading(), place.open() as file:
            return images.likely_encoded_open(file)
    except UnreadableImageError:
        return False


def manifest_frames(place: Place, camera: str | None) -> list[ManifestFrame]:
    """See `read_manifest`. ConfigError: the same, and what the store says."""
    try:
        data = place.read(_MOST_MANIFEST)
    except StorageError as error:
        raise refused(error, place, "INPUT") from None
    with TemporaryDirectory() as folder:
        copy = Path(folder, place.name)
        copy.write_bytes(data)
        try:
            return read_manifest(copy, camera)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(copy), str(place))) from None


@contextmanager
def _reading() -> Iterator[None]:
    """UnreadableImageError: the store does not give the file."""
    try:
        yield
    except FileNotFoundError:
        raise UnreadableImageError("missing") from None
    except OSError as error:
        denied = "denied" in told(error).problem
        raise UnreadableImageError("denied" if denied else "storage") from None
