"""Size-limited reading of a regular file."""

from pathlib import Path

from dextouch.errors import InvalidInputError, LimitExceededError, NotFoundError, StorageError


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a whole file.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: a folder, pipe or device.
        LimitExceededError: larger than `max_bytes`.
        StorageError: not readable.
    """
    try:
        if not path.exists():
            raise NotFoundError(f"{path}: no such file")
        if not path.is_file():
            raise InvalidInputError(f"{path}: got a folder or device, expected a regular file")
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > max_bytes:
        raise LimitExceededError(
            f"{path}: got more than {max_bytes} bytes, expected a hand's description of at most "
            "that; meshes belong into files of their own"
        )
    return data
