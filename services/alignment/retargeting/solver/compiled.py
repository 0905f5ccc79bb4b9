"""A plain function in, one that numba compiles and keeps on disk out.

numba notices changes of the file that holds a function, not of the files whose functions it calls.
Compiled code is therefore kept in a folder that is named after the content of this whole package.
"""

import hashlib
from pathlib import Path

from numba import config, njit

FOLDER = Path(__file__).parent


def _name_of_code() -> str:
    digest = hashlib.sha256()
    for path in sorted(FOLDER.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


# NUMBA_CACHE_DIR, which numba reads, may name another place; containers bring their code along.
config.CACHE_DIR = str(Path(config.CACHE_DIR or "~/.cache/dextouch").expanduser() / _name_of_code())

# Inner functions are kept within the outer one that calls them.
compiled = njit(nogil=True, error_model="numpy")
compiled_once = njit(cache=True, nogil=True, error_model="numpy")
