"""A simulated pose tracker by HID, USB or a bridge, with occlusions, jumps and noise."""

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from services.acquisition.devices.pose_tracker.driver import (
    MAGIC,
    PAYLOAD,
    POSE_MAGIC,
    POSE_PAYLOAD,
    BridgePoseTrackerDecoder,
    PoseTrackerDecoder,
    TrackingResult,
    TrackingState,
    source_of,
)
from services.acquisition.drivers.base import DATA_REPORT, Driver, split_into_reports
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
from services.acquisition.mocks.sdk_link import Y_UP, BridgeSource, bridged_pair, mock_hello

POSE_INDEX = 3
RESULTS = {
    TrackingState.UNINITIALIZED: TrackingResult.UNINITIALIZED,
    TrackingState.CALIBRATING: TrackingResult.CALIBRATING_IN_PROGRESS,
    TrackingState.OUT_OF_RANGE: TrackingResult.CALIBRATING_OUT_OF_RANGE,
    TrackingState.FALLBACK_ROTATION_ONLY: TrackingResult.FALLBACK_ROTATION_ONLY,
    TrackingState.RUNNING_OK: TrackingResult.RUNNING_OK,
}
DRIFT_M_PER_S = 0.5
# Further than a body moves between two samples of any tracker.
JUMP_M = (1.0, 0.0, 0.0)


class TrackedPoses(PacketSource):
    """What a tracker says of a body: poses with noise and tracking faults, and the truth of these.

    Args:
        stream: float64 [n, 7], x y z (m) qw qx qy qz in the world frame.
        faults: position and rotation noise, per axis; occlusions and jumps.
        rng: of the noise.
    """

    def __init__(
        self,
        stream: ReplayStream,
        *,
        faults: DeviceFaults,
        rng: np.random.Generator,
    ) -> None:
        self.t_ns = stream.t_ns
        self.source = source_of(stream.descriptor.name)
        self.poses = np.array(stream.values, dtype=np.float64)
        shape = (len(self.poses), 3)
        self.poses[:, :3] += faults.position_noise_m * rng.standard_normal(shape)
        turns_rad = faults.rotation_noise_rad * rng.standard_normal(shape)
        R = rotation_from_quaternion(self.poses[:, 3:]) @ rotation_from_vector(turns_rad)
        self.poses[:, 3:] = quaternion_from_rotation(R)
        self.states = np.full(len(self.t_ns), int(TrackingState.RUNNING_OK))
        # The ledger of this source: the fault of each sample, "" if it has none.
        self.labels = np.full(len(self.t_ns), "", dtype="<U8")
        for window_s in faults.occluded_s:
            self.lose(*window_s)
        for window_s in faults.not_running_s:
            self.lose(*window_s, TrackingState.UNINITIALIZED)
        for window_s in faults.jumped_s:
            self.move(*window_s, JUMP_M)

    def lose(
        self, start_s: float, stop_s: float, state: TrackingState = TrackingState.OUT_OF_RANGE
    ) -> None:
        """The tracker is not seen for a while: another state, and a pose that drifts away."""
        during = self._labelled(start_s, stop_s, "occluded")
        self.states[during] = int(state)
        drift_s = (self.t_ns[during] - start_s * 1e9) / 1e9
        self.poses[during, 0] += DRIFT_M_PER_S * drift_s

    def move(self, start_s: float, stop_s: float, offset_m: tuple[float, float, float]) -> None:
        """The tracker says it runs for a while, but its pose is elsewhere by this much."""
        self.poses[self._labelled(start_s, stop_s, "jumped"), :3] += np.array(offset_m)

    def _labelled(self, start_s: float, stop_s: float, label: str) -> Bool[np.ndarray, " n"]:
        during = (self.t_ns >= start_s * 1e9) & (self.t_ns < stop_s * 1e9)
        self.labels[during] = label
        return during

    def fate(self, index: int) -> Fate:
        """What becomes of one sample if its packet arrives."""
        return Fate(str(self.labels[index]) or Fate.SENT)


class PoseTrackerSource(TrackedPoses):
    """Reports of one pose tracker."""

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet in one report."""
        payload = PAYLOAD.pack(self.states[index], *self.poses[index])
        packet = Packet(VERSION, SOURCES[self.source], sequence, t_device_ns, payload)
        return split_into_reports(DATA_REPORT, sequence, encode_packet(MAGIC, packet))


class BridgePoseSource(TrackedPoses, BridgeSource):
    """An OpenVR-like source of one tracker: y up, matrices, and a flag that stays set when lost."""

    magic = POSE_MAGIC
    frame = Y_UP

    @property
    def hello(self) -> bytes:
        """Who is there."""
        number = f"LHR-{self.source}"
        device = {"index": POSE_INDEX, "serial_number": number, "source": self.source}
        return mock_hello(kind="pose_tracker", devices=(device,), frame=self.frame, length_unit="m")

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; its pose is flagged valid whatever the result says."""
        result = RESULTS[TrackingState(int(self.states[index]))]
        numbers = self._matrices[index].ravel()
        payload = POSE_PAYLOAD.pack(POSE_INDEX, 1, result, t_device_ns / 1e9, *numbers)
        packet = Packet(VERSION, SOURCES[self.source], sequence, t_device_ns, payload)
        return [encode_packet(POSE_MAGIC, packet)]

    @cached_property
    def _matrices(self) -> Float64[np.ndarray, "n 3 4"]:
        M = self.frame.ours_from_theirs().T
        R = M @ rotation_from_quaternion(self.poses[:, 3:]) @ M.T
        return np.concatenate([R, (self.poses[:, :3] @ M.T)[:, :, None]], axis=2)


def mock_pose_tracker(place: MockSlot) -> MockPair:
    """A pose tracker; the stream of its place is [n, 7], x y z (m) qw qx qy qz in the world."""
    stream, faults = place.stream, place.faults
    where = stream.descriptor.name
    rng = device_rng(place.seed, f"noise_{place.name}")
    if place.link == "bridge":
        bridge = BridgePoseSource(stream, faults=faults, rng=rng)
        return bridged_pair(place, bridge, BridgePoseTrackerDecoder(where))
    source, port = PoseTrackerSource(stream, faults=faults, rng=rng), HidPort(place.name)
    decoder = PoseTrackerDecoder(where)
    driver = Driver(place.name, transport=port.transport, decoder=decoder, clock=place.clock)
    return MockPair(MockDevice(place, source, port), driver)
