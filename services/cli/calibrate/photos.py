"""Loading of photos as grey images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from dextouch.command_line import progress
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")


def photo_paths(folder: Path) -> list[Path]:
    """List the photos of a folder, sorted by name.

    Raises:
        NotFoundError: no folder, or no photo in it.
    """
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder of photos")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise NotFoundError(f"{folder}: holds no photo; expected {', '.join(SUFFIXES)}")
    return paths


def read_photos(paths: Sequence[Path]) -> list[UInt8[np.ndarray, "h w"]]:
    """Read photos of equal size as grey images.

    Raises:
        CorruptDataError: a file that cannot be decoded.
        InvalidInputError: photos of different sizes.
    """
    photos, size = [], None
    for path in progress(paths, "reading photos", len(paths)):
        photo = decode_photo(path.read_bytes(), where=str(path))
        if size is not None and photo.shape != size[1]:
            raise InvalidInputError(
                f"{path}: got {photo.shape[1]} by {photo.shape[0]} px, expected "
                f"{size[1][1]} by {size[1][0]} as {size[0]}; photos must come from one camera mode"
            )
        size = size or (path.name, photo.shape)
        photos.append(photo)
    return photos


def decode_photo(data: bytes, *, where: str) -> UInt8[np.ndarray, "h w"]:
    """Decode a photo to a grey image.

    Raises:
        CorruptDataError: not an image.
    """
    import cv2

    bytes_ = np.frombuffer(data, dtype=np.uint8)
    photo = cv2.imdecode(bytes_, cv2.IMREAD_GRAYSCALE) if data else None
    if photo is None:
        raise CorruptDataError(f"{where}: {len(data)} bytes are not an image")
    return np.asarray(photo, dtype=np.uint8)
