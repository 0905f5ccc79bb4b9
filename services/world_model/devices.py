"""Sharing of several devices among the worker processes of a service, one process a GPU."""

import fcntl
import os
import tempfile
from pathlib import Path


def claimed_device(names: str, folder: Path | None = None) -> str:
    """One of the devices that are named with commas between; it is held until the process ends.

    That with the fewest processes; of several, that of the oldest ones, since they end first when
    workers are replaced one after another. Processes say what they hold in `folder`, by default one
    of their parent process.
    """
    devices = [name.strip() for name in names.split(",")]
    if len(devices) == 1:
        return devices[0]
    if folder is None:
        folder = Path(tempfile.gettempdir()) / f"dextouch-devices-{os.getuid()}-{os.getppid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        since_ns: list[list[int]] = [[] for _ in devices]
        for file in folder.glob("*-*"):
            index, process = file.name.split("-")
            if Path("/proc", process).exists():
                since_ns[int(index)].append(file.stat().st_mtime_ns)
        loads = [(len(each), max(each, default=0)) for each in since_ns]
        chosen = loads.index(min(loads))
        (folder / f"{chosen}-{os.getpid()}").touch()
    return devices[chosen]
