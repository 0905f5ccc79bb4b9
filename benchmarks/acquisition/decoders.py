"""Decoders of gloves and simple baselines on a noisy line, and processor time of every driver."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool

from benchmarks.figures import Figure, every_round, interleaved
from dextouch.hands import NUM_KEYPOINTS
from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.devices.camera import CameraDecoder, camera_descriptor
from services.acquisition.devices.finger_tracker import (
    BridgeFingerTrackerDecoder,
    FingerTrackerDecoder,
    keypoints_descriptor,
)
from services.acquisition.devices.justfloat_glove import TAIL, JustFloatGloveDecoder
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
from services.acquisition.devices.tactile_glove import MAGIC, PAYLOAD_BYTES, TactileGloveDecoder
from services.acquisition.devices.wuji_glove import (
    CRC_OFFSET,
    HEAD,
    MARK,
    NUM_CELLS,
    PACKET_BYTES,
    STAMPS,
    WujiGloveDecoder,
    WujiPacket,
)
from services.acquisition.drivers.base import DESCRIPTOR_REPORT, Decoder, StreamDecoder
from services.acquisition.drivers.images import ImageEncoding
from services.acquisition.drivers.packets import HEADER, OVERHEAD, SOURCES, VERSION, Packet
from services.acquisition.drivers.packets import encode_packet as encode_ours
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.gloves import encode_justfloat, encode_wuji
from services.acquisition.mocks.replay import PacketSource, ReplayStream
from services.acquisition.mocks.trackers_and_cameras import (
    BridgeFingerTrackerSource,
    BridgePoseSource,
    CameraSource,
    FingerTrackerSource,
    PoseTrackerSource,
    RobotStateSource,
)
from services.acquisition.transports import READ_BYTES

NUM_VALUES = 401
FULL_SCALE = 4095.0
# The most frequent byte of an untouched glove.
TOUCHED_SHARE = 0.3
NO_CELL_SHARE = 0.3

# Decoder that maps the next bytes to the samples (baselines: payloads) of completed packets.
Feed = Callable[[bytes], Sequence[bytes] | Sequence[Sample]]


@dataclass(frozen=True)
class Family:
    """A packet family on a serial line.

    `make` creates a packet from its index and a generator; `payload` is the span of its readings;
    `decoder` creates our decoder, and `rivals` are factories of others.
    """

    name: str
    has_checksum: bool
    make: Callable[[int, np.random.Generator], bytes]
    payload: slice
    decoder: Callable[[], StreamDecoder[Packet] | StreamDecoder[WujiPacket] | StreamDecoder[bytes]]
    rivals: dict[str, Callable[[], Feed]]

    @property
    def ways(self) -> dict[str, Callable[[], Feed]]:
        """Our decoder and the baselines, by name."""
        return {"ours": lambda: self.decoder().feed, **self.rivals}


class FixedLength:
    """Baseline: whatever follows a mark is a packet of the usual length; nothing is checked."""

    def __init__(self, mark: bytes, size: int, payload: slice) -> None:
        self._mark, self._size, self._payload = mark, size, payload
        self._buffer = bytearray()

    def __call__(self, data: bytes) -> Sequence[bytes]:
        """Payloads of what is taken for packets."""
        buffer = self._buffer
        buffer += data
        found: list[bytes] = []
        position = 0
        while True:
            start = buffer.find(self._mark, position)
            if start < 0 or len(buffer) < start + self._size:
                position = start if start >= 0 else max(position, len(buffer) - len(self._mark))
                break
            found.append(bytes(buffer[start : start + self._size][self._payload]))
            position = start + self._size
        del buffer[:position]
        return found


class TailAlone:
    """Baseline for packets that end with a mark: the bytes before it, if their length fits."""

    def __init__(self, mark: bytes) -> None:
        self._mark, self._rest = mark, b""

    def __call__(self, data: bytes) -> Sequence[bytes]:
        """Payloads of what is taken for packets."""
        *found, self._rest = (self._rest + data).split(self._mark)
        return found


def payload_of(item: bytes | Sample) -> bytes:
    """Readings of a decoded item."""
    return item if isinstance(item, bytes) else item.values.tobytes()


def make_families() -> tuple[Family, ...]:
    """Create the families: our own packet, one with CRC-16, one without checksum."""
    ours_payload = slice(HEADER.size, HEADER.size + PAYLOAD_BYTES)
    ours_size = OVERHEAD + PAYLOAD_BYTES
    wuji_payload = slice(HEAD.size, CRC_OFFSET - STAMPS.size)
    return (
        Family(
            "dextouch",
            has_checksum=True,
            make=_make_ours,
            payload=ours_payload,
            decoder=partial(TactileGloveDecoder, "left"),
            rivals={"mark and length": lambda: FixedLength(MAGIC, ours_size, ours_payload)},
        ),
        Family(
            "wuji",
            has_checksum=True,
            make=_make_wuji,
            payload=wuji_payload,
            decoder=partial(WujiGloveDecoder, "left"),
            rivals={"mark and length": lambda: FixedLength(MARK, PACKET_BYTES, wuji_payload)},
        ),
        Family(
            "justfloat",
            has_checksum=False,
            make=_make_justfloat,
            payload=slice(0, 4 * NUM_VALUES),
            decoder=partial(
                JustFloatGloveDecoder,
                "left",
                num_values=NUM_VALUES,
                full_scale=FULL_SCALE,
                rate_hz=60.0,
            ),
            rivals={"tail alone": lambda: TailAlone(TAIL)},
        ),
    )


def _make_ours(index: int, rng: np.random.Generator) -> bytes:
    packet = Packet(VERSION, SOURCES["left"], index, index, rng.bytes(PAYLOAD_BYTES))
    return encode_ours(MAGIC, packet)


def _make_wuji(index: int, rng: np.random.Generator) -> bytes:
    cells = rng.random(NUM_CELLS, dtype=np.float32)
    cells[: round(NO_CELL_SHARE * NUM_CELLS)] = np.nan
    return encode_wuji(0, index, 8 * index, cells.tobytes())


def _make_justfloat(index: int, rng: np.random.Generator) -> bytes:
    counts = rng.integers(0, round(FULL_SCALE) + 1, NUM_VALUES)
    counts[rng.random(NUM_VALUES) >= TOUCHED_SHARE] = 0
    return encode_justfloat(counts.astype(np.float32))


BLOCK_PACKETS = 500
LINE_READ_BYTES = 4096


@dataclass(frozen=True)
class Line:
    """Error rates of a line."""

    bit_error_rate: float
    byte_loss_rate: float


@dataclass(frozen=True)
class Judgement:
    """Result of a decoder: `wrong` packets were never sent, `collateral` lost though undamaged."""

    family: str
    way: str
    sent: int
    touched: int
    delivered: int
    wrong: int
    collateral: int

    @property
    def wrong_share(self) -> float:
        """Share of wrong packets among the delivered ones."""
        return self.wrong / max(1, self.delivered)


def judge(
    family: Family,
    line: Line,
    num_packets: int,
    *,
    seed: int,
    on_block: Callable[[str], None] = lambda _: None,
) -> list[Judgement]:
    """Send packets once over the line and decode them with each decoder.

    The first and the last packets are excluded: a family without a start mark needs one packet to
    synchronize, and the last one may still be pending.
    """
    rng = np.random.default_rng(seed)
    feeds = {way: make() for way, make in family.ways.items()}
    seen = {way: np.zeros(num_packets, dtype=np.bool_) for way in feeds}
    counts = {way: [0, 0] for way in feeds}
    touched = np.zeros(num_packets, dtype=np.bool_)
    index_of: dict[int, int] = {}
    for first in range(0, num_packets, BLOCK_PACKETS):
        size = min(BLOCK_PACKETS, num_packets - first)
        packets = [family.make(first + index, rng) for index in range(size)]
        for index, packet in enumerate(packets):
            index_of[hash(packet[family.payload])] = first + index
        data, touched[first : first + size] = disturb(packets, line, rng)
        for way, feed in feeds.items():
            for payload in _decode(feed, data):
                found = index_of.get(hash(payload))
                counts[way][0] += 1
                if found is None:
                    counts[way][1] += 1
                else:
                    seen[way][found] = True
        on_block(f"{family.name}, packet {first + size}")
    judged = slice(1, num_packets - 3)
    return [
        Judgement(
            family.name,
            way,
            num_packets,
            int(touched.sum()),
            counts[way][0],
            counts[way][1],
            int((~seen[way] & ~touched)[judged].sum()),
        )
        for way in feeds
    ]


def disturb(
    packets: Sequence[bytes], line: Line, rng: np.random.Generator
) -> tuple[bytes, Bool[np.ndarray, " n"]]:
    """Apply the line's errors; returns the received bytes and a mask of damaged packets."""
    data = np.frombuffer(b"".join(packets), np.uint8).copy()
    ends = np.cumsum([len(packet) for packet in packets])
    num_bits = 8 * len(data)
    bits = np.unique(rng.integers(0, num_bits, rng.binomial(num_bits, line.bit_error_rate)))
    np.bitwise_xor.at(data, bits // 8, (1 << bits % 8).astype(np.uint8))
    lost = np.unique(rng.integers(0, len(data), rng.binomial(len(data), line.byte_loss_rate)))
    touched = np.zeros(len(packets), dtype=np.bool_)
    touched[np.searchsorted(ends, np.concatenate([bits // 8, lost]), side="right")] = True
    return np.delete(data, lost).tobytes(), touched


def count_split_differences(family: Family, line: Line, num_splits: int, *, seed: int) -> int:
    """Number of random splits of a damaged stream that change our decoder's output."""
    rng = np.random.default_rng(seed)
    packets = [family.make(index, rng) for index in range(60)]
    # Far more damage than on a real line, so that splits hit every kind of damage.
    worse = Line(30 * line.bit_error_rate, 30 * line.byte_loss_rate)
    data, _ = disturb(packets, worse, rng)
    whole = [payload_of(item) for item in family.ways["ours"]()(data)]
    different = 0
    for _ in range(num_splits):
        feed, position = family.ways["ours"](), 0
        found: list[bytes] = []
        longest = int(rng.choice([1, 3, 64, 746, 4096, 20_000]))
        while position < len(data):
            size = int(rng.integers(1, longest + 1))
            found += map(payload_of, feed(data[position : position + size]))
            position += size
        different += found != whole
    return different


def _decode(feed: Feed, data: bytes) -> list[bytes]:
    found: list[bytes] = []
    for position in range(0, len(data), LINE_READ_BYTES):
        found += map(payload_of, feed(data[position : position + LINE_READ_BYTES]))
    return found


WHOLE = 0
READ_SIZES = (64, WHOLE, 4096)
NUM_TIMED_PACKETS = 300


def measure_speed(
    families: Sequence[Family],
    num_rounds: int,
    *,
    seed: int,
    on_step: Callable[[str], None],
) -> Mapping[tuple[str, str, int], Figure]:
    """µs a packet of processor time, by family, way and bytes a read (0: one packet)."""
    rng = np.random.default_rng(seed)
    subjects = {}
    keys = {}
    for family in families:
        packets = [family.make(index, rng) for index in range(NUM_TIMED_PACKETS)]
        for way in family.ways:
            for size in READ_SIZES:
                name = f"{family.name}, {way}, {size or 'packet'}"
                subjects[name] = every_round(partial(_once, family, way, packets, size))
                keys[name] = (family.name, way, size)
    found = interleaved(subjects, num_rounds, on_step=on_step)
    return {keys[name]: Figure.of(values) for name, values in found.items()}


def _once(family: Family, way: str, packets: list[bytes], size: int) -> float:
    data = b"".join(packets)
    step = size or len(packets[0])
    portions = [data[at : at + step] for at in range(0, len(data), step)]
    feed = family.ways[way]()
    start_s = time.thread_time()
    for portion in portions:
        feed(portion)
    return (time.thread_time() - start_s) / len(packets) * 1e6


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
    subjects = {talk.name: every_round(partial(_driver_us, talk)) for talk in talks}
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


def _driver_us(talk: DeviceTalk) -> float:
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
