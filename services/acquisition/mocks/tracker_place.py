"""What all simulated trackers of a mock station share: link, faults, clock, and their bridge."""

import threading
from dataclasses import dataclass
from typing import Literal

from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.drivers.packets import SEQUENCE_MODULUS
from services.acquisition.drivers.sdk_link import BridgeDecoder, BridgeDriver
from services.acquisition.mocks.faults import DeviceFaults, Schedule
from services.acquisition.mocks.pair import MockPair
from services.acquisition.mocks.ports import HidPort
from services.acquisition.mocks.replay import MockDevice
from services.acquisition.mocks.sdk_link_server import BridgePort
from services.acquisition.mocks.sdk_link_sources import BridgeSource, sign_of_life
from services.acquisition.mocks.usb_backend import UsbPort

TrackerLink = Literal["hid", "usb", "bridge"]
REPORT_PORTS = {"hid": HidPort, "usb": UsbPort}


@dataclass(frozen=True)
class TrackerPlace:
    """What all trackers of a mock station share, and how this one is linked."""

    link: TrackerLink
    faults: DeviceFaults
    seed: int
    clock: StationClock


class BridgedDevice(MockDevice):
    """A device behind a bridge process, which shows that it lives while the device says nothing.

    Only on a real clock: with a virtual one, time stands while nothing is sent.
    """

    def __init__(
        self,
        name: str,
        *,
        source: BridgeSource,
        port: BridgePort,
        faults: DeviceFaults,
        seed: int,
    ) -> None:
        super().__init__(name, source=source, port=port, faults=faults, seed=seed)
        self._magic = source.magic
        # The bridge numbers all that it sends, in the order in which it sends it.
        self._numbering = threading.Lock()

    def show_life(self) -> None:
        """Send one heartbeat, which has a sequence number but no ledger entry."""
        with self._numbering:
            sequence = self._next_sequence
            self._next_sequence = (sequence + 1) % SEQUENCE_MODULUS
            self.port.send(sign_of_life(self._magic, sequence, 0))

    def _send(self, index: int, schedule: Schedule) -> None:
        with self._numbering:
            super()._send(index, schedule)


def bridged_pair(
    name: str,
    source: BridgeSource,
    decoder: BridgeDecoder,
    place: TrackerPlace,
) -> MockPair:
    """A simulated device behind a bridge, and the driver that asks the bridge for it."""
    port = BridgePort(name, source.hello)
    device = BridgedDevice(name, source=source, port=port, faults=place.faults, seed=place.seed)
    if not isinstance(place.clock, VirtualClock):
        port.show_life = device.show_life
    driver = BridgeDriver(name, transport=port.transport, decoder=decoder, clock=place.clock)
    return MockPair(device, driver)
