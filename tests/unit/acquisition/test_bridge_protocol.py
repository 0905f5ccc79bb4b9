"""The hello of a bridge, its frame of reference, and what counts as new."""

import json
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from dextouch.errors import DeviceError
from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.devices.pose_tracker import pose_descriptor
from services.acquisition.drivers.packets import SOURCES, Packet, encode_packet
from services.acquisition.drivers.sdk_link import (
    MAX_HELLO_BYTES,
    BridgeDecoder,
    FrameConvention,
    FreshnessGate,
    parse_hello,
)
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.replay import ReplayStream
from services.acquisition.mocks.trackers_and_cameras import BridgePoseSource

MAGIC = b"DXFT"
MS = 1_000_000
HELLO = {
    "protocol": "dextouch-bridge",
    "version": 1,
    "kind": "pose_tracker",
    "software": "an SDK 2.1",
    "devices": [
        {"index": 3, "serial_number": "LHR-1", "source": "left"},
        {"index": 4, "serial_number": "LHR-2", "source": "right"},
        {"index": 5, "serial_number": "LHR-3", "source": "right"},
    ],
    "frame": {"handedness": "right", "axes": ["+x", "+z", "-y"]},
    "length_unit": "m",
}
FINGERS = {"kind": "finger_tracker", "nodes": [["wrist", "wrist"]]}


def line(**changes):
    return json.dumps({**HELLO, **changes}).encode() + b"\n"


class Listener(BridgeDecoder):
    """Gives a sample for every new packet, and remembers which device was chosen."""

    chosen = None

    def _learn(self, hello, chosen):
        self.chosen = chosen

    def _new_sample(self, packet, t_host_ns):
        return Sample(t_host_ns, np.zeros(7), packet.t_device_ns, packet.sequence)


def connection(source="left", serial_number=None):
    return Listener(
        "pose_tracker",
        pose_descriptor("wrist_left"),
        source=source,
        serial_number=serial_number,
        magic=MAGIC,
        payload_bytes=4,
    )


def packet(sequence, payload=b"1234", version=1):
    return encode_packet(MAGIC, Packet(version, SOURCES["left"], sequence, 7, payload))


@given(st.lists(st.integers(1, 60), min_size=1, max_size=40))
def test_portions_do_not_matter(sizes):
    data = line() + packet(0) + packet(1, b"") + packet(2)
    link, found, position = connection(), [], 0
    while position < len(data):
        size = sizes[position % len(sizes)]
        found += link.feed(data[position : position + size])
        position += size
    assert [p.sequence for p in found] == [0, 2]
    assert link.chosen.index == 3
    assert link.statistics.lost == 0
    assert link.statistics.resync_bytes == 0


@given(st.binary(max_size=400))
def test_no_first_line_breaks_it(data):
    link = connection()
    if b"\n" in data:
        with pytest.raises(DeviceError, match=r"hello|version"):
            link.feed(data)
    else:
        assert link.feed(data) == []
    assert link.hello is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"protocol": "another"}, "protocol"),
        ({"version": 2}, "version 2, expected 1"),
        ({**FINGERS, "devices": HELLO["devices"][:2]}, "is a finger_tracker"),
        (FINGERS, r"source \['left', 'right', 'right'\] are not all different"),
        ({"kind": "camera"}, "kind"),
        ({"length_unit": "inch"}, "length_unit"),
        ({"devices": []}, "devices"),
        ({"devices": [HELLO["devices"][0]] * 2}, "not all different"),
        ({"nodes": [["wrist", "wrist"]]}, "nodes"),
        ({"kind": "finger_tracker", "devices": HELLO["devices"][:2]}, "nodes"),
        ({"extra": 1}, "extra"),
        ({"frame": {"handedness": "left", "axes": ["+x", "+z", "-y"]}}, "right-handed"),
        ({"frame": {"handedness": "right", "axes": ["+x", "+x", "-y"]}}, "each of x, y and z"),
    ],
)
def test_hellos_that_do_not_fit_are_refused(changes, words):
    with pytest.raises(DeviceError, match=words):
        connection().feed(line(**changes))


@pytest.mark.parametrize(
    ("source", "serial_number", "index", "words"),
    [
        ("left", None, 3, None),
        ("left", "LHR-1", 3, None),
        ("right", "LHR-3", 5, None),
        ("right", None, None, "several devices are 'right'"),
        ("head", None, None, "expected 'head'"),
        ("left", "LHR-2", None, "expected 'left'"),
        ("left", "LHR-9", None, r"no device 'LHR-9'; present: LHR-1 \(left\)"),
    ],
)
def test_a_device_is_chosen_by_serial_number_or_place(source, serial_number, index, words):
    link = connection(source, serial_number)
    if words is None:
        link.feed(line())
        assert link.chosen.index == index
    else:
        with pytest.raises(DeviceError, match=words):
            link.feed(line())
        assert link.hello is None


def test_wrong_side_is_named():
    with pytest.raises(DeviceError) as caught:
        connection("left", "LHR-2").feed(line())
    assert caught.value.details["event"] == "wrong_side"


@pytest.mark.parametrize("end", [b"", b"\n"])
def test_an_endless_first_line_is_refused(end):
    link = connection()
    with pytest.raises(DeviceError, match=f"at most {MAX_HELLO_BYTES}"):
        link.feed(b"x" * (MAX_HELLO_BYTES + 1) + end)


def test_packets_of_another_version_are_refused():
    link = connection()
    with pytest.raises(DeviceError, match="version 2"):
        link.feed(line() + packet(0, version=2))


def test_packets_of_another_size_are_refused_and_counted():
    link = connection()
    assert link.feed(line() + packet(0, b"12")) == []
    assert link.statistics.refused == 1


def test_repeated_and_late_packets_are_left_out():
    link = connection()
    found = link.feed(line() + b"".join(packet(s) for s in (0, 1, 1, 3, 2, 4)))
    assert [p.sequence for p in found] == [0, 1, 3, 4]


def test_a_new_connection_begins_with_a_hello():
    link = connection()
    link.feed(line() + packet(5) + packet(6)[:9])
    link.reset()
    assert link.feed(line(devices=[HELLO["devices"][0] | {"index": 9}]) + packet(0)) != []
    assert link.chosen.index == 9


def test_hello_of_a_hello():
    hello = parse_hello(line(), device="any")
    assert parse_hello(hello.model_dump_json(exclude_none=True).encode(), device="any") == hello


@pytest.mark.parametrize(
    ("handedness", "axes", "theirs", "ours"),
    [
        ("right", ("+x", "+y", "+z"), (1, 2, 3), (1, 2, 3)),
        # OpenVR: x right, y up, z towards the viewer; ours: x right, y forward, z up.
        ("right", ("+x", "+z", "-y"), (1, 2, 3), (1, -3, 2)),
        # Left-handed, z forward: only z turns round.
        ("left", ("+x", "+y", "-z"), (1, 2, 3), (1, 2, -3)),
        # Left-handed, y up, z forward, to x right, y forward, z up.
        ("left", ("+x", "+z", "+y"), (1, 2, 3), (1, 3, 2)),
    ],
)
def test_frames(handedness, axes, theirs, ours):
    matrix = FrameConvention(handedness=handedness, axes=axes).ours_from_theirs()
    np.testing.assert_array_equal(matrix @ theirs, ours)
    np.testing.assert_array_equal(matrix @ matrix.T, np.eye(3))
    assert round(np.linalg.det(matrix)) == (1 if handedness == "right" else -1)


@given(st.permutations("xyz"), st.tuples(*[st.sampled_from("+-")] * 3))
def test_each_convention_has_one_handedness(names, signs):
    axes = [sign + name for sign, name in zip(signs, names, strict=True)]
    fits = []
    for handedness in ("left", "right"):
        try:
            FrameConvention(handedness=handedness, axes=axes)
        except ValidationError:
            continue
        fits.append(handedness)
    assert len(fits) == 1


def feed_gate(gate, delays_ms, period_ms=10.0, start_ns=5_000_000_000_000, step_ns=0):
    return [
        gate.admits(
            start_ns + round(index * period_ms * MS) + step_ns,
            10**9 + round((index * period_ms + delay_ms) * MS),
        )
        for index, delay_ms in enumerate(delays_ms)
    ]


def test_data_is_new_up_to_200_ms():
    gate = FreshnessGate()
    assert feed_gate(gate, [3.0, 202.9, 203.1, 3.0]) == [True, True, False, True]


def test_a_backlog_after_a_stall_is_not_taken_as_new():
    gate = FreshnessGate()
    # The station did not read for half a second: what waited is old, the last 200 ms are not.
    delays_ms = [1.0] * 50 + [max(1.0, 501.0 - 10.0 * k) for k in range(60)]
    admitted = feed_gate(gate, delays_ms)
    assert all(admitted[:50])
    assert [delay > 201.0 for delay in delays_ms[50:]] == [not new for new in admitted[50:]]


def test_a_stamp_that_stands_still_is_not_new():
    gate = FreshnessGate()
    assert gate.admits(100, 10**9)
    assert [gate.admits(100, 10**9 + k * MS) for k in range(1, 5)] == [False] * 4
    assert gate.admits(100 + 5 * MS, 10**9 + 5 * MS)


def test_clock_drift_is_no_age():
    gate = FreshnessGate()
    # An hour at 150 ppm: the source's clock falls 540 ms behind, slower than it may.
    delays_ms = [1.0 + 150e-6 * 100.0 * index for index in range(36_000)]
    assert all(feed_gate(gate, delays_ms, period_ms=100.0))


def test_a_restarted_source_clock_is_new():
    gate = FreshnessGate()
    assert all(feed_gate(gate, [1.0] * 5))
    assert gate.admits(77, 10**9 + 60 * MS)
    assert gate.admits(77 + 10 * MS, 10**9 + 70 * MS)


@pytest.mark.parametrize(("num_ahead", "ahead_ms"), [(100, 500.0), (1, 900.0)])
def test_a_clock_that_is_set_back_or_leapt_ahead_once_costs_a_moment(num_ahead, ahead_ms):
    """As NTP sets it on the source's machine: stamps go on behind those that came before."""
    gate = FreshnessGate()
    feed_gate(gate, [1.0] * num_ahead, step_ns=round(ahead_ms * MS))
    later = range(num_ahead, num_ahead + 200)
    admitted = [gate.admits(5 * 10**12 + 10 * k * MS, 10**9 + (10 * k + 1) * MS) for k in later]
    assert not admitted[0]
    assert all(admitted[25:])


def test_the_documented_hello_is_one():
    text = (Path(__file__).parents[3] / "docs" / "device_packets.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", text, flags=re.DOTALL)
    hello = parse_hello(example.replace("\n", "").encode(), device="any")
    assert hello.devices[0].index == 3


def test_bytes_never_change():
    descriptor = StreamDescriptor(
        name="wrist_left",
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=100,
    )
    pose = np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]])
    stream = ReplayStream(descriptor, np.zeros(1, np.int64), pose)
    source = BridgePoseSource(stream, faults=DeviceFaults(), rng=np.random.default_rng(1))
    assert source.hello == (
        b'{"protocol":"dextouch-bridge","version":1,"kind":"pose_tracker",'
        b'"software":"dextouch mock bridge 1","devices":[{"index":3,"serial_number":"LHR-left",'
        b'"source":"left"}],"frame":{"handedness":"right","axes":["+x","+z","-y"]},'
        b'"length_unit":"m"}\n'
    )
    (unit,) = source.units(0, 0x01020304, 1_500_000_000)
    assert unit[:22] == b"DXPM" + struct.pack("<BBIIQ", 1, 1, 64, 0x01020304, 1_500_000_000)
    assert unit[22:38] == struct.pack("<HBxid", 3, 1, 200, 1.5)
    # Rows of [R | t], y up.
    rows = struct.unpack("<12f", unit[38:86])
    assert rows == (1, 0, 0, 1, 0, 1, 0, 3, 0, 0, 1, -2)
    assert unit[86:] == zlib.crc32(unit[:86]).to_bytes(4, "little")
