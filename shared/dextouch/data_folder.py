"""Default data folder of all commands, small files, and those that operating systems leave."""

import os
from pathlib import Path, PurePath
from typing import TypeGuard

from dextouch.errors import InvalidInputError, LimitExceededError, NotFoundError, StorageError

DATA_VARIABLE = "DEXTOUCH_DATA"
# macOS, Windows, Linux desktops and network drives; compared in lower case.
_NAMES = {
    ".ds_store", ".localized", ".apdisk", ".spotlight-v100", ".trashes", ".fseventsd",
    ".temporaryitems", ".documentrevisions-v100", "__macosx", "icon\r", "thumbs.db", "ehthumbs.db",
    "ehthumbs_vista.db", "desktop.ini", "$recycle.bin", "system volume information", ".directory",
    "lost+found", "@eadir",
}  # fmt: skip
# The other half of a file on a drive of another system (macOS), a file that was removed while it
# was open (NFS), and the trash of a Linux desktop.
_PREFIXES = ("._", ".nfs", ".trash-", ".fuse_hidden")


def data_folder() -> Path:
    """The folder below which commands keep their data unless a flag says otherwise.

    Raises InvalidInputError if the variable holds a URL.
    """
    text = os.environ.get(DATA_VARIABLE) or "data"
    if "://" in text:
        raise InvalidInputError(
            f"{DATA_VARIABLE}: got {text!r}, expected a local folder; name a store in a bucket "
            "with --store or the service's store_url"
        )
    return Path(text).expanduser()


def default_store() -> str:
    """Where episodes and recordings are kept."""
    return str(data_folder() / "store")


def default_enrolment() -> Path:
    """Where an enrolled station keeps its key of the store."""
    return data_folder() / "enrolment.json"


def default_spool() -> Path:
    """Where a station keeps its takes until they are uploaded."""
    return data_folder() / "spool"


def is_bucket_url(url: str | Path) -> TypeGuard[str]:
    """Whether a store's URL is that of a bucket, s3://…, and not a folder."""
    return isinstance(url, str) and url.startswith("s3://")


def practice_spool(spool: Path) -> Path:
    """Where takes of the practice devices of a station are kept, beside its own."""
    return spool.with_name(f"{spool.name}_practice")


def is_system_file(path: PurePath | str) -> bool:
    """Whether a relative path is, or lies in, what an operating system left: no data, no damage."""
    return any(
        part.lower() in _NAMES or part.lower().startswith(_PREFIXES)
        for part in PurePath(path).parts
    )


def read_bounded(path: Path, max_bytes: int, *, hint: str = "") -> bytes:
    """Read a regular file of limited size; `hint` ends the message about a larger one."""
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
            f"{path}: got more than {max_bytes} bytes, expected at most that{hint}"
        )
    return data
