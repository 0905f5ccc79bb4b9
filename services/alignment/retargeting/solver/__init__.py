"""Compiled retargeting solver: its compilation by numba, and the folder that keeps compiled code.

The folder is named after the content of the package: numba would miss changes of called functions.
"""

import hashlib
import os
import stat
from pathlib import Path

import structlog
from numba import config, njit

PACKAGE = Path(__file__).parent
ROOT_UID = 0


def folder_of_code(base: Path) -> Path | None:
    """Folder below a base for this version's compiled code; None if others may write to it."""
    code = b"".join(path.read_bytes() for path in sorted(PACKAGE.glob("*.py")))
    try:
        # What a link leads to is checked and used, wherever the link leads later.
        base = base.expanduser().resolve()
        base.mkdir(mode=0o755, parents=True, exist_ok=True)
        folder = base / hashlib.sha256(code).hexdigest()[:16]
        folder.mkdir(mode=0o700, exist_ok=True)
        above, found = base.stat(), folder.lstat()
    except (OSError, RuntimeError):  # the latter without a home, and for links in a circle
        return None
    others_write = above.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    is_safe = (
        found.st_mode & ~stat.S_ISGID == stat.S_IFDIR | stat.S_IRWXU
        and found.st_uid == os.getuid()
        and above.st_uid in {ROOT_UID, os.getuid()}
        and (not others_write or above.st_mode & stat.S_ISVTX)
    )
    return folder if is_safe and os.access(folder, os.W_OK) else None


_BASE = Path(config.CACHE_DIR or "~/.cache/dextouch")
_FOLDER = folder_of_code(_BASE)
if _FOLDER is None:
    structlog.get_logger().warning(
        "compiled_code_not_kept",
        tried=str(_BASE),
        advice="every start compiles for about half a minute; set NUMBA_CACHE_DIR to a folder that "
        "this user alone may write",
    )
else:
    config.CACHE_DIR = str(_FOLDER)

# Sums in any order and fused products, but NaN and infinity as they are.
_MATH = {"reassoc", "contract", "arcp", "nsz"}
# Inner functions are kept within the outer one that calls them.
compiled = njit(nogil=True, error_model="numpy", fastmath=_MATH)
compiled_once = njit(cache=_FOLDER is not None, nogil=True, error_model="numpy", fastmath=_MATH)
