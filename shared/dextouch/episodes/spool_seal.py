"""Checksums of a spool: of its attributes, and the seal that shows what a closed spool has lost."""

import re
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, ValidationError

from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import sha256_hex
from dextouch.episodes.spool_log import LOG_FILE
from dextouch.errors import CorruptDataError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import RecordingAttributes, first_problems

RECORDING_FILE: Final = "recording.json"
CLOSED_FILE: Final = "closed"
# The last member of `recording.json`: of the bytes before it, closed by a brace.
_CHECKSUM = re.compile(rb',"sha256":"([0-9a-f]{64})"\}\Z')


class Seal(FrozenModel):
    """What a spool had when it was closed: samples by stream, its log, attributes.

    `records_sha256` is of the rows of the log's records (`RECORD_ROW`), each with the checksum of
    its body: it tells the log from another one that is as long.
    """

    format_version: Literal[1] = 1
    num_samples: dict[str, int]
    log_bytes: int = Field(ge=0)
    records_sha256: str
    recording_sha256: str


def has_checksum(text: bytes) -> bool:
    """Whether a `recording.json` has its sha256, which earlier releases did not write."""
    return _CHECKSUM.search(text) is not None


def encode_attributes(attributes: RecordingAttributes) -> bytes:
    """The bytes of `recording.json`: the attributes, and the sha256 of their JSON."""
    text = attributes.model_dump_json().encode()
    return text[:-1] + f',"sha256":"{sha256_hex(text)}"}}'.encode()


def decode_attributes(text: bytes, *, what: str) -> RecordingAttributes:
    """Inverse of `encode_attributes`; files of earlier releases have no checksum.

    Raises:
        CorruptDataError: damaged bytes.
    """
    found = _CHECKSUM.search(text)
    if found is not None:
        text = text[: found.start()] + b"}"
        if sha256_hex(text).encode() != found[1]:
            raise CorruptDataError(
                f"{what}: {RECORDING_FILE} does not match its sha256; restore it from a copy"
            )
    try:
        return RecordingAttributes.model_validate_json(text)
    except ValidationError as error:
        raise CorruptDataError(f"{what}: {RECORDING_FILE}: {error}") from error


def read_recording_file(path: Path) -> bytes:
    """The bytes of a spool's `recording.json`.

    Raises:
        NotFoundError: there is no spool.
        CorruptDataError: there is its log alone.
    """
    with disk_errors(f"open spool {path.name}"):
        if not (path / RECORDING_FILE).is_file():
            if (path / LOG_FILE).is_file():
                raise CorruptDataError(
                    f"spool {path.name!r}: {RECORDING_FILE} is missing; restore it from a copy, or "
                    "remove the folder"
                )
            raise NotFoundError(f"spool {path.name!r}: there is none in {path.parent}")
        return (path / RECORDING_FILE).read_bytes()


def read_seal(path: Path) -> Seal | None:
    """The seal of a closed spool; None for an empty file, which earlier releases wrote.

    Raises:
        FileNotFoundError: the spool is not closed.
        CorruptDataError: the seal is damaged.
    """
    text = (path / CLOSED_FILE).read_bytes()
    try:
        return Seal.model_validate_json(text) if text else None
    except ValidationError as error:
        raise CorruptDataError(
            f"spool {path.name!r}: the file {CLOSED_FILE!r} is damaged ({first_problems(error)}); "
            "restore it from a copy, or remove it: then the take is recovered as an interrupted one"
        ) from error
