"""Recordings made of the streams of other tools' files, with their provenance and a report."""

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import ValidationError

from dextouch import __version__
from dextouch.bridges.export_files import Block
from dextouch.bridges.formats import FILE_SIGNATURES
from dextouch.data_folder import is_system_file
from dextouch.episodes import EpisodeStore, EpisodeWriter, disk_errors
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.schemas import Domain, ImportedFile, RecordingAttributes, first_problems
from dextouch.streams import NO_DEVICE_TIME, StreamDescriptor
from dextouch.tactile.layout import TactileLayout

ImageUnit = Literal["h264", "jpeg", "rgb8"]
MAX_NAME: Final = 64
MAX_ID: Final = 128
# Suffixes of the arrays beside a stream's values, which no other stream may be called.
_STAMP_SUFFIXES: Final = ("_t_host_ns", "_t_device_ns", "_sequence")
_NS_PER_S: Final = 1_000_000_000
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
# Host times before are those of a clock that counts from its start, not from 1970.
_EARLIEST_NS: Final = int(datetime(2000, 1, 1, tzinfo=UTC).timestamp()) * _NS_PER_S
_LATEST_NS: Final = int(datetime(2200, 1, 1, tzinfo=UTC).timestamp()) * _NS_PER_S
# What to do with files of other kinds that come in the place of a recording.
_OTHER_FILES: Final = {
    b"version https://git-lfs": "it is a pointer of Git LFS, `git lfs pull` gets the file",
    b"#ROSBAG": "it is a ROS 1 bag, convert it with `rosbags-convert --dst-storage mcap`",
    b"SQLite": "if it is of a ROS 2 bag, convert it with `rosbags-convert --dst-storage mcap`",
    b"\x28\xb5\x2f\xfd": "it is compressed, unpack it with `zstd -d`",
}


@dataclass(frozen=True)
class ForeignStream:
    """One stream of a foreign file.

    `source` is its name there (topic, feature, entity). `blocks` are its samples with `t_ns` as
    t_host_ns, in order. `as_numbers` says why samples with a meaning of their own (points, a custom
    message) are kept as plain numbers, and `notes`, read after the blocks, what was converted; both
    go to the report.
    """

    descriptor: StreamDescriptor
    source: str
    blocks: Iterable[Block] = ()
    as_numbers: str = ""
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Refused:
    """Something of the file that was not imported; `schema` is its type there, if it has one."""

    source: str
    reason: str
    schema: str = ""
    num_samples: int = 0


@dataclass
class ImportedStream:
    """What was imported of one stream; `rate_hz` is the mean over its duration."""

    stream: str
    source: str
    kind: str
    unit: str
    shape: tuple[int, ...]
    frame: str | None
    num_samples: int = 0
    rate_hz: float = 0.0
    duration_s: float = 0.0
    num_reordered: int = 0
    num_repeated_stamps: int = 0
    num_device_stamps: int = 0
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, about: StreamDescriptor, source: str) -> "ImportedStream":
        """A stream of which nothing was written yet."""
        return cls(about.name, source, about.kind, about.unit, about.shape, about.frame)

    def set_span(self, first_ns: int, last_ns: int) -> None:
        """Duration and mean rate of all samples, by their first and last stamp."""
        self.duration_s = (last_ns - first_ns) / _NS_PER_S
        self.rate_hz = (self.num_samples - 1) / self.duration_s if self.duration_s else 0.0


@dataclass
class ImportReport:
    """Result of an import: nothing of the file is missing from all three lists.

    `kept_as_numbers` are streams that are also among `imported`, with the reason. `contradictions`
    are those between what the file says of itself and what it holds.
    """

    recording_id: str
    file: str
    imported: list[ImportedStream] = field(default_factory=list)
    kept_as_numbers: dict[str, str] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)
    contradictions: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Plain JSON values."""
        return asdict(self)

    def lines(self) -> Iterator[str]:
        """The report for a terminal, one line each."""
        return map(printable, self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.recording_id}  {self.file}"
        for one in self.imported:
            said = [f"{one.num_samples} samples", f"{one.rate_hz:.4g} Hz", *one.notes]
            if one.num_samples == 0:
                said = ["empty", *one.notes]
            if one.num_reordered:
                said.append(f"{one.num_reordered} out of order, sorted")
            if one.num_repeated_stamps:
                said.append(f"{one.num_repeated_stamps} stamps repeat the one before")
            if one.stream in self.kept_as_numbers:
                said.append(f"kept as numbers: {self.kept_as_numbers[one.stream]}")
            form = f"{one.unit} {list(one.shape)}"
            yield f"  {one.stream}  <- {one.source}  {form}  {', '.join(said)}"
        for no in self.refused:
            about = f" ({no.schema})" if no.schema else ""
            yield f"  refused {no.source}{about}, {no.num_samples} samples: {no.reason}"
        yield from (f"  contradiction: {one}" for one in self.contradictions)


def printable(line: str) -> str:
    """A line for a terminal; names in files may hold control characters."""
    return "".join(one if one.isprintable() else "\ufffd" for one in line)


def whole_text(value: object) -> str:
    """Text of a value without half surrogates, which JSON can hold and UTF-8 cannot."""
    return str(value).encode(errors="replace").decode()


@dataclass(frozen=True)
class ImportChoices:
    """What is chosen for an import of any format.

    `mapping` has sources by stream name and overrides the rule of `stream_names`; `id_prefix` is
    put before every id, needed when ids exist already. Without `task`, `instruction` or `images`
    (the unit of images) they are what the files say.
    """

    mapping: Mapping[str, str] = field(default_factory=dict)
    id_prefix: str = ""
    task: str | None = None
    instruction: str = ""
    domain: Domain = "human"
    images: ImageUnit | None = None


@dataclass(frozen=True)
class ImportAttributes(ImportChoices):
    """What a file of another tool does not say about the take.

    `images` is the unit of video that must be decoded; `layout` that of the taxels of mapped
    tactile streams, None of `dextouch_v1`.
    """

    task: str = "imported"
    images: ImageUnit = "h264"
    station: str = "imported"
    layout: TactileLayout | None = None


def find_format(path: Path) -> str:
    """Format of a file or folder by its content: `mcap`, `rrd` or `lerobot`.

    Raises InvalidInputError if it is none of these.
    """
    expected = "expected an MCAP file, a Rerun .rrd file, or a LeRobot data set"
    if path.is_dir():
        if (path / "meta" / "info.json").is_file():
            return "lerobot"
        forms = [form for form in FILE_SIGNATURES if files_of(path, form)]
        if len(forms) == 1:
            return forms[0]
        if forms:
            raise InvalidInputError(f"{path}: holds files of {forms}; choose one with --format")
        found = "a folder without meta/info.json, .mcap or .rrd files"
    else:
        with disk_errors(f"read {path}"), path.open("rb") as file:
            start = file.read(8)
        for form, signature in FILE_SIGNATURES.items():
            if start.startswith(signature):
                return form
        found = f"a file that begins with {start.hex(' ') or 'nothing'}"
        expected = remedy(path, expected)
    raise InvalidInputError(f"{path}: got {found}; {expected}")


def files_of(folder: Path, form: str) -> list[Path]:
    """Files of a format in a folder, by their names and without those of operating systems."""
    with disk_errors(f"read {folder}"):
        found = [path for path in folder.iterdir() if path.suffix.lower() == f".{form}"]
    return sorted(path for path in found if not is_system_file(path.name))


def remedy(path: Path, usual: str = "copy the dataset again") -> str:
    """What to do with a file that is not what it should be, by its first bytes."""
    with disk_errors(f"read {path}"), path.open("rb") as file:
        start = file.read(32)
    found = (advice for signature, advice in _OTHER_FILES.items() if start.startswith(signature))
    return next(found, usual)


def stream_names(sources: Sequence[str], mapping: Mapping[str, str]) -> dict[str, str]:
    """Name of the stream of each source, unique in a recording.

    In lower case, every run of other characters than letters and digits becomes one `_`, without
    those at the ends (`/camera/head/image_raw` becomes `camera_head_image_raw`); a name that does
    not begin with a letter gets `s_` before it, and one that is taken `_2`, `_3`, … after it.
    `mapping` has the sources of chosen names, which come first.

    Raises:
        UnknownNameError: a mapping to a source that the file does not have.
        InvalidInputError: a mapping of a name that no stream may have, or of one source twice.
    """
    names: dict[str, str] = {}
    for name, source in mapping.items():
        if source not in sources:
            raise UnknownNameError("source of a stream", source, list(sources))
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name):
            raise InvalidInputError(
                f"mapping {name}={source}: got stream name {name!r}, expected small letters, "
                "digits and _, beginning with a letter, at most 64"
            )
        if source in names:
            raise InvalidInputError(
                f"mapping: {source!r} is given to {names[source]!r} and {name!r}; expected one"
            )
        names[source] = name
    for source in sources:
        if source not in names:
            names[source] = _free_name(source, names.values())
    return names


def _free_name(source: str, taken: Iterable[str]) -> str:
    plain = re.sub(r"[^a-z0-9]+", "_", source.lower()).strip("_") or "stream"
    if not plain[0].isalpha():
        plain = f"s_{plain}"
    for suffix in _STAMP_SUFFIXES:
        plain = plain.removesuffix(suffix) + ("_" if plain.endswith(suffix) else "")
    names, name, number = set(taken), plain[:MAX_NAME], 1
    while name in names:
        number += 1
        name = f"{plain[: MAX_NAME - 1 - len(str(number))]}_{number}"
    return name


def recording_id_of(path: Path, prefix: str = "") -> str:
    """Id of the recording of a file: its name in lower case, other characters as `-`.

    Of names without a character of an id, such as Chinese ones, a hash tells them apart.
    """
    stem = path.stem.lower()
    if not re.search(r"[a-z0-9]", stem):
        stem = f"imported-{hashlib.sha256(stem.encode(errors='replace')).hexdigest()[:8]}"
    return re.sub(r"[^a-z0-9_-]+", "-", f"{prefix.lower()}{stem}").strip("-_")[:MAX_ID]


def file_sha256(path: Path) -> str:
    """Sha256 of a file, in hexadecimal."""
    with disk_errors(f"read {path}"), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def new_attributes(
    path: Path,
    about: ImportAttributes,
    *,
    form: str,
    first_ns: int | None = None,
    calibration: Mapping[str, np.ndarray] | None = None,
    sha256: str | None = None,
) -> RecordingAttributes:
    """Attributes of the recording of a file, with its provenance.

    `form` names the format and `first_ns` is the first host time, from which `started_at` is known
    where it counts from 1970. `sha256` is that of the file, by default read from it; of a folder
    the caller says it.

    Raises InvalidInputError for a task, domain or id that no recording may have.
    """
    name = whole_text(path.resolve().name)[-255:]
    source = ImportedFile(
        name=name or "unnamed",
        sha256=sha256 or file_sha256(path),
        importer=f"dextouch {__version__} {form}",
    )
    started = None
    if first_ns is not None and _EARLIEST_NS <= first_ns < _LATEST_NS:
        # To the microsecond, and the host time that this is exactly.
        first_ns -= first_ns % 1000
        started = _EPOCH + timedelta(microseconds=first_ns // 1000)
    matrices = {k: np.atleast_2d(v).tolist() for k, v in (calibration or {}).items()}
    try:
        return RecordingAttributes.model_validate(
            {
                "recording_id": recording_id_of(path, about.id_prefix),
                "task": about.task,
                "instruction": about.instruction,
                "domain": about.domain,
                "station": about.station,
                "started_at": started,
                "started_t_host_ns": None if started is None else first_ns,
                "calibration": matrices,
                "imported_from": source,
            }
        )
    except ValidationError as error:
        raise InvalidInputError(
            f"{path}: the options make no recording ({first_problems(error)})"
        ) from error


def write_recording(
    store: EpisodeStore,
    attributes: RecordingAttributes,
    streams: Sequence[ForeignStream],
    *,
    blocks: Iterable[tuple[str, Block]] | None = None,
    refused: Sequence[Refused] = (),
) -> ImportReport:
    """Write the streams of a foreign file as one recording, whole or not at all.

    `blocks` are those of all streams with the stream's name, for files in which streams are
    interleaved; without it each stream's own are taken in turn. `refused` is read at the end, when
    the blocks are taken. Samples out of order within a block
    are sorted, and both these and repeated stamps are counted in the report.

    Raises:
        ConflictError: the store has a recording of this id.
        InvalidInputError: no stream; or a block that begins before the end of the one before.
    """
    if store.exists(attributes.recording_id, kind="recording"):
        raise ConflictError(
            f"recording {attributes.recording_id!r} exists already; choose another --id-prefix"
        )
    source = attributes.imported_from
    report = ImportReport(attributes.recording_id, "" if source is None else source.name)
    if not streams:
        raise InvalidInputError(
            f"{report.file}: has no stream to import"
            + "".join(f"; {one.source}: {one.reason}" for one in refused[:20]),
            refused=[asdict(one) for one in refused],
        )
    descriptors = tuple(stream.descriptor for stream in streams)
    attributes = attributes.model_copy(update={"streams": descriptors})
    with store.writer(kind="recording", attributes=attributes) as writer:
        counters = {one.descriptor.name: _Counter(one, writer) for one in streams}
        if blocks is None:
            blocks = ((one.descriptor.name, block) for one in streams for block in one.blocks)
        for name, block in blocks:
            counters[name].append(block)
    report.refused += refused
    report.imported += [counter.result() for counter in counters.values()]
    report.kept_as_numbers |= {s.descriptor.name: s.as_numbers for s in streams if s.as_numbers}
    return report


class _Counter:
    """Appends the blocks of one stream, and counts what is unusual in them."""

    def __init__(self, stream: ForeignStream, writer: EpisodeWriter) -> None:
        self._writer, self._notes = writer, stream.notes
        self._first_ns: int | None = None
        self._last_ns = 0
        self.report = ImportedStream.of(stream.descriptor, stream.source)

    def append(self, block: Block) -> None:
        if not len(block):
            return
        late = np.flatnonzero(block.t_ns < np.maximum.accumulate(block.t_ns))
        if len(late):
            self.report.num_reordered += len(late)
            order = np.argsort(block.t_ns, kind="stable")
            columns = (block.t_ns, block.t_device_ns, block.sequence, block.values)
            block = Block(*(column[order] for column in columns))
        t_ns = block.t_ns
        before = t_ns[:1] - 1 if self._first_ns is None else np.array([self._last_ns])
        repeats = np.concatenate([before, t_ns[:-1]]) == t_ns
        self._writer.append(
            self.report.stream,
            values=block.values,
            t_host_ns=t_ns,
            t_device_ns=block.t_device_ns,
            sequence=block.sequence,
        )
        if self._first_ns is None:
            self._first_ns = int(t_ns[0])
        self._last_ns = int(t_ns[-1])
        self.report.num_samples += len(block)
        self.report.num_repeated_stamps += int(repeats.sum())
        self.report.num_device_stamps += int((block.t_device_ns != NO_DEVICE_TIME).sum())

    def result(self) -> ImportedStream:
        self.report.notes = tuple(self._notes)
        if self._first_ns is not None:
            self.report.set_span(self._first_ns, self._last_ns)
        return self.report
