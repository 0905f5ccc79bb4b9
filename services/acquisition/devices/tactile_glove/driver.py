"""Driver of our tactile glove, which also asks it for its identity, its time and a tare."""

import itertools
import threading
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt16

from dextouch.clocks import RoundTrip
from dextouch.errors import DeviceError, InvalidInputError
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.devices.tactile_glove.commands import (
    MAX_TARE_PACKETS,
    Command,
    GloveDiagnostics,
    GloveIdentity,
    Status,
    encode_request,
    parse_diagnostics,
    parse_identity,
    parse_reply,
    parse_tare,
    parse_time,
)
from services.acquisition.devices.tactile_glove.packets import NOMINAL_RATE_HZ, TactileGloveDecoder
from services.acquisition.drivers.base import Driver, Readings, hand_name
from services.acquisition.drivers.packets import SEQUENCE_MODULUS, Packet
from services.acquisition.transports.base import Transport

ANSWER_TIMEOUT_NS = 300_000_000
NUM_ATTEMPTS = 3
# A virtual clock does not advance while a device is opened; count empty reads instead.
MAX_SILENT_READS = 5


class Answer(NamedTuple):
    """The glove's answer to a request, and when the host asked and was answered."""

    body: bytes
    packet: Packet
    t_asked_host_ns: int
    t_answered_host_ns: int


class TactileGlove(Driver):
    """Reads one glove and asks it things.

    Every opening asks who it is: a glove of another serial number or of the other hand is
    refused by name before any sample is taken from it.

    Args:
        side: which hand's glove it must be.
        transport: where it is.
        clock: of the station.
        serial_number: that it must have; None takes any.
        label: of a further glove of this hand.
    """

    def __init__(
        self,
        side: Side,
        *,
        transport: Transport,
        clock: StationClock,
        serial_number: str | None = None,
        label: str | None = None,
    ) -> None:
        decoder = TactileGloveDecoder(side, on_reply=self._accept, label=label)
        name = f"glove_{hand_name(side, label)}"
        super().__init__(name, transport=transport, decoder=decoder, clock=clock)
        self.identity: GloveIdentity | None = None
        self._side: Side = side
        self._serial_number = serial_number
        self._numbers = itertools.count(1)
        self._asked: set[int] = set()
        self._replies: dict[int, tuple[Packet, int]] = {}
        self._answered = threading.Condition()
        self._writing = threading.Lock()
        self._held: Readings = {}
        self._reader: int | None = None

    def open(self) -> None:
        """Open the transport and ask the glove who it is.

        Raises:
            DeviceError: absent, silent, or another glove than this one should be.
        """
        self._reader = threading.get_ident()
        self._held = {}
        self.identity = None
        super().open()
        identity = self.identify()
        self._check(identity)
        self.identity = identity

    def read(self) -> Readings:
        """New samples by stream; those that came during a request of this thread go first."""
        self._reader = threading.get_ident()
        if self._held:
            held, self._held = self._held, {}
            return held
        return super().read()

    def identify(self) -> GloveIdentity:
        """Serial number, firmware and side, as reported by the glove."""
        answer = self._ask(Command.IDENTIFY)
        return parse_identity(answer.body, answer.packet.source)

    def diagnostics(self) -> GloveDiagnostics:
        """The glove's own counters."""
        return parse_diagnostics(self._ask(Command.DIAGNOSTICS).body)

    def time_round_trip(self) -> RoundTrip:
        """One request for the glove's time; `dextouch.clocks.RoundTripClock` takes many of them."""
        body, packet, t_asked_ns, t_answered_ns = self._ask(Command.TIME_SYNC)
        return RoundTrip(t_asked_ns, parse_time(body), packet.t_device_ns, t_answered_ns)

    def tare(self, num_packets: int) -> UInt16[np.ndarray, "360"]:
        """Mean counts of the next packets, in raw scan order; the glove must be without load.

        Args:
            num_packets: 1 … 600.

        Raises:
            InvalidInputError: another number.
            DeviceError: no answer in twice the time that the packets take.
        """
        if not 1 <= num_packets <= MAX_TARE_PACKETS:
            raise InvalidInputError(f"tare: got {num_packets}, expected 1 … {MAX_TARE_PACKETS}")
        timeout_ns = ANSWER_TIMEOUT_NS + round(2e9 * num_packets / NOMINAL_RATE_HZ)
        answer = self._ask(Command.TARE, argument=num_packets, timeout_ns=timeout_ns)
        return parse_tare(answer.body)

    def _check(self, identity: GloveIdentity) -> None:
        where = f"{self.name}: the glove {identity.serial_number!r} at {self.info.address}"
        if self._serial_number not in (None, identity.serial_number):
            raise DeviceError(
                f"{where} is not {self._serial_number!r}; are two gloves swapped, or is the "
                "serial number in the settings that of another glove?",
                device=self.name,
                event="wrong_serial_number",
            )
        if identity.side != self._side:
            raise DeviceError(
                f"{where} says it is {identity.side!r}, expected {self._side!r}; left and right "
                "are swapped: swap the gloves or their entries in the settings",
                device=self.name,
                event="wrong_side",
            )

    def _ask(
        self, command: Command, *, argument: int = 0, timeout_ns: int = ANSWER_TIMEOUT_NS
    ) -> Answer:
        for _ in range(NUM_ATTEMPTS):
            number = next(self._numbers) % SEQUENCE_MODULUS
            data = encode_request(command, argument=argument, request=number)
            t_asked_ns, reply = self._ask_once(number, data, timeout_ns)
            if reply is not None:
                packet, t_answered_ns = reply
                return Answer(self._body(command, packet), packet, t_asked_ns, t_answered_ns)
        raise DeviceError(
            f"{self.name}: no answer to {command.name.lower()} from {self.info} in "
            f"{NUM_ATTEMPTS} attempts; is it a glove of this protocol?",
            device=self.name,
        )

    def _ask_once(
        self, number: int, data: bytes, timeout_ns: int
    ) -> tuple[int, tuple[Packet, int] | None]:
        try:
            with self._writing:
                self._asked.add(number)
                t_asked_ns = self._clock.now_ns()
                self.transport.write(data)
            return t_asked_ns, self._await(number, timeout_ns)
        finally:
            # Also replies that arrived too late: a station sends requests for months.
            with self._answered:
                self._asked.discard(number)
                self._replies.pop(number, None)

    def _await(self, number: int, timeout_ns: int) -> tuple[Packet, int] | None:
        """The reply; read here if this is the reading thread, else that one brings it."""
        if self._reader in (None, threading.get_ident()):
            return self._read_until(number, timeout_ns)
        with self._answered:
            self._answered.wait_for(lambda: number in self._replies, timeout_ns * 1e-9)
            return self._replies.pop(number, None)

    def _read_until(self, number: int, timeout_ns: int) -> tuple[Packet, int] | None:
        end_ns = self._clock.now_ns() + timeout_ns
        num_silent = 0
        while number not in self._replies:
            if num_silent >= MAX_SILENT_READS or self._clock.now_ns() > end_ns:
                return None
            data = self.transport.read()
            num_silent = 0 if data else num_silent + 1
            if data:
                for name, samples in self.decoder.decode(data, self._clock.now_ns()).items():
                    self._held.setdefault(name, []).extend(samples)
        return self._replies.pop(number)

    def _accept(self, packet: Packet, t_host_ns: int) -> None:
        """A reply came (called by the decoder); unexpected replies are ignored."""
        with self._answered:
            if packet.sequence in self._asked:
                self._replies[packet.sequence] = (packet, t_host_ns)
                self._answered.notify_all()

    def _body(self, command: Command, packet: Packet) -> bytes:
        answered, status, body = parse_reply(packet)
        if answered != command:
            raise DeviceError(
                f"{self.name}: answered command {answered}, expected {int(command)}",
                device=self.name,
            )
        if status is not Status.OK:
            raise DeviceError(
                f"{self.name}: refused {command.name.lower()} with {status.name.lower()}; does its "
                "firmware know the command?",
                device=self.name,
            )
        return body
