"""Every driver behaves alike, on the mock device that speaks its bytes through the real transport.

A driver opens, reads, closes and opens again; flags an unplugged device within 300 ms; refuses the
other side's device and another version; gives what was sent, once and in order, and nothing else.
"""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import pytest

from dextouch.errors import DeviceError
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import VirtualClock
from services.acquisition.devices.finger_tracker import BridgeFingerTrackerDecoder
from services.acquisition.devices.pose_tracker import BridgePoseTrackerDecoder
from services.acquisition.devices.robot_state import STREAM_SIZES
from services.acquisition.drivers.base import Driver
from services.acquisition.drivers.sdk_link import BridgeDriver
from services.acquisition.mock_station import build_mocks
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import PacketSource, ReplayStream
from services.acquisition.mocks.trackers_and_cameras import (
    BridgeFingerTrackerSource,
    BridgePort,
    BridgePoseSource,
)
from services.acquisition.settings import MockLinks
from tests.unit.acquisition.sleepy_clock import SleepyClock
from tests.unit.acquisition.usb_bus import usb_trackers

BOOT_NS = 4_000_000_000_000
# The promise is tried by `make slow`; the default run must not need an idle machine.
within_s = pytest.mark.parametrize(
    "within_s", [60.0, pytest.param(0.3, marks=pytest.mark.slow)], ids=["at all", "in time"]
)


@dataclass
class Subject:
    """A plugged mock device, the same of the other side, and the real driver that reads it."""

    driver: Driver
    port: object
    source: PacketSource
    other_side: PacketSource | None
    next_sequence: int = 0
    found: dict = field(default_factory=dict)

    def units(self):
        """The next packet."""
        sequence, self.next_sequence = self.next_sequence, self.next_sequence + 1
        index = sequence % len(self.source.t_ns)
        t_device_ns = BOOT_NS + int(self.source.t_ns[index])
        return self.source.units(index, sequence, t_device_ns)

    def send(self, units):
        """Send a packet and read what comes of it."""
        for unit in units:
            assert self.port.send(unit)
        self.read(len(units))

    def read(self, num_reads):
        """Read so often, or until nothing more comes."""
        for _ in range(num_reads):
            readings = self.driver.read()
            for name, samples in readings.items():
                self.found.setdefault(name, []).extend(samples)

    def read_all(self, num_samples):
        """Read until so many samples of each stream are there, or two reads gave nothing."""
        idle = 0
        while idle < 2 and (not self.found or len(self.samples) < num_samples):
            before = self.driver.statistics.packets
            self.read(1)
            idle = idle + 1 if self.driver.statistics.packets == before else 0

    @property
    def samples(self):
        """Of the first stream."""
        return self.found.get(self.driver.descriptors[0].name, [])

    def close(self):
        self.driver.close()
        self.port.unplug()


STREAMS = {stream.descriptor.name: stream for stream in pattern_streams(1.0)}
RNG = np.random.default_rng


def robot_streams():
    t_ns = np.arange(60, dtype=np.int64) * 10_000_000
    streams = []
    for name, size in STREAM_SIZES.items():
        descriptor = StreamDescriptor(
            name=name,
            kind="robot_state",
            shape=(size,),
            dtype="float64",
            unit="any",
            nominal_rate_hz=100,
        )
        values = RNG(1).normal(size=(60, size))
        if size == 7:
            values[:, 3:] = [1.0, 0.0, 0.0, 0.0]
        streams.append(ReplayStream(descriptor, t_ns, values))
    return streams


class CameraSubject(Subject):
    """A camera on the station: its images are stamped with a clock of its host."""

    def __init__(self, pair, clock):
        super().__init__(pair.driver, pair.device.port, pair.device.source, None)
        self.clock = clock
        self.start_ns = clock.now_ns()

    def units(self):
        """The next image, when it is due."""
        sequence, self.next_sequence = self.next_sequence, self.next_sequence + 1
        due_ns = self.start_ns + sequence * self.driver.descriptors[0].period_ns()
        with self.clock.lock:
            self.clock._now_ns = due_ns
            self.clock.advance()
        return self.source.units(sequence % len(self.source.t_ns), sequence, due_ns)


def build(streams, links):
    clock = SleepyClock()
    pairs = build_mocks(streams, faults=FaultScript(), seed=1, clock=clock, links=links)
    return {pair.device.name: pair for pair in pairs}, clock


def from_factory(name, other=None, streams=None, links=None):
    def make():
        pairs, _ = build(streams() if streams else list(STREAMS.values()), links)
        source = pairs[other].device.source if other else None
        device = pairs[name].device
        return Subject(pairs[name].driver, device.port, device.source, source)

    return make


def station_camera():
    pairs, clock = build([STREAMS["camera_head"]], MockLinks(cameras="station"))
    return CameraSubject(pairs["camera_head"], clock)


def bridge_finger_sources():
    return [
        BridgeFingerTrackerSource(STREAMS[f"keypoints_{side}"], side=side, rng=RNG(1))
        for side in ("left", "right")
    ]


def bridge_pose_sources():
    return [
        BridgePoseSource(STREAMS[f"wrist_{side}"], faults=DeviceFaults(), rng=RNG(1))
        for side in ("left", "right")
    ]


def bridged(sources, decoder):
    port = BridgePort("bridge", sources[0].hello)
    driver = BridgeDriver(
        "bridged", transport=port.transport, decoder=decoder, clock=VirtualClock()
    )
    return Subject(driver, port, *sources)


def fingers(links):
    return from_factory("finger_tracker_left", "finger_tracker_right", links=links)


def poses(links):
    return from_factory("pose_tracker_wrist_left", "pose_tracker_wrist_right", links=links)


def by_usb(make):
    def make_by_usb():
        with usb_trackers():
            return make()

    return make_by_usb


HID, BRIDGE = (MockLinks(trackers=link) for link in ("hid", "bridge"))
SUBJECTS = {
    "glove by serial": from_factory("glove_left", "glove_right"),
    "wuji glove by serial": from_factory(
        "glove_left", "glove_right", links=MockLinks(gloves="wuji_glove")
    ),
    "fingers by hid": fingers(HID),
    "fingers by usb": by_usb(fingers(HID)),
    "fingers by bridge": fingers(BRIDGE),
    "pose by hid": poses(HID),
    "pose by usb": by_usb(poses(HID)),
    "pose by bridge": poses(BRIDGE),
    "camera by bridge": from_factory("camera_head"),
    "camera of the station": station_camera,
    "robot by socket": from_factory("robot_state", streams=robot_streams),
}
SIDED = [name for name in SUBJECTS if not name.startswith(("camera", "robot"))]
# Neither a Wuji glove nor a camera on the station's own bus tells a version.
VERSIONED = [
    name for name in SUBJECTS if name not in ("wuji glove by serial", "camera of the station")
]


def plugged(name):
    made = SUBJECTS[name]()
    made.port.plug()
    return made


@pytest.fixture(params=SUBJECTS)
def subject(request):
    made = plugged(request.param)
    yield made
    made.close()


@pytest.fixture(params=SIDED)
def sided(request):
    made = plugged(request.param)
    yield made
    made.close()


@pytest.fixture(params=VERSIONED)
def versioned(request):
    made = plugged(request.param)
    yield made
    made.close()


def exchange(subject, num_packets):
    """Sequence numbers of the samples that come of so many packets."""
    subject.found = {}
    for _ in range(num_packets):
        subject.send(subject.units())
    subject.read_all(num_packets)
    return [sample.sequence for sample in subject.samples]


def test_what_is_sent_comes_once_in_order_and_alike_in_all_streams(subject):
    subject.driver.open()
    assert exchange(subject, 20) == list(range(20))
    assert set(subject.found) == {d.name for d in subject.driver.descriptors}
    for samples in subject.found.values():
        assert [sample.sequence for sample in samples] == list(range(20))
    assert subject.driver.statistics.lost == 0
    for descriptor in subject.driver.descriptors:
        for sample in subject.found[descriptor.name]:
            assert sample.values.shape == descriptor.shape
            assert sample.values.dtype == descriptor.numpy_dtype()


@pytest.mark.long
def test_nothing_comes_of_nothing(subject):
    subject.driver.open()
    assert subject.driver.read() == {}
    assert exchange(subject, 3) == [0, 1, 2]
    assert subject.driver.read() == {}
    assert subject.driver.read() == {}


def test_closed_and_opened_again_it_goes_on(subject):
    subject.driver.open()
    first = exchange(subject, 3)
    subject.driver.close()
    subject.driver.close()
    with pytest.raises(DeviceError, match="not open"):
        subject.driver.read()
    subject.driver.open()
    assert first + exchange(subject, 3) == list(range(6))


def test_absent_device_is_an_error(subject):
    subject.port.unplug()
    with pytest.raises(DeviceError):
        subject.driver.open()


@within_s
def test_unplugging_is_flagged_within_300_ms_while_reading(subject, within_s):
    subject.driver.open()
    exchange(subject, 2)

    def read_until_lost():
        while True:
            subject.driver.read()

    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(read_until_lost)
        start_s = time.monotonic()
        subject.port.unplug()
        with pytest.raises(DeviceError):
            reading.result(timeout=60.0)
        assert time.monotonic() - start_s <= within_s


def test_replugging_mends_it_and_invents_nothing(subject):
    subject.driver.open()
    assert exchange(subject, 3) == [0, 1, 2]
    # Half a packet is on its way when the plug is pulled; two more are never sent.
    units = subject.units()
    subject.send([units[0][: len(units[0]) // 2]])
    subject.port.unplug()
    with pytest.raises(DeviceError):
        subject.read(50)
    subject.driver.close()
    subject.next_sequence += 2
    subject.port.plug()
    subject.driver.open()
    assert exchange(subject, 3) == [6, 7, 8]
    assert subject.driver.statistics.lost == 3


def test_half_a_packet_costs_only_itself(subject):
    subject.driver.open()
    assert exchange(subject, 2) == [0, 1]
    units = subject.units()
    half = units[: len(units) // 2] if len(units) > 1 else [units[0][: len(units[0]) // 2]]
    subject.send(half)
    assert exchange(subject, 4) == [3, 4, 5, 6]
    assert subject.driver.statistics.lost == 1


def test_another_version_is_refused(versioned, monkeypatch):
    versioned.driver.open()
    assert exchange(versioned, 2) == [0, 1]
    monkeypatch.setattr(sys.modules[type(versioned.source).__module__], "VERSION", 9)
    with pytest.raises(DeviceError, match="version 9") as caught:
        exchange(versioned, 2)
    assert caught.value.details["device"]
    assert versioned.samples == []


def test_the_other_sides_packets_are_refused(sided):
    sided.driver.open()
    assert exchange(sided, 2) == [0, 1]
    sided.source = sided.other_side
    with pytest.raises(DeviceError, match="'right'"):
        exchange(sided, 3)
    assert sided.samples == []


@pytest.mark.parametrize(
    ("sources", "decoder"),
    [
        (bridge_finger_sources, BridgeFingerTrackerDecoder("left")),
        (bridge_pose_sources, BridgePoseTrackerDecoder("wrist_left")),
    ],
)
def test_the_other_sides_bridge_is_refused_at_once(sources, decoder):
    subject = bridged(sources()[::-1], decoder)
    subject.port.plug()
    with pytest.raises(DeviceError, match="expected 'left'") as caught:
        subject.driver.open()
    assert caught.value.details["event"] == "wrong_side"
    subject.close()
