"""Packets of gloves that send only float32 values, which can be recognised only by their form.

The family (VOFA's "justfloat") has neither checksum nor sequence nor time: N float32s, then the
tail 00 00 80 7f, which is +infinity. A packet is released only between two tails exactly one
packet apart, and only when its numbers can be readings. A bit error that leaves such a number is
not seen by anyone; the stream's capabilities say so.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float32
from pydantic import Field, model_validator

from dextouch.errors import DeviceError
from dextouch.streams import ClockCapabilities, Sample
from dextouch.tactile.layout import Side, TactileLayout
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import DeviceKind, GloveSettings, serial_transport
from services.acquisition.drivers import base
from services.acquisition.drivers.packets import PortionedSearch

TAIL = b"\x00\x00\x80\x7f"
FLOAT_BYTES = 4
MAX_VALUES = 4096
# So many packets alike, but of another length than expected, are another device.
NUM_FOREIGN = 3
_SMALLEST_NORMAL = 0x00800000
_ONE = np.uint32(1)
_VALUE = np.dtype("<f4")


class JustFloatFrames(PortionedSearch[bytes]):
    """Finds the payloads of packets between tails."""

    def __init__(self, num_values: int, full_scale: float) -> None:
        super().__init__()
        self._payload = FLOAT_BYTES * num_values
        self._size = self._payload + len(TAIL)
        self._largest_bits = bits_of(full_scale)
        self._is_after_tail = False
        self._foreign = (0, 0)

    def reset(self) -> None:
        """Forget half a packet (the link was lost); counters stay."""
        super().reset()
        self._is_after_tail = False
        self._foreign = (0, 0)

    def _search(self, data: bytes) -> tuple[list[bytes], int]:
        """Payloads, and how many bytes are done with; DeviceError after three of another length."""
        found: list[bytes] = []
        position = 0
        while True:
            if not self._is_after_tail:
                position = self._seek(data, position)
                if not self._is_after_tail:
                    break
            end = position + self._payload
            if len(data) < end + len(TAIL):
                self._needed = end + len(TAIL)
                break
            if data.startswith(TAIL, end):
                position = self._release(data, position, found)
            elif len(data) < end + len(TAIL) + self._size:
                self._needed = end + len(TAIL) + self._size
                break
            else:
                position = self._pass_over(data, position)
        return found, position

    def _seek(self, data: bytes, position: int) -> int:
        """The place behind the next tail, or where to look on when more has come."""
        tail = data.find(TAIL, position)
        self._is_after_tail = tail >= 0
        unread = max(position, len(data) - len(TAIL) + 1)
        after = unread if tail < 0 else tail + len(TAIL)
        self.statistics.resync_bytes += after - position
        return after

    def _release(self, data: bytes, position: int, found: list[bytes]) -> int:
        """A tail stands on either side: give the packet if its numbers can be readings."""
        payload = data[position : position + self._payload]
        if not are_readings(np.frombuffer(payload, _VALUE), self._largest_bits):
            self.statistics.suspects += 1
            self._is_after_tail = False
            return position
        self.statistics.packets += 1
        self._foreign = (0, 0)
        found.append(payload)
        return position + self._size

    def _pass_over(self, data: bytes, position: int) -> int:
        """No tail where one belongs: its bits are wrong, or bytes are missing.

        If the tail after it is in place, only this packet is lost; otherwise the next tail is
        looked for from here on.
        """
        self.statistics.length_errors += 1
        next_tail = position + self._size + self._payload
        if data.startswith(TAIL, next_tail):
            self.statistics.resync_bytes += self._size
            return position + self._size
        self._note_length(data.find(TAIL, position) - position)
        self._is_after_tail = False
        return position

    def _note_length(self, length: int) -> None:
        if length <= 0 or length % FLOAT_BYTES:
            self._foreign = (0, 0)
            return
        same = self._foreign[1] + 1 if length == self._foreign[0] else 1
        self._foreign = (length, same)
        if same >= NUM_FOREIGN:
            self.reset()
            raise DeviceError(
                f"glove: sends packets of {length // FLOAT_BYTES} numbers, expected "
                f"{self._payload // FLOAT_BYTES}; is it another version? Set num_values to what "
                "it sends",
                event="wrong_version",
            )


class JustFloatGloveDecoder(base.StreamDecoder[bytes]):
    """Decodes one glove's byte stream to float32 [num_values], without stamp and number.

    Without a sequence, losses cannot be counted. Known versions send 401, 415 or 615 values;
    packets with larger ones than `full_scale` are held back. `label` is that of a further glove of
    this hand, `layout` None where only the calibration maps its taxels to those of `dextouch_v1`.
    """

    def __init__(
        self,
        side: Side,
        *,
        num_values: int,
        full_scale: float,
        rate_hz: float,
        label: str | None = None,
        layout: TactileLayout | None = None,
    ) -> None:
        if layout is not None:
            base.check_raw_cells(layout, num_values, device=f"glove_{side}")
        frames = JustFloatFrames(num_values, full_scale)
        # The device sends neither its unit nor its time.
        unit = "raw" if layout is None else base.raw_unit(layout)
        descriptor = base.glove_stream(
            side,
            label,
            shape=(num_values,),
            dtype="float32",
            unit=unit,
            layout=layout,
            nominal_rate_hz=rate_hz,
            capabilities=ClockCapabilities(),
        )
        super().__init__(descriptor, frames)
        self.cells = base.CellLayout(full_scale, grid=None)

    def _sample(self, packet: bytes, t_host_ns: int) -> Sample:
        return Sample(t_host_ns, np.frombuffer(packet, _VALUE))


def bits_of(full_scale: float) -> int:
    """The bit pattern of the largest reading."""
    return int(np.float32(full_scale).view(np.uint32))


def are_readings(values: Float32[np.ndarray, " n"], largest_bits: int) -> bool:
    """Whether every number is 0 or a normal number up to the one with the largest bits.

    Numbers below 1.2e-38 are what shifted bytes look like (the high half of a float is then zero),
    never readings: refusing them keeps a search from settling in the wrong place.
    """
    bits = values.view(np.uint32)
    # As bits, negative numbers, infinities and NaN are larger than any reading; less one, zero is
    # the largest, so that the smallest is the smallest of the rest.
    largest = int(np.maximum.reduce(bits))
    smallest = int(np.minimum.reduce(bits - _ONE)) + 1
    return largest <= largest_bits and smallest >= _SMALLEST_NORMAL


class JustFloatGloveSettings(GloveSettings):
    """Settings of a glove on a serial port whose packets do not describe themselves.

    Number of float32s, largest reading and nominal rate must be set where no `layout` says them.
    """

    kind: Literal["justfloat_glove"] = "justfloat_glove"
    num_values: int | None = Field(default=None, ge=1, le=MAX_VALUES)
    full_scale: float | None = Field(default=None, gt=0, le=1e30)
    rate_hz: float | None = Field(default=None, gt=0, le=10_000)

    @model_validator(mode="after")
    def _describes_the_packets(self) -> "JustFloatGloveSettings":
        names = ("num_values", "full_scale", "rate_hz")
        missing = [name for name in names if getattr(self, name) is None]
        if missing and self.layout is None:
            raise ValueError(
                f"got no {', '.join(missing)}, expected them, or a layout (a file) that says what "
                "this glove sends"
            )
        return self


def build(settings: JustFloatGloveSettings, clock: StationClock) -> base.Driver:
    """The driver of one glove."""
    transport = serial_transport(settings, device=settings.device)
    layout = settings.read_layout()

    def setting(name: str, of_layout: str) -> float:
        value = getattr(settings, name)
        # Validated: without a layout there is a value.
        return float(getattr(layout, of_layout) if value is None else value)

    decoder = JustFloatGloveDecoder(
        settings.side,
        num_values=int(setting("num_values", "num_raw_cells")),
        full_scale=setting("full_scale", "full_scale"),
        rate_hz=setting("rate_hz", "nominal_rate_hz"),
        label=settings.label,
        layout=layout,
    )
    return base.Driver(settings.device, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(
    name="justfloat_glove",
    settings=JustFloatGloveSettings,
    build=build,
    mock="services.acquisition.mocks.gloves:mock_justfloat_glove",
)
