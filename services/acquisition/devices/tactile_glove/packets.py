"""Data packets of our tactile glove: the decoder of their 360 raw counts, and their stream."""

from collections.abc import Callable

import numpy as np

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, Side
from services.acquisition.devices.tactile_glove.commands import MAX_REPLY, MIN_REPLY, REPLY_MAGIC
from services.acquisition.drivers.base import StreamDecoder, check_packet, hand_name
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


class TactileGloveDecoder(StreamDecoder[Packet]):
    """Decodes one glove's byte stream to uint16 counts [360] in raw scan order.

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
        packets = PacketDecoder(
            MAGIC,
            min_payload=PAYLOAD_BYTES,
            max_payload=PAYLOAD_BYTES,
            others={REPLY_MAGIC: (MIN_REPLY, MAX_REPLY)},
        )
        # Where the side is open, the stream is named for the left hand.
        super().__init__(glove_descriptor(side or "left", label), packets)
        self._side: Side | None = side
        self._device = f"glove_{'any' if side is None else hand_name(side, label)}"
        self._on_reply = on_reply

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        if packet.magic == REPLY_MAGIC:
            if self._on_reply is not None:
                self._on_reply(packet, t_host_ns)
            return None
        check_packet(packet, device=self._device, source=self._side)
        counts = np.frombuffer(packet.payload, _COUNT)
        return Sample(t_host_ns, counts, packet.t_device_ns, packet.sequence)
