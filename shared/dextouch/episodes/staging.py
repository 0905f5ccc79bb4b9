"""The staging folder of a store: creation, listing and removal of stages."""

import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from dextouch.episodes.files import is_folder_at
from dextouch.episodes.format import Kind
from dextouch.episodes.staging_recovery import IsTaken, is_recoverable

STAGING = ".staging"
# Stage names end in a hexadecimal uuid4.
_STAGE_NUMBER = "[0-9a-f]" * 32


def new_stage(root: Path, kind: Kind, item_id: str) -> Path:
    """A unique path for a new stage; the folder is not created."""
    return root / STAGING / f"{kind}-{item_id}-{uuid.uuid4().hex}"


def stages_of(root: Path, kind: Kind, item_id: str) -> list[Path]:
    """The stages of an id, sorted by name."""
    return sorted((root / STAGING).glob(f"{kind}-{item_id}-{_STAGE_NUMBER}"))


def unheld_folders(parent: Path) -> Iterator[Path]:
    """Iterate over folders not locked by a writer, holding each one's lock meanwhile."""
    for folder in sorted(parent.iterdir()) if parent.is_dir() else []:
        try:
            descriptor = os.open(folder, os.O_RDONLY)
        except FileNotFoundError:
            continue  # committed since we listed
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        else:
            # Its writer may have committed and unlocked it between the two calls above.
            if is_folder_at(descriptor, folder):
                yield folder
        finally:
            os.close(descriptor)


def abandoned_stages(root: Path) -> Iterator[Path]:
    """Iterate over stages whose writer is gone, holding each one's lock meanwhile."""
    return unheld_folders(root / STAGING)


def sweep_stages(root: Path, is_taken: IsTaken) -> int:
    """Remove abandoned stages that `recover_stage` cannot recover, and return their number.

    Args:
        root: folder with the stages.
        is_taken: whether an id is in use.
    """
    removed = 0
    for stage in abandoned_stages(root):
        if not is_recoverable(stage, is_taken):
            shutil.rmtree(stage)
            removed += 1
    return removed
