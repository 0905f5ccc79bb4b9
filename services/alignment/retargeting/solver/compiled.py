"""A plain function in, one that numba compiles and keeps on disk out.

numba notices changes of the file that holds a function, not of the files whose functions it calls.
Compiled code is therefore kept in a folder that is named after the content of this whole package.
"""

import hashlib
import os
import shutil
import tempfile
from pathlib import Path

from numba import config, njit

PACKAGE = Path(__file__).parent


def folder_of_code(wanted: Path, spare: Path) -> Path | None:
    """Where compiled code is kept: the wanted folder, or the spare one where that is read-only.

    What a read-only folder brings along (of an image) is copied.

    Args:
        wanted: for the code of all versions.
        spare: of this user alone, since code in it is run.

    Returns:
        None where neither may be written.
    """
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.glob("*.py")):
        digest.update(path.read_bytes())
    name = digest.hexdigest()[:16]
    for base in (wanted, spare):
        folder = base / name
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError:
            continue
        if not os.access(folder, os.W_OK) or folder.stat().st_uid != os.getuid():
            continue
        if base == spare and (wanted / name).is_dir():
            shutil.copytree(wanted / name, folder, dirs_exist_ok=True)
        return folder
    return None


# numba reads NUMBA_CACHE_DIR.
_FOLDER = folder_of_code(
    Path(config.CACHE_DIR or "~/.cache/dextouch").expanduser(),
    Path(tempfile.gettempdir()) / f"dextouch-{os.getuid()}",
)
if _FOLDER is not None:
    config.CACHE_DIR = str(_FOLDER)

# Sums in any order and fused products, but NaN and infinity as they are.
_MATH = {"reassoc", "contract", "arcp", "nsz"}
# Inner functions are kept within the outer one that calls them.
compiled = njit(nogil=True, error_model="numpy", fastmath=_MATH)
compiled_once = njit(cache=_FOLDER is not None, nogil=True, error_model="numpy", fastmath=_MATH)
