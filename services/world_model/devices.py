"""Sharing of several devices among the worker processes of services, one process a GPU."""

import fcntl
import os
import tempfile
from functools import cache
from pathlib import Path
from urllib.parse import quote, unquote

from dextouch.errors import UnavailableError


@cache
def claimed_device(names: str, folder: Path | None = None) -> str:
    """One of the devices that are named with commas between; it is held until the process ends.

    That with the fewest processes, or with the oldest ones, since they end first when workers are
    replaced one after another. Each holds a lock of a file in `folder`, by default one of the user.

    Raises:
        UnavailableError: the folder belongs to another user, or is a link or no folder.
    """
    devices = [name.strip() for name in names.split(",")]
    if len(devices) == 1:
        return devices[0]
    if folder is None:
        folder = Path(tempfile.gettempdir()) / f"dextouch-devices-{os.getuid()}"
    opened = _opened(folder)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX)
        since_ns: dict[str, list[int]] = {name: [] for name in devices}
        for claim in folder.iterdir():
            name = unquote(claim.name.rpartition("-")[0])
            if not _is_held(claim):
                claim.unlink()
            elif name in since_ns:
                since_ns[name].append(claim.stat().st_mtime_ns)
        chosen = min(devices, key=lambda one: (len(since_ns[one]), max(since_ns[one], default=0)))
        # Open, and locked, until the process ends.
        own, _ = tempfile.mkstemp(prefix=f"{quote(chosen, safe='')}-", dir=folder)
        fcntl.flock(own, fcntl.LOCK_EX)
    finally:
        os.close(opened)
    return chosen


def _opened(folder: Path) -> int:
    """Descriptor of a folder of this user's own, which is made if there is none."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError as error:
        raise _foreign(folder, str(error)) from error
    owner = os.fstat(opened).st_uid
    if owner != os.getuid():
        os.close(opened)
        raise _foreign(folder, f"user {owner}")
    return opened


def _foreign(folder: Path, got: str) -> UnavailableError:
    return UnavailableError(
        f"devices: got {folder} of {got}, expected a folder of user {os.getuid()} to share "
        "devices in; remove it, set TMPDIR to a folder of your own, or name a single device"
    )


def _is_held(claim: Path) -> bool:
    """Whether the process that made this file is alive."""
    opened = os.open(claim, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(opened)
    return False
