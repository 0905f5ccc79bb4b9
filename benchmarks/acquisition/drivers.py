"""Processor time per packet of every driver, fed with the reads of its transport."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.acquisition.decoders import make_families
from benchmarks.figures import Figure, every_round, interleaved
from dextouch.hands import NUM_KEYPOINTS
from dextouch.streams import StreamDescriptor
from services.acquisition.devices.camera import CameraDecoder, camera_descriptor
from services.acquisition.devices.finger_tracker import (
    BridgeFingerTrackerDecoder,
    FingerTrackerDecoder,
    keypoints_descriptor,
)
from services.acquisition.devices.pose_tracker import (
    BridgePoseTrackerDecoder,
    PoseTrackerDecoder,
    pose_descriptor,
)
from services.acquisition.devices.robot_state import (
    STREAM_SIZES,
    RobotStateDecoder,
    robot_descriptor,
)
from services.acquisition.drivers.base import DESCRIPTOR_REPORT, Decoder
from services.acquisition.drivers.images import ImageEncoding
from services.acquisition.mocks.cameras_and_robot import CameraSource, RobotStateSource
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.replay import PacketSource, ReplayStream
from services.acquisition.mocks.trackers import (
    BridgeFingerTrackerSource,
    BridgePoseSource,
    FingerTrackerSource,
    PoseTrackerSource,
)
from services.acquisition.transports import READ_BYTES

NUM_PACKETS = 300
NUM_IMAGES = 24
IMAGE_SIZE_PX = (480, 640)
PERIOD_NS = 10_000_000
NO_FAULTS = DeviceFaults()


@dataclass(frozen=True)
class DeviceTalk:
    """Recorded byte stream of one device.

    `greeting` and each of `packets` are lists of reads of its transport; `decoder` creates the
    decoder.
    """

    name: str
    decoder: Callable[[], Decoder]
    packets: Sequence[Sequence[bytes]]
    greeting: Sequence[bytes] = ()

    @property
    def packet_bytes(self) -> float:
        """Mean size of a packet on the wire."""
        return sum(len(read) for packet in self.packets for read in packet) / len(self.packets)

    @property
    def packet_reads(self) -> float:
        """Mean number of reads of a packet."""
        return sum(map(len, self.packets)) / len(self.packets)


def make_talks(*, seed: int) -> list[DeviceTalk]:
    """One device of each kind, without faults."""
    rng = np.random.default_rng(seed)
    gloves = [
        DeviceTalk(
            f"glove {family.name}",
            family.decoder,
            [[family.make(index, rng)] for index in range(NUM_PACKETS)],
        )
        for family in make_families()
    ]
    trackers = _trackers(rng)
    streams = {
        name: _stream(robot_descriptor(name), rng.uniform(-1.0, 1.0, size))
        for name, size in STREAM_SIZES.items()
    }
    robot = DeviceTalk("robot state", RobotStateDecoder, _packets(RobotStateSource(streams)))
    return [*gloves, *trackers, robot, *_cameras()]


def measure_drivers(
    talks: Iterable[DeviceTalk], num_rounds: int, *, on_step: Callable[[str], None]
) -> dict[str, Figure]:
    """µs a packet of processor time of each driver's decoder, in turns."""
    subjects = {talk.name: every_round(partial(_once, talk)) for talk in talks}
    found = interleaved(subjects, num_rounds, on_step=on_step)
    return {name: Figure.of(values) for name, values in found.items()}


def decode_all(talk: DeviceTalk, decoder: Decoder) -> int:
    """Feed all packets to a decoder and return the number of samples of all streams."""
    num_samples = 0
    for index, packet in enumerate(talk.packets, start=1):
        for read in packet:
            for samples in decoder.decode(read, index * PERIOD_NS).values():
                num_samples += len(samples)
    return num_samples


def _once(talk: DeviceTalk) -> float:
    decoder = talk.decoder()
    for read in talk.greeting:
        decoder.decode(read, 0)
    start_s = time.thread_time()
    decode_all(talk, decoder)
    return (time.thread_time() - start_s) / len(talk.packets) * 1e6


def _trackers(rng: np.random.Generator) -> list[DeviceTalk]:
    hand = _stream(keypoints_descriptor("left"), rng.uniform(-0.1, 0.1, (NUM_KEYPOINTS, 3)))
    wrist = _stream(pose_descriptor("wrist_left"), np.array([0.1, 0.2, 1.0, 0.8, 0.0, 0.6, 0.0]))
    fingers = FingerTrackerSource(
        hand, side="left", rng=rng, faults=DeviceFaults(position_noise_m=1e-4)
    )
    poses = PoseTrackerSource(wrist, faults=NO_FAULTS, rng=rng)
    bridged_fingers = BridgeFingerTrackerSource(hand, side="left", rng=rng)
    bridged_poses = BridgePoseSource(wrist, faults=NO_FAULTS, rng=rng)
    asking = bytes([DESCRIPTOR_REPORT])
    return [
        DeviceTalk(
            "finger tracker, HID",
            partial(FingerTrackerDecoder, "left"),
            _packets(fingers),
            fingers.answer(asking),
        ),
        DeviceTalk("pose tracker, HID", partial(PoseTrackerDecoder, "wrist_left"), _packets(poses)),
        DeviceTalk(
            "finger tracker, bridge",
            partial(BridgeFingerTrackerDecoder, "left"),
            _packets(bridged_fingers),
            [bridged_fingers.hello],
        ),
        DeviceTalk(
            "pose tracker, bridge",
            partial(BridgePoseTrackerDecoder, "wrist_left"),
            _packets(bridged_poses),
            [bridged_poses.hello],
        ),
    ]


def _cameras() -> list[DeviceTalk]:
    height_px, width_px = IMAGE_SIZE_PX
    rows, columns = np.mgrid[:height_px, :width_px]
    # Moving stripes: sharp enough not to count as blurred, and small once encoded.
    shifts = np.arange(NUM_IMAGES)[:, None, None, None]
    stripes = (8 * ((rows + columns) // 16))[None, :, :, None] + shifts
    images = np.broadcast_to(stripes % 256, (NUM_IMAGES, *IMAGE_SIZE_PX, 3)).astype(np.uint8)
    encodings: tuple[ImageEncoding, ...] = ("rgb8", "jpeg", "h264")
    talks = []
    for encoding in encodings:
        size = {"height_px": height_px, "width_px": width_px}
        descriptor = camera_descriptor("camera_head", **size, encoding="rgb8")
        source = CameraSource(_stream(descriptor, images), encoding=encoding)
        decoder = partial(CameraDecoder, "camera_head", **size, encoding=encoding)
        talks.append(DeviceTalk(f"camera, {encoding}", decoder, _packets(source)))
    return talks


def _stream(descriptor: StreamDescriptor, values: np.ndarray) -> ReplayStream:
    """A stream of many samples with the values of one."""
    if values.ndim == len(descriptor.shape):
        values = np.broadcast_to(values, (NUM_PACKETS, *values.shape))
    t_ns = PERIOD_NS * np.arange(len(values), dtype=np.int64)
    return ReplayStream(descriptor, t_ns, values)


def _packets(source: PacketSource) -> list[list[bytes]]:
    """Packets of a source, split into reads."""
    return [
        [
            unit[at : at + READ_BYTES]
            for unit in source.units(index, index, int(t_ns) + PERIOD_NS)
            for at in range(0, len(unit), READ_BYTES)
        ]
        for index, t_ns in enumerate(source.t_ns)
    ]
