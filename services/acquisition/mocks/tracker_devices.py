"""Keypoints or poses come in; a simulated tracker by any link and its real driver go out."""

import threading
from dataclasses import dataclass
from typing import Literal

from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.bridge_tracker import (
    BridgeDriver,
    BridgeFingerTrackerDecoder,
    BridgePoseTrackerDecoder,
)
from services.acquisition.drivers.finger_tracker import FingerTracker
from services.acquisition.drivers.pose_tracker import PoseTrackerDecoder
from services.acquisition.mocks.bridge_server import BridgePort
from services.acquisition.mocks.bridge_sources import (
    BridgeFingerTrackerSource,
    BridgePoseSource,
    BridgeSource,
    sign_of_life,
)
from services.acquisition.mocks.faults import DeviceFaults, Schedule
from services.acquisition.mocks.finger_tracker import FingerTrackerSource
from services.acquisition.mocks.pair import MockPair
from services.acquisition.mocks.ports import HidPort
from services.acquisition.mocks.pose_tracker import PoseTrackerSource
from services.acquisition.mocks.replay import (
    SEQUENCE_MODULUS,
    MockDevice,
    ReplayStream,
    device_rng,
)
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
        """Send one sign of life; it has a number and no place in the ledger."""
        with self._numbering:
            sequence = self._next_sequence
            self._next_sequence = (sequence + 1) % SEQUENCE_MODULUS
            self.port.send(sign_of_life(self._magic, sequence, 0))

    def _send(self, index: int, schedule: Schedule) -> None:
        with self._numbering:
            super()._send(index, schedule)


def mock_finger_tracker(side: Side, stream: ReplayStream, place: TrackerPlace) -> MockPair:
    """A finger tracker of one hand.

    Args:
        side: which hand.
        stream: [n, 25, 3] in m, wrist frame.
        place: link, faults, seed and clock.
    """
    name, faults = f"finger_tracker_{side}", place.faults
    rng = device_rng(place.seed, f"noise_{name}")
    if place.link == "bridge":
        bridge = BridgeFingerTrackerSource(stream, side=side, rng=rng, faults=faults)
        return _bridged(name, bridge, BridgeFingerTrackerDecoder(side), place)
    source = FingerTrackerSource(
        stream, side=side, noise_m=faults.position_noise_m, rng=rng, faults=faults
    )
    port = REPORT_PORTS[place.link](name, answer=source.answer)
    driver = FingerTracker(name, side, transport=port.transport, clock=place.clock)
    device = MockDevice(name, source=source, port=port, faults=faults, seed=place.seed)
    return MockPair(device, driver)


def mock_pose_tracker(stream: ReplayStream, place: TrackerPlace) -> MockPair:
    """A pose tracker.

    Args:
        stream: float64 [n, 7], x y z (m) qw qx qy qz in the world frame.
        place: link, faults, seed and clock.
    """
    where = stream.descriptor.name
    name, faults = f"pose_tracker_{where}", place.faults
    rng = device_rng(place.seed, f"noise_{name}")
    if place.link == "bridge":
        bridge = BridgePoseSource(stream, faults=faults, rng=rng)
        return _bridged(name, bridge, BridgePoseTrackerDecoder(where), place)
    source = PoseTrackerSource(stream, faults=faults, rng=rng)
    port = REPORT_PORTS[place.link](name)
    decoder = PoseTrackerDecoder(where)
    driver = Driver(name, transport=port.transport, decoder=decoder, clock=place.clock)
    device = MockDevice(name, source=source, port=port, faults=faults, seed=place.seed)
    return MockPair(device, driver)


def _bridged(
    name: str,
    source: BridgeSource,
    decoder: BridgeFingerTrackerDecoder | BridgePoseTrackerDecoder,
    place: TrackerPlace,
) -> MockPair:
    port = BridgePort(name, source.hello)
    device = BridgedDevice(name, source=source, port=port, faults=place.faults, seed=place.seed)
    if not isinstance(place.clock, VirtualClock):
        port.show_life = device.show_life
    driver = BridgeDriver(name, transport=port.transport, decoder=decoder, clock=place.clock)
    return MockPair(device, driver)
