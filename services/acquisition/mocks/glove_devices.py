"""Pressures of one hand come in; a simulated glove of any family and its real driver go out."""

from typing import NamedTuple

from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.glove_driver import TactileGlove
from services.acquisition.drivers.glove_justfloat import JustFloatGloveDecoder
from services.acquisition.drivers.glove_wuji import WujiGloveDecoder
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.glove_answers import GloveAnswers
from services.acquisition.mocks.glove_justfloat import JustFloatGloveSource
from services.acquisition.mocks.glove_wuji import WujiGloveSource
from services.acquisition.mocks.ports import PtyPort
from services.acquisition.mocks.replay import MockDevice, PacketSource, ReplayStream
from services.acquisition.mocks.tactile_glove import GloveCalibration, TactileGloveSource

JUSTFLOAT_VALUES = 401
JUSTFLOAT_FULL_SCALE = 4095.0


class MockGlove(NamedTuple):
    """A simulated glove and the driver on its other end."""

    device: MockDevice
    driver: Driver


def mock_glove(  # noqa: PLR0913 - one argument a property of the glove
    side: Side,
    stream: ReplayStream,
    *,
    calibration: GloveCalibration,
    faults: DeviceFaults,
    seed: int,
    clock: StationClock,
    worn_side: Side | None = None,
) -> MockGlove:
    """Our own glove, which answers commands.

    Args:
        side: which hand's driver it is plugged into.
        stream: float32 [n, 320] in kPa.
        calibration: of this glove.
        faults: what disturbs it.
        seed: of everything random.
        clock: of the station.
        worn_side: which hand it says it is, if it is the wrong one.
    """
    name = f"glove_{side}"
    told: Side = worn_side or side
    clock_of: list[_DeviceClock] = []
    answers = GloveAnswers(
        told, serial_number=name, device_time_ns=lambda: clock_of[0].now_ns() if clock_of else 0
    )
    source = TactileGloveSource(
        stream,
        side=told,
        calibration=calibration,
        dead_taxels=faults.dead_taxels,
        answers=answers,
    )
    port = PtyPort(name, answer=answers.answer)
    device = MockDevice(name, source=source, port=port, faults=faults, seed=seed)
    clock_of.append(_DeviceClock(device, clock))
    driver = TactileGlove(side, transport=port.transport, clock=clock, serial_number=name)
    return MockGlove(device, driver)


def mock_wuji_glove(
    side: Side, stream: ReplayStream, *, faults: DeviceFaults, seed: int, clock: StationClock
) -> MockGlove:
    """A Wuji glove: CRC-16, a number of 16 bits, milliseconds."""
    source = WujiGloveSource(stream, side=side, dead_taxels=faults.dead_taxels)
    return _pair(side, source, WujiGloveDecoder(side), (faults, seed, clock))


def mock_justfloat_glove(
    side: Side, stream: ReplayStream, *, faults: DeviceFaults, seed: int, clock: StationClock
) -> MockGlove:
    """A glove that sends bare float32s at the rate of the stream."""
    source = JustFloatGloveSource(
        stream,
        num_values=JUSTFLOAT_VALUES,
        full_scale=JUSTFLOAT_FULL_SCALE,
        dead_taxels=faults.dead_taxels,
    )
    decoder = JustFloatGloveDecoder(
        side,
        num_values=JUSTFLOAT_VALUES,
        full_scale=JUSTFLOAT_FULL_SCALE,
        rate_hz=stream.descriptor.nominal_rate_hz,
    )
    return _pair(side, source, decoder, (faults, seed, clock))


def _pair(
    side: Side,
    source: PacketSource,
    decoder: WujiGloveDecoder | JustFloatGloveDecoder,
    setting: tuple[DeviceFaults, int, StationClock],
) -> MockGlove:
    name = f"glove_{side}"
    faults, seed, clock = setting
    port = PtyPort(name)
    device = MockDevice(name, source=source, port=port, faults=faults, seed=seed)
    return MockGlove(device, Driver(name, transport=port.transport, decoder=decoder, clock=clock))


class _DeviceClock:
    """What a mock device's clock shows now, told from the last packet that it made."""

    def __init__(self, device: MockDevice, clock: StationClock) -> None:
        self._device = device
        self._clock = clock

    def now_ns(self) -> int:
        """Device time; before the first packet, time since an origin of its own."""
        ledger = self._device.ledger
        now_ns = self._clock.now_ns()
        if not ledger.t_device_ns:
            return now_ns
        # The ledger is written by the player's thread: a column may be one row ahead.
        last = len(ledger.flipped_bits) - 1
        since_ns = now_ns - ledger.t_true_ns[last]
        skew_ns = round(since_ns * self._device.faults.skew_ppm * 1e-6)
        return ledger.t_device_ns[last] + since_ns + skew_ns
