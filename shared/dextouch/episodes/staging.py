"""The folder where groups are written before they are committed, and the stages in it."""

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
# Names of stages end in a uuid4 in hexadecimal.
_STAGE_NUMBER = "[0-9a-f]" * 32


def new_stage(root: Path, kind: Kind, item_id: str) -> Path:
    """A name for a stage that nobody has; the folder is not made."""
    return root / STAGING / f"{kind}-{item_id}-{uuid.uuid4().hex}"


def stages_of(root: Path, kind: Kind, item_id: str) -> list[Path]:
    """The stages in which an id is being written, in order of their names."""
    return sorted((root / STAGING).glob(f"{kind}-{item_id}-{_STAGE_NUMBER}"))


def unheld_folders(parent: Path) -> Iterator[Path]:
    """Folders that no writer holds, each held while the caller looks at it."""
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
            # Its writer may have committed it, and let go, between the two calls above.
            if is_folder_at(descriptor, folder):
                yield folder
        finally:
            os.close(descriptor)


def abandoned_stages(root: Path) -> Iterator[Path]:
    """Stages whose writer is gone, each held while the caller looks at it."""
    return unheld_folders(root / STAGING)


def sweep_stages(root: Path, is_taken: IsTaken) -> int:
    """Remove abandoned stages of which `recover_stage` would make nothing; how many went.

    Args:
        root: folder with the stages.
        is_taken: whether an id cannot be had.
    """
    removed = 0
    for stage in abandoned_stages(root):
        if not is_recoverable(stage, is_taken):
            shutil.rmtree(stage)
            removed += 1
    return removed
