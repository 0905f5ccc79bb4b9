"""Files that operating systems leave in folders, for everything that lists a folder's contents."""

from pathlib import PurePath

# macOS, Windows, Linux desktops and network drives; compared in lower case.
_NAMES = {
    ".ds_store",
    ".localized",
    ".apdisk",
    ".spotlight-v100",
    ".trashes",
    ".fseventsd",
    ".temporaryitems",
    ".documentrevisions-v100",
    "__macosx",
    "icon\r",
    "thumbs.db",
    "ehthumbs.db",
    "ehthumbs_vista.db",
    "desktop.ini",
    "$recycle.bin",
    "system volume information",
    ".directory",
    "lost+found",
    "@eadir",
}
# The other half of a file on a drive of another system (macOS), a file that was removed while it
# was open (NFS), and the trash of a Linux desktop.
_PREFIXES = ("._", ".nfs", ".trash-", ".fuse_hidden")


def is_system_file(path: PurePath | str) -> bool:
    """Whether a relative path is, or lies in, what an operating system left: no data, no damage."""
    return any(
        part.lower() in _NAMES or part.lower().startswith(_PREFIXES)
        for part in PurePath(path).parts
    )
