"""Simulated trackers by HID, USB or a bridge, cameras by a bridge or a bus, and a robot's state."""

import socket
import struct
from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from dextouch.hands import NODES, NUM_KEYPOINTS, chain_indices
from dextouch.tactile.layout import Side
from services.acquisition.clock import PeriodicCall, StationClock, VirtualClock, Waiter
from services.acquisition.devices import (
    camera,
    finger_tracker,
    pose_tracker,
    robot_state,
    station_camera,
)
from services.acquisition.devices.pose_tracker import TrackingResult, TrackingState
from services.acquisition.drivers.base import (
    DATA_REPORT,
    DESCRIPTOR_REPORT,
    Driver,
    split_into_reports,
)
from services.acquisition.drivers.images import ImageEncoder, ImageEncoding
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.sdk_link import (
    PROTOCOL,
    PROTOCOL_VERSION,
    BridgeDecoder,
    BridgeDriver,
    BridgeHello,
    FrameConvention,
)
from services.acquisition.mocks import replay
from services.acquisition.mocks.faults import DeviceFaults, Fate
from services.acquisition.mocks.ports import HidPort, ReportPort, SocketPort

# A left-handed sender in centimetres, and OpenVR's own frame: y up, looking along −z.
LEFT_HANDED = FrameConvention(handedness="left", axes=("+x", "+y", "-z"))
Y_UP = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
SOFTWARE = "dextouch mock bridge 1"
LIFE_PERIOD_NS = 50_000_000
# What an occluded tracker does not see.
_HIDDEN = chain_indices("thumb")
POSE_INDEX = 3
RESULTS = {
    TrackingState.UNINITIALIZED: TrackingResult.UNINITIALIZED,
    TrackingState.CALIBRATING: TrackingResult.CALIBRATING_IN_PROGRESS,
    TrackingState.OUT_OF_RANGE: TrackingResult.CALIBRATING_OUT_OF_RANGE,
    TrackingState.FALLBACK_ROTATION_ONLY: TrackingResult.FALLBACK_ROTATION_ONLY,
    TrackingState.RUNNING_OK: TrackingResult.RUNNING_OK,
}
UNIT_HEADER = struct.Struct("<qHH")
# With a virtual clock, time must not go on while an image is being encoded.
LOCKSTEP_WAIT_S = 20.0
DRIFT_M_PER_S = 0.5
# Further than a body moves between two samples of any tracker.
JUMP_M = (1.0, 0.0, 0.0)


class BridgeSource(replay.PacketSource):
    """What one bridge process says."""

    magic: bytes
    frame: FrameConvention

    @property
    @abstractmethod
    def hello(self) -> bytes:
        """The first line of a connection."""


def mock_hello(**says: object) -> bytes:
    """First line of a mock bridge's connections: `BridgeHello` without protocol and software."""
    made = {"protocol": PROTOCOL, "version": PROTOCOL_VERSION, "software": SOFTWARE, **says}
    hello = BridgeHello.model_validate(made)
    return hello.model_dump_json(exclude_none=True).encode() + b"\n"


class BridgePort(SocketPort):
    """A mock device's end of a bridge: a socket pair whose connections begin with the hello.

    While it is plugged, `life` says as often as a bridge that it lives. Without it a host on a real
    clock finds it silent while the device says nothing.
    """

    def __init__(self, name: str, hello: bytes) -> None:
        # The hello that waits in every new connection counts as sent.
        super().__init__(name, on_open=lambda: self.link.add_sent(len(self.hello)))
        self.life: PeriodicCall | None = None
        self.hello = hello

    def plug(self) -> None:
        """Accept connections, and show that the bridge lives."""
        super().plug()
        if self.life is not None:
            self.life.start()

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        if self.life is not None:
            self.life.stop()
        super().unplug()

    def _connect(self) -> socket.socket:
        host_end = super()._connect()
        if self._device_end is not None:
            self._device_end.sendall(self.hello)
        return host_end


def bridged_pair(
    slot: replay.MockSlot, source: BridgeSource, decoder: BridgeDecoder
) -> replay.MockPair:
    """A simulated device behind a bridge, and the driver that asks the bridge for it."""
    port, clock = BridgePort(slot.name, source.hello), slot.clock
    device = replay.MockDevice(slot, source, port)

    def sign_of_life(sequence: int) -> bytes:
        return encode_packet(source.magic, Packet(VERSION, SOURCES["none"], sequence, 0, b""))

    # With a virtual clock, time stands while nothing is sent.
    if not isinstance(clock, VirtualClock):
        port.life = PeriodicCall(
            partial(device.send_aside, sign_of_life),
            period_ns=LIFE_PERIOD_NS,
            clock=clock,
            name="bridge-life",
        )
    driver = BridgeDriver(slot.name, transport=port.transport, decoder=decoder, clock=clock)
    return replay.MockPair(device, driver)


class TrackedFingers(replay.PacketSource):
    """What a finger tracker sees of a hand [n, 25, 3] (m, wrist frame): noise, hidden nodes."""

    def __init__(
        self,
        stream: replay.ReplayStream,
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
        hidden = sum(1 << int(node) for node in np.flatnonzero(np.isin(self._order, _HIDDEN)))
        self._seen = np.full(len(stream.t_ns), finger_tracker.ALL_SEEN, dtype=np.int64)
        for start_s, stop_s in faults.occluded_s:
            during = (stream.t_ns >= start_s * 1e9) & (stream.t_ns < stop_s * 1e9)
            self._seen[during] &= ~hidden
        noise_m = faults.position_noise_m * rng.standard_normal(stream.values.shape)
        self._points_m = (stream.values + noise_m)[:, self._order]

    def fate(self, index: int) -> Fate:
        """Whether all nodes are seen."""
        return Fate.SENT if self._seen[index] == finger_tracker.ALL_SEEN else Fate.MARKED

    def packet(self, index: int, sequence: int, t_device_ns: int) -> bytes:
        """The data packet of one sample, in the sender's own coordinates."""
        points = self._sent(self._points_m[index]).astype("<f4")
        payload = finger_tracker.VALIDITY.pack(int(self._seen[index])) + points.tobytes()
        return encode_packet(
            finger_tracker.MAGIC,
            Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, payload),
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
            for number in (
                finger_tracker.CHAIN_IDS[NODES[node][0]],
                finger_tracker.JOINT_IDS[NODES[node][1]],
            )
        )
        packet = Packet(VERSION, SOURCES[self._side], 0, 0, payload)
        return split_into_reports(
            DESCRIPTOR_REPORT, 0, encode_packet(finger_tracker.DESCRIPTOR_MAGIC, packet)
        )


class BridgeFingerTrackerSource(TrackedFingers, BridgeSource):
    """A finger tracker's SDK: in its own frame and centimetres, nodes in its own order."""

    magic = finger_tracker.MAGIC
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


def mock_finger_tracker(slot: replay.MockSlot) -> replay.MockPair:
    """A finger tracker of one hand; the stream of its slot is [n, 25, 3] in m, wrist frame."""
    rng = replay.device_rng(slot.seed, f"noise_{slot.name}")
    if slot.link == "bridge":
        bridge = BridgeFingerTrackerSource(slot.stream, side=slot.side, rng=rng, faults=slot.faults)
        return bridged_pair(slot, bridge, finger_tracker.BridgeFingerTrackerDecoder(slot.side))
    source = FingerTrackerSource(slot.stream, side=slot.side, rng=rng, faults=slot.faults)
    port = HidPort(slot.name, answer=source.answer)
    driver = finger_tracker.FingerTracker(
        slot.name, slot.side, transport=port.transport, clock=slot.clock
    )
    return replay.MockPair(replay.MockDevice(slot, source, port), driver)


class TrackedPoses(replay.PacketSource):
    """What a tracker says of a body: poses [n, 7] with noise and tracking faults, and their truth.

    Poses are float64 x y z (m) qw qx qy qz in the world frame; noise is per axis.
    """

    def __init__(
        self, stream: replay.ReplayStream, *, faults: DeviceFaults, rng: np.random.Generator
    ) -> None:
        self.t_ns = stream.t_ns
        self.source = pose_tracker.source_of(stream.descriptor.name)
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
        payload = pose_tracker.PAYLOAD.pack(self.states[index], *self.poses[index])
        packet = Packet(VERSION, SOURCES[self.source], sequence, t_device_ns, payload)
        return split_into_reports(DATA_REPORT, sequence, encode_packet(pose_tracker.MAGIC, packet))


class BridgePoseSource(TrackedPoses, BridgeSource):
    """An OpenVR-like source of one tracker: y up, matrices, and a flag that stays set when lost."""

    magic = pose_tracker.POSE_MAGIC
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
        payload = pose_tracker.POSE_PAYLOAD.pack(POSE_INDEX, 1, result, t_device_ns / 1e9, *numbers)
        packet = Packet(VERSION, SOURCES[self.source], sequence, t_device_ns, payload)
        return [encode_packet(pose_tracker.POSE_MAGIC, packet)]

    @cached_property
    def _matrices(self) -> Float64[np.ndarray, "n 3 4"]:
        M = self.frame.ours_from_theirs().T
        R = M @ rotation_from_quaternion(self.poses[:, 3:]) @ M.T
        return np.concatenate([R, (self.poses[:, :3] @ M.T)[:, :, None]], axis=2)


def mock_pose_tracker(slot: replay.MockSlot) -> replay.MockPair:
    """A pose tracker; the stream of its slot is [n, 7], x y z (m) qw qx qy qz in the world."""
    stream, faults = slot.stream, slot.faults
    where = stream.descriptor.name
    rng = replay.device_rng(slot.seed, f"noise_{slot.name}")
    if slot.link == "bridge":
        bridge = BridgePoseSource(stream, faults=faults, rng=rng)
        return bridged_pair(slot, bridge, pose_tracker.BridgePoseTrackerDecoder(where))
    source, port = PoseTrackerSource(stream, faults=faults, rng=rng), HidPort(slot.name)
    decoder = pose_tracker.PoseTrackerDecoder(where)
    driver = Driver(slot.name, transport=port.transport, decoder=decoder, clock=slot.clock)
    return replay.MockPair(replay.MockDevice(slot, source, port), driver)


class CameraSource(replay.PacketSource):
    """Packets of one camera, of a stream uint8 [n, h, w, 3]."""

    def __init__(self, stream: replay.ReplayStream, *, encoding: ImageEncoding = "rgb8") -> None:
        self.t_ns = stream.t_ns
        self._images = stream.values
        self._encoding: ImageEncoding = encoding
        height_px, width_px = stream.descriptor.shape[:2]
        self._encoder = ImageEncoder(
            encoding, (height_px, width_px), rate_hz=stream.descriptor.nominal_rate_hz
        )
        self._last_sequence: int | None = None

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        image = self._images[index]
        header = camera.PAYLOAD_HEADER.pack(*image.shape[:2], camera.ENCODING_CODES[self._encoding])
        body = image.tobytes() if self._encoding == "rgb8" else self._encoded(index, sequence)
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, header + body)
        return [encode_packet(camera.MAGIC, packet)]

    def _encoded(self, index: int, sequence: int) -> bytes:
        # Packets that get lost were encoded too: a lost H.264 image tears its group.
        first = sequence if self._last_sequence is None else self._last_sequence + 1
        data = b""
        for number in range(max(first, sequence - index), sequence + 1):
            image = self._images[index - (sequence - number)]
            data = self._encoder.encode(image, begins=False).item()
        self._last_sequence = sequence
        return data


class VideoPort(ReportPort):
    """The device's end of a camera; each opening of the host gets a new capture."""

    # V4L2 drivers fill their buffers and lose later images.
    max_reports = 4
    transport: "MockCapture"

    def __init__(self, name: str) -> None:
        super().__init__()
        # What the camera states, if anything.
        self.exposure_ns: int | None = None
        self.transport = MockCapture(self, name)


class MockCapture(station_camera.CaptureLink[VideoPort]):
    """The host's end of a mock camera."""

    def __init__(self, port: VideoPort, name: str) -> None:
        super().__init__(address=f"mock:{name}", serial_number=name)
        self._port = port
        self._unit = b""

    def wait(self, timeout_s: float) -> bool:
        """Fetch the next image; images fetched before have been processed by now."""
        port = self._opened()
        port.link.add_consumed(len(self._unit))
        try:
            self._unit = port.fetch(timeout_s)
        except OSError as error:
            raise DeviceError(f"{self.info}: unplugged while reading") from error
        return bool(self._unit)

    def retrieve(self) -> station_camera.CapturedImage | None:
        """The image fetched."""
        t_driver_ns, height_px, width_px = UNIT_HEADER.unpack_from(self._unit)
        pixels = np.frombuffer(self._unit, dtype=np.uint8, offset=UNIT_HEADER.size)
        if pixels.size != height_px * width_px * 3:
            return None
        return station_camera.CapturedImage(pixels.reshape(height_px, width_px, 3), t_driver_ns)

    def _connect(self) -> VideoPort:
        port = self._port
        port.check_plugged()
        port.flush()
        port.link.set_open(is_open=True)
        self.exposure_ns, self._unit = port.exposure_ns, b""
        return port

    def _release(self, handle: VideoPort) -> None:
        handle.link.set_open(is_open=False)


class VideoSource(replay.PacketSource):
    """Images, uint8 [n, h, w, 3], with the stamps of the kernel."""

    def __init__(self, stream: replay.ReplayStream) -> None:
        self.t_ns = stream.t_ns
        self._images = stream.values

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One image; cameras have no sequence."""
        image = self._images[index]
        return [UNIT_HEADER.pack(t_device_ns, *image.shape[:2]) + image.tobytes()]


class VideoDevice(replay.MockDevice):
    """A mock device whose clock is the host's, since the host's kernel stamps its images."""

    def play(
        self, clock: StationClock, waiter: Waiter, *, start_host_ns: int, offset_ns: int = 0
    ) -> bool:
        """Play the whole source once, as every mock device does."""
        self._boot_ns = start_host_ns
        return super().play(clock, waiter, start_host_ns=start_host_ns, offset_ns=offset_ns)


def video_camera(slot: replay.MockSlot, **settings: float | str) -> replay.MockPair:
    """A mock camera that plays a stream of images, and its driver with other settings."""
    port, descriptor = VideoPort(slot.name), slot.stream.descriptor
    known = {
        "stream": slot.name,
        "rate_hz": descriptor.nominal_rate_hz,
        "height_px": descriptor.shape[0],
        "width_px": descriptor.shape[1],
    }
    driver = station_camera.StationCamera(
        station_camera.StationCameraSettings.model_validate({**known, **settings}),
        link=port.transport,
        clock=slot.clock,
        max_encode_wait_s=LOCKSTEP_WAIT_S,
    )
    return replay.MockPair(VideoDevice(slot, VideoSource(slot.stream), port), driver)


class RobotStateSource(replay.PacketSource):
    """Packets of one robot, of the six streams of `STREAM_SIZES`, all with the same times.

    Raises:
        InvalidInputError: one is missing, or their times differ.
    """

    def __init__(self, streams: Mapping[str, replay.ReplayStream]) -> None:
        missing = sorted(set(robot_state.STREAM_SIZES) - set(streams))
        if missing:
            raise InvalidInputError(f"robot state: streams {missing} are missing")
        parts = [streams[name] for name in robot_state.STREAM_SIZES]
        if any(not np.array_equal(part.t_ns, parts[0].t_ns) for part in parts):
            raise InvalidInputError("robot state: the six streams have different times")
        self.t_ns = parts[0].t_ns
        self._numbers = np.concatenate([part.values for part in parts], axis=1).astype("<f8")

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        payload = self._numbers[index].tobytes()
        packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, payload)
        return [encode_packet(robot_state.MAGIC, packet)]
