"""The replies of a simulated glove of ours to the requests of the host."""

import threading
from collections.abc import Callable

import numpy as np
from jaxtyping import UInt16

from dextouch.errors import PacketError
from dextouch.tactile.layout import Side
from services.acquisition.devices.tactile_glove.commands import (
    COMMAND_MAGIC,
    DIAGNOSTICS,
    MAX_TARE_PACKETS,
    REQUEST,
    TIME_SYNC,
    Command,
    Status,
    encode_identity,
    encode_reply,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, PacketDecoder

FIRMWARE = (1, 0, 0)


class GloveAnswers:
    """The commanding side of a mock glove.

    Args:
        side: which hand it says it is.
        serial_number: that it says it has.
        device_time_ns: gives what the glove's clock shows now.
    """

    def __init__(
        self, side: Side, *, serial_number: str, device_time_ns: Callable[[], int]
    ) -> None:
        self._side: Side = side
        self._serial_number = serial_number
        self._device_time_ns = device_time_ns
        self._start_ns: int | None = None
        self._requests = PacketDecoder(
            COMMAND_MAGIC, min_payload=REQUEST.size, max_payload=REQUEST.size
        )
        self._num_made = 0
        self._lock = threading.Lock()
        self._tare: tuple[Packet, int] | None = None
        self._block: list[np.ndarray] = []

    def answer(self, data: bytes) -> list[bytes]:
        """Replies to the requests that `data` completes; a tare is answered later."""
        t_received_ns = self._device_time_ns()
        if self._start_ns is None:
            self._start_ns = t_received_ns
        found = [self._reply(packet, t_received_ns) for packet in self._requests.feed(data)]
        return [reply for reply in found if reply is not None]

    def note_packet(self, counts: UInt16[np.ndarray, "360"]) -> list[bytes]:
        """The glove made a packet; gives the reply to a tare that it completes."""
        with self._lock:
            self._num_made += 1
            if self._tare is None:
                return []
            request, num_packets = self._tare
            self._block.append(counts)
            if len(self._block) < num_packets:
                return []
            mean = np.rint(np.mean(self._block, axis=0)).astype("<u2")
            self._tare = None
        return [self._encode(request, Status.OK, mean.tobytes())]

    def _reply(self, packet: Packet, t_received_ns: int) -> bytes | None:
        number, argument = REQUEST.unpack(packet.payload)
        if number not in list(Command):
            return self._encode(packet, Status.UNKNOWN_COMMAND, b"")
        command = Command(number)
        if command is Command.TARE:
            return self._start_tare(packet, argument)
        return self._encode(packet, Status.OK, self._body(command, t_received_ns))

    def _body(self, command: Command, t_received_ns: int) -> bytes:
        if command is Command.IDENTIFY:
            return encode_identity(self._serial_number, FIRMWARE)
        if command is Command.TIME_SYNC:
            return TIME_SYNC.pack(t_received_ns)
        if command is Command.DIAGNOSTICS:
            uptime_ns = t_received_ns - (self._start_ns or 0)
            damaged = self._requests.statistics.crc_errors
            return DIAGNOSTICS.pack(uptime_ns, self._num_made, damaged, 0)
        raise PacketError(f"mock glove: no body for {command!r}")

    def _start_tare(self, packet: Packet, num_packets: int) -> bytes | None:
        if not 1 <= num_packets <= MAX_TARE_PACKETS:
            return self._encode(packet, Status.BAD_ARGUMENT, b"")
        with self._lock:
            self._tare = (packet, num_packets)
            self._block = []
        return None

    def _encode(self, request: Packet, status: Status, body: bytes) -> bytes:
        now_ns = self._device_time_ns()
        made = Packet(VERSION, SOURCES[self._side], 0, now_ns, b"")
        return encode_reply(request, status, body, made=made)
