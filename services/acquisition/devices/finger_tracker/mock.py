"""Simulated finger tracker with its own node order, connected by HID, USB or a bridge."""

import numpy as np
from jaxtyping import Float64

from dextouch.hands import NODES, NUM_KEYPOINTS, chain_indices
from dextouch.tactile.layout import Side
from services.acquisition.devices.finger_tracker.driver import (
    ALL_SEEN,
    CHAIN_IDS,
    DESCRIPTOR_MAGIC,
    JOINT_IDS,
    MAGIC,
    VALIDITY,
    BridgeFingerTrackerDecoder,
    FingerTracker,
)
from services.acquisition.drivers.base import (
    DATA_REPORT,
    DESCRIPTOR_REPORT,
    split_into_reports,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.mocks.faults import DeviceFaults, Fate
from services.acquisition.mocks.ports import HidPort
from services.acquisition.mocks.replay import (
    MockDevice,
    MockPair,
    MockSlot,
    PacketSource,
    ReplayStream,
    device_rng,
)
from services.acquisition.mocks.sdk_link import (
    LEFT_HANDED,
    BridgeSource,
    bridged_pair,
    mock_hello,
)

# What an occluded tracker does not see.
_HIDDEN = chain_indices("thumb")


class TrackedFingers(PacketSource):
    """What a finger tracker sees of a hand: points with noise, and nodes that are hidden.

    Args:
        stream: [n, 25, 3] in m, wrist frame.
        side: which hand.
        rng: of the device's node order and of the noise.
        faults: position noise, and when the thumb is not seen.
    """

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        rng: np.random.Generator,
        faults: DeviceFaults | None = None,
    ) -> None:
        faults = faults or DeviceFaults()
        self.t_ns = stream.t_ns
        self._side = side
        self._order = rng.permutation(NUM_KEYPOINTS)
        # For each sample one bit a node, in the device's order: whether the device sees it.
        hidden = sum(1 << int(place) for place in np.flatnonzero(np.isin(self._order, _HIDDEN)))
        self._seen = np.full(len(stream.t_ns), ALL_SEEN, dtype=np.int64)
        for start_s, stop_s in faults.occluded_s:
            during = (stream.t_ns >= start_s * 1e9) & (stream.t_ns < stop_s * 1e9)
            self._seen[during] &= ~hidden
        noise_m = faults.position_noise_m * rng.standard_normal(stream.values.shape)
        self._points_m = (stream.values + noise_m)[:, self._order]

    def fate(self, index: int) -> Fate:
        """Whether all nodes are seen."""
        return Fate.SENT if self._seen[index] == ALL_SEEN else Fate.MARKED

    def packet(self, index: int, sequence: int, t_device_ns: int) -> bytes:
        """The data packet of one sample, in the sender's own coordinates."""
        points = self._sent(self._points_m[index]).astype("<f4")
        payload = VALIDITY.pack(int(self._seen[index])) + points.tobytes()
        return encode_packet(
            MAGIC, Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, payload)
        )

    def _sent(self, points_m: Float64[np.ndarray, "25 3"]) -> Float64[np.ndarray, "25 3"]:
        return points_m


class FingerTrackerSource(TrackedFingers):
    """Reports of one finger tracker."""

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet, split into reports."""
        return split_into_reports(DATA_REPORT, sequence, self.packet(index, sequence, t_device_ns))

    def answer(self, report: bytes) -> list[bytes]:
        """What the device says to the host's report: its nodes, when asked for them."""
        if report[:1] != bytes([DESCRIPTOR_REPORT]):
            return []
        payload = bytes(
            number
            for node in self._order
            for number in (CHAIN_IDS[NODES[node][0]], JOINT_IDS[NODES[node][1]])
        )
        packet = Packet(VERSION, SOURCES[self._side], 0, 0, payload)
        return split_into_reports(DESCRIPTOR_REPORT, 0, encode_packet(DESCRIPTOR_MAGIC, packet))


class BridgeFingerTrackerSource(TrackedFingers, BridgeSource):
    """A finger tracker's SDK: in its own frame and centimetres, nodes in its own order."""

    magic = MAGIC
    frame = LEFT_HANDED

    @property
    def hello(self) -> bytes:
        """Who is there, and the order of the nodes."""
        return mock_hello(
            kind="finger_tracker",
            devices=({"index": 0, "serial_number": f"MF-{self._side}", "source": self._side},),
            frame=self.frame,
            length_unit="cm",
            nodes=tuple(NODES[node] for node in self._order),
        )

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        return [self.packet(index, sequence, t_device_ns)]

    def _sent(self, points_m: Float64[np.ndarray, "25 3"]) -> Float64[np.ndarray, "25 3"]:
        return 100.0 * points_m @ self.frame.ours_from_theirs()


def mock_finger_tracker(place: MockSlot) -> MockPair:
    """A finger tracker of one hand; the stream of its place is [n, 25, 3] in m, wrist frame."""
    rng = device_rng(place.seed, f"noise_{place.name}")
    if place.link == "bridge":
        bridge = BridgeFingerTrackerSource(
            place.stream, side=place.side, rng=rng, faults=place.faults
        )
        return bridged_pair(place, bridge, BridgeFingerTrackerDecoder(place.side))
    source = FingerTrackerSource(place.stream, side=place.side, rng=rng, faults=place.faults)
    port = HidPort(place.name, answer=source.answer)
    driver = FingerTracker(place.name, place.side, transport=port.transport, clock=place.clock)
    return MockPair(MockDevice(place, source, port), driver)
