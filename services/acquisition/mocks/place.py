"""Where a simulated device of a mock station stands, and the driver on its other end."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from dextouch.schemas import Matrix
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Decoder, Driver
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.ports import HidPort, PtyPort
from services.acquisition.mocks.replay import MockDevice, PacketSource, ReplayStream
from services.acquisition.mocks.usb_backend import UsbPort

TrackerLink = Literal["hid", "usb", "bridge"]
REPORT_PORTS = {"hid": HidPort, "usb": UsbPort}


@dataclass(frozen=True)
class MockPair:
    """A simulated device and the real driver on its other end.

    Attributes:
        device: plays the packets.
        driver: reads them.
        calibration: matrices by name that a calibrated station knows of such a device, such as
            `tactile_left_tare_counts`; none where its maker's devices come without them.
    """

    device: MockDevice
    driver: Driver
    calibration: Mapping[str, Matrix] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackerPlace:
    """What all trackers of a mock station share, and how this one is linked."""

    link: TrackerLink
    faults: DeviceFaults
    seed: int
    clock: StationClock


@dataclass(frozen=True)
class MockPlace:
    """One hand of a mock station.

    Attributes:
        side: which hand.
        stream: the pressures to play, float32 [n, 320] in kPa in anatomical order
            (`dextouch.tactile.layout`); `at_rate` resamples them to the rate of a glove.
        faults: what disturbs the device. Its source sees to `dead_taxels`, raw cells that read 0.
        seed: of everything random.
        clock: of the station.
    """

    side: Side
    stream: ReplayStream
    faults: DeviceFaults
    seed: int
    clock: StationClock

    @property
    def name(self) -> str:
        """The device's name: `glove_left` or `glove_right`."""
        return f"glove_{self.side}"


def serial_mock(
    place: MockPlace,
    *,
    source: PacketSource,
    decoder: Decoder,
    calibration: Mapping[str, Matrix] | None = None,
) -> MockPair:
    """A simulated device on a pseudo terminal, read by the real serial transport.

    Args:
        place: where it stands.
        source: what it sends.
        decoder: of its driver.
        calibration: what a calibrated station knows of it.
    """
    port = PtyPort(place.name)
    device = MockDevice(place.name, source=source, port=port, faults=place.faults, seed=place.seed)
    driver = Driver(place.name, transport=port.transport, decoder=decoder, clock=place.clock)
    return MockPair(device, driver, calibration or {})
