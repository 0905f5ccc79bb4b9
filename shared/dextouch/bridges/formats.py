"""Formats of other tools that `dextouch export` writes and `dextouch import` reads."""

from typing import Final, NamedTuple


class FileFormat(NamedTuple):
    """A format, with options of the two commands that not all formats have.

    `import_options` is None of a format that is only written. `is_joint` means that all episodes
    are written together; `signature` are the first bytes of a format of single files.
    """

    export_options: tuple[str, ...] = ()
    import_options: tuple[str, ...] | None = None
    is_joint: bool = False
    signature: bytes = b""


FORMATS: Final = {
    "lerobot": FileFormat(
        ("append", "cameras", "fps", "license", "repo_id", "touch_samples"),
        ("fps", "k_head"),
        is_joint=True,
    ),
    "mcap": FileFormat(
        ("jpeg_quality", "layout", "touch_images"), ("layout",), signature=b"\x89MCAP0\r\n"
    ),
    "rrd": FileFormat(import_options=("layout", "timeline"), signature=b"RRF"),
    "umi": FileFormat(is_joint=True),
}
FILE_SIGNATURES: Final = {name: form.signature for name, form in FORMATS.items() if form.signature}
