"""Compilation of the solver by numba, and the folder that keeps compiled code between starts.

numba notices changes of the file that holds a function, not of the files whose functions it calls.
Compiled code is therefore kept in a folder that is named after the content of this whole package.
"""

import hashlib
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

import structlog
from numba import config, njit

PACKAGE = Path(__file__).parent
ROOT_UID = 0
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def folder_of_code(*bases: Path) -> Path | None:
    """Where compiled code is kept: in the first of these folders that this user may write.

    Code of this version that an earlier, read-only one holds (of an image that another user built)
    is copied. Code is run: it is used only from folders of this user or root that no other user can
    write to. Where the umask lets a group write new files, other users cannot enter the folder.

    Args:
        bases: for the code of all versions, best first; other users may read the code in it.

    Returns:
        None where none may be written.
    """
    code = b"".join(path.read_bytes() for path in sorted(PACKAGE.glob("*.py")))
    name = hashlib.sha256(code).hexdigest()[:16]
    tried: list[Path] = []
    for base in bases:
        try:
            # What a link leads to is checked and used, wherever the link leads later.
            folder = base.resolve() / name
            tried.append(folder)
            is_new = not folder.is_dir()
            if is_new:
                _make(folder)
            is_own = os.access(folder, os.W_OK) and folder.stat().st_uid == os.getuid()
            if not (is_own and _is_safe(folder)):
                continue
        except (OSError, RuntimeError):  # the latter for links in a circle
            continue
        if is_new:
            _copy_first(tried[:-1], folder)
        return folder
    return None


def _make(folder: Path) -> None:
    """Make a folder and the one above, for this user alone to write."""
    folder.parent.mkdir(parents=True, exist_ok=True, mode=0o755)
    umask = os.umask(_OTHERS_WRITE)
    os.umask(umask)
    # numba leaves the modes of its files to the umask.
    is_strict = umask & _OTHERS_WRITE == _OTHERS_WRITE
    folder.mkdir(exist_ok=True, mode=0o755 if is_strict else 0o700)


def _is_safe(folder: Path) -> bool:
    """Whether only this user and root can change or replace the folder."""
    found, above = folder.lstat(), folder.parent.stat()
    return (
        stat.S_ISDIR(found.st_mode)
        and not found.st_mode & _OTHERS_WRITE
        and not (above.st_mode & _OTHERS_WRITE and not above.st_mode & stat.S_ISVTX)
        and {found.st_uid, above.st_uid} <= {ROOT_UID, os.getuid()}
    )


def _copy_first(sources: list[Path], folder: Path) -> None:
    """Copy the first of these folders that may be read; without any, code is compiled again."""
    for source in sources:
        try:
            if not (source.is_dir() and _is_safe(source)):
                continue
            # `rglob` passes over what may not be read without a word.
            next(source.iterdir(), None)
            for path in sorted(source.rglob("*")):
                if path.is_file():
                    target = folder / path.relative_to(source)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    # Another process may read it already: whole or not at all.
                    part = target.with_name(f"{target.name}.{os.getpid()}")
                    shutil.copyfile(path, part)
                    part.replace(target)
        except OSError as error:
            structlog.get_logger().warning(
                "compiled_code_not_copied", source=str(source), error=str(error)
            )
            continue
        return


def _usual_bases() -> list[Path]:
    """`NUMBA_CACHE_DIR` or the user's own cache, then a folder for temporary files."""
    bases = []
    # Without a home.
    with suppress(RuntimeError):
        bases.append(Path(config.CACHE_DIR or "~/.cache/dextouch").expanduser())
    # With nothing writable.
    with suppress(FileNotFoundError):
        bases.append(Path(tempfile.gettempdir()) / f"dextouch-{os.getuid()}")
    return bases


_FOLDER = folder_of_code(*_usual_bases())
if _FOLDER is None:
    structlog.get_logger().warning(
        "compiled_code_not_kept",
        tried=[str(base) for base in _usual_bases()],
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
