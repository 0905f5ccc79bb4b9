"""The base of every driver: reads a transport, stamps what arrives and has it decoded."""

import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.schemas import Matrix
from dextouch.streams import TAXEL_UNIT, Sample, StreamDescriptor
from dextouch.tactile.layout import Side, TactileLayout
from services.acquisition.clock import StationClock
from services.acquisition.drivers.images import ImageQuality
from services.acquisition.drivers.packets import (
    SOURCE_NAMES,
    SOURCES,
    VERSION,
    DecoderStatistics,
    Found,
    Packet,
    PacketDecoder,
    PortionedSearch,
)
from services.acquisition.transports import Transport, TransportInfo

Readings = dict[str, list[Sample]]
REPORT_BYTES = 64
DATA_REPORT = 0x01
DESCRIPTOR_REPORT = 0x02
# report id, message counter, part, number of parts, bytes of payload in this part
REPORT_HEADER = struct.Struct("<BBBBB")
PART_BYTES = REPORT_BYTES - REPORT_HEADER.size
MAX_PARTS = 255


@dataclass(frozen=True)
class CellLayout:
    """A glove's largest reading, in the unit of its stream, and the grid of its cells.

    `grid` are rows and columns of a sample, row by row, None if the neighbours of cells are
    unknown; cells that read NaN from the start do not exist.
    """

    full_scale: float
    grid: tuple[int, int] | None


def raw_unit(layout: TactileLayout) -> str:
    """Unit of the raw stream of a glove, which is never that of taxels in anatomical order."""
    return "raw" if layout.unit == TAXEL_UNIT else layout.unit


def check_raw_cells(layout: TactileLayout, num_cells: int, *, device: str) -> None:
    """Check that a layout is one of a device that sends so many numbers.

    Raises:
        InvalidInputError: it is not.
    """
    if layout.num_raw_cells != num_cells:
        raise InvalidInputError(
            f"{device}: got layout {layout.name!r} with num_raw_cells {layout.num_raw_cells}, "
            f"expected {num_cells}, the numbers that this glove sends in each sample"
        )


class Decoder(ABC):
    """Bytes of one device → samples by stream, in the order in which they were taken.

    Attributes:
        descriptors: the streams it gives.
        statistics: what was seen so far.
        cells: full scale and grid of a glove's cells, by which health judges them; None where the
            decoder does not know them, or gives several streams.
    """

    descriptors: tuple[StreamDescriptor, ...]
    statistics: DecoderStatistics
    cells: CellLayout | None = None

    @property
    def quality(self) -> ImageQuality | None:
        """What a camera's images are like; None where nobody looks at them."""
        return None

    def events(self) -> Mapping[str, int]:
        """Counts since the start besides the statistics, by name; a take's ledger lists them so."""
        return {}

    @abstractmethod
    def reset(self) -> None:
        """Forget half a packet, since the link was lost."""

    @abstractmethod
    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Samples completed by `data`, which arrived at `t_host_ns`."""


class StreamDecoder(Decoder, Generic[Found]):
    """Base of a decoder whose packets become samples of one stream."""

    def __init__(self, descriptor: StreamDescriptor, packets: PortionedSearch[Found]) -> None:
        self.descriptors = (descriptor,)
        self.statistics = packets.statistics
        self._packets = packets
        self._name = descriptor.name

    def reset(self) -> None:
        """Forget half a packet, since the link was lost."""
        self._packets.reset()

    def feed(self, data: bytes, t_host_ns: int = 0) -> list[Sample]:
        """Samples completed by `data`.

        Args:
            data: the next bytes of the stream, in any portion.
            t_host_ns: when they arrived; 0 where only the content matters (a file of bytes).

        Raises:
            DeviceError: another version of the device, or another device than this one must be.
        """
        samples = []
        for packet in self._packets.feed(data):
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return samples

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """The same by the name of the stream."""
        samples = self.feed(data, t_host_ns)
        return {self._name: samples} if samples else {}

    @abstractmethod
    def _sample(self, packet: Found, t_host_ns: int) -> Sample | None:
        """The sample of a packet; None where it gives none."""


def hand_name(side: Side, label: str | None = None) -> str:
    """A hand's part in names of streams and devices: `left`, or `left_LABEL` of a further one."""
    return side if label is None else f"{side}_{label}"


def glove_stream(side: Side, label: str | None, **about: Any) -> StreamDescriptor:  # noqa: ANN401 - fields of a descriptor
    """The raw stream of one glove; `about` are shape, dtype, unit, rate and clock of its family."""
    hand = hand_name(side, label)
    return StreamDescriptor(
        name=f"tactile_{hand}", kind="tactile", side=side, device=f"glove_{hand}", **about
    )


class Driver:
    """One device: opens its transport, stamps what arrives, decodes it.

    The stamp is the transport's, or taken right after `read` returns; all packets of one read share
    it.
    """

    def __init__(
        self, name: str, *, transport: Transport, decoder: Decoder, clock: StationClock
    ) -> None:
        self.name = name
        self.transport = transport
        self.decoder = decoder
        self._clock = clock

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The streams of this device."""
        return self.decoder.descriptors

    @property
    def statistics(self) -> DecoderStatistics:
        """The decoder's counters."""
        return self.decoder.statistics

    @property
    def quality(self) -> ImageQuality | None:
        """What a camera's images are like; None of other devices."""
        return self.decoder.quality

    def begin_take(self) -> Mapping[str, Matrix]:
        """A take begins: what comes from now on must be readable without what came before.

        Returns:
            What the driver knows of its streams' calibration at this moment.
        """
        return {}

    @property
    def info(self) -> TransportInfo:
        """Where the device is."""
        return self.transport.info

    def events(self) -> dict[str, int]:
        """All that the decoder and this driver counted since the start, by name."""
        events = {**vars(self.statistics), **self.decoder.events()}
        return events if self.quality is None else {**events, **self.quality.events()}

    def open(self) -> None:
        """Open the transport.

        Raises:
            DeviceError: the device is not there.
        """
        self.decoder.reset()
        self.transport.open()

    def read(self) -> Readings:
        """New samples by stream; empty when nothing came.

        Raises:
            DeviceError: the device is disconnected or uses another protocol.
        """
        data = self.transport.read()
        t_host_ns = self.transport.arrived_ns or self._clock.now_ns()
        return self.decoder.decode(data, t_host_ns) if data else {}

    def close(self) -> None:
        """Close the transport."""
        self.transport.close()


def check_packet(packet: Packet, *, device: str, source: str | None) -> None:
    """Refuse packets of a device of another version or of the other hand.

    Raises:
        DeviceError: version or source differ.
    """
    if packet.version != VERSION:
        raise DeviceError(
            f"{device}: uses packet version {packet.version}, expected {VERSION}; update the "
            "device or this station",
            device=device,
            event="wrong_version",
        )
    if source is not None and packet.source != SOURCES[source]:
        got = SOURCE_NAMES.get(packet.source, str(packet.source))
        raise DeviceError(
            f"{device}: says it is {got!r}, expected {source!r}; is the wrong one plugged in?",
            device=device,
            event="wrong_side",
        )


def split_into_reports(report_id: int, counter: int, data: bytes) -> list[bytes]:
    """Reports that carry `data`, each exactly 64 bytes, padded with zeros.

    Raises:
        InvalidInputError: nothing to send, or more than 255 parts.
    """
    parts = [data[at : at + PART_BYTES] for at in range(0, len(data), PART_BYTES)]
    if not 1 <= len(parts) <= MAX_PARTS:
        raise InvalidInputError(
            f"report: got {len(data)} bytes, expected 1 … {MAX_PARTS * PART_BYTES}"
        )
    return [
        (REPORT_HEADER.pack(report_id, counter % 256, index, len(parts), len(part)) + part).ljust(
            REPORT_BYTES, b"\0"
        )
        for index, part in enumerate(parts)
    ]


class ReportReassembler:
    """Joins the parts of one message; a missing part costs that message alone."""

    def __init__(self) -> None:
        self.num_incomplete = 0
        self._parts: list[bytes] = []
        self._key = (0, 0, 0)

    def reset(self) -> None:
        """Forget half a message."""
        self.num_incomplete += bool(self._parts)
        self._parts = []

    def feed(self, report: bytes) -> tuple[int, bytes] | None:
        """(report id, message) when this report completes one; None of one that is malformed."""
        if len(report) != REPORT_BYTES:
            return None
        report_id, counter, part, num_parts, length = REPORT_HEADER.unpack_from(report)
        key = (report_id, counter, num_parts)
        if part >= num_parts or length > PART_BYTES:
            return None
        if part == 0:
            self.reset()
            self._key = key
        elif part != len(self._parts) or key != self._key:
            self.reset()
            return None
        self._parts.append(report[REPORT_HEADER.size : REPORT_HEADER.size + length])
        if part + 1 < num_parts:
            return None
        message, self._parts = b"".join(self._parts), []
        return report_id, message


class ReportDecoder(StreamDecoder[Packet]):
    """Base of the decoders of trackers by HID or USB, whose packets come in reports."""

    def __init__(self, descriptor: StreamDescriptor, packets: PacketDecoder) -> None:
        super().__init__(descriptor, packets)
        self.reports = ReportReassembler()

    def reset(self) -> None:
        """Forget half a message; another device may answer now."""
        super().reset()
        self.reports.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Samples completed by one report.

        Raises:
            DeviceError: another version of the device, or another device than expected.
        """
        message = self.reports.feed(data)
        if message is None or not self._is_data(*message):
            return {}
        return super().decode(message[1], t_host_ns)

    def _is_data(self, report_id: int, body: bytes) -> bool:
        """Whether a message is a data packet; what else it is was taken in."""
        return True
