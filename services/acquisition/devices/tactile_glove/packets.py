"""Data packets of our tactile glove: the decoder of their 360 raw counts, and their stream."""

from collections.abc import Callable

import numpy as np

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, Side
from services.acquisition.devices.tactile_glove.commands import MAX_REPLY, MIN_REPLY, REPLY_MAGIC
from services.acquisition.drivers.base import Readings, check_packet, hand_name
from services.acquisition.drivers.frames import DecoderStatistics
from services.acquisition.drivers.packets import Packet, PacketDecoder

MAGIC = b"DXTG"
PAYLOAD_BYTES = 2 * NUM_RAW_TAXELS
NOMINAL_RATE_HZ = 60.0
FULL_SCALE_COUNTS = 65_535
_COUNT = np.dtype("<u2")


def glove_descriptor(side: Side, label: str | None = None) -> StreamDescriptor:
    """The raw stream of one glove."""
    return StreamDescriptor(
        name=f"tactile_{hand_name(side, label)}",
        kind="tactile",
        shape=(NUM_RAW_TAXELS,),
        dtype="uint16",
        unit="counts",
        nominal_rate_hz=NOMINAL_RATE_HZ,
        side=side,
        device=f"glove_{hand_name(side, label)}",
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


class TactileGloveDecoder:
    """Decodes one glove's byte stream.

    Args:
        side: which glove it must be; None takes any.
        on_reply: takes each reply to a command with its arrival; without it replies are passed
            over.
        label: of a further glove of this hand.
    """

    def __init__(
        self,
        side: Side | None = None,
        *,
        on_reply: Callable[[Packet, int], None] | None = None,
        label: str | None = None,
    ) -> None:
        self._packets = PacketDecoder(
            MAGIC,
            min_payload=PAYLOAD_BYTES,
            max_payload=PAYLOAD_BYTES,
            others={REPLY_MAGIC: (MIN_REPLY, MAX_REPLY)},
        )
        self._side: Side | None = side
        self._device = f"glove_{'any' if side is None else hand_name(side, label)}"
        self._descriptor = glove_descriptor(side or "left", label)
        self._on_reply = on_reply

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far."""
        return self._packets.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The raw stream (named for the left hand when the side is open)."""
        return (self._descriptor,)

    def reset(self) -> None:
        """Forget half a packet."""
        self._packets.reset()

    def feed(self, data: bytes, t_host_ns: int = 0) -> list[Sample]:
        """Samples (uint16 counts [360], raw scan order) completed by `data`.

        Args:
            data: the next bytes of the stream, in any portion.
            t_host_ns: when they arrived; 0 where only the content matters (a file of bytes).

        Raises:
            DeviceError: another packet version or the other hand's glove.
        """
        samples = []
        for packet in self._packets.feed(data):
            if packet.magic == REPLY_MAGIC:
                if self._on_reply is not None:
                    self._on_reply(packet, t_host_ns)
                continue
            check_packet(packet, device=self._device, source=self._side)
            counts = np.frombuffer(packet.payload, _COUNT)
            samples.append(Sample(t_host_ns, counts, packet.t_device_ns, packet.sequence))
        return samples

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """The same by stream name."""
        samples = self.feed(data, t_host_ns)
        return {self._descriptor.name: samples} if samples else {}
