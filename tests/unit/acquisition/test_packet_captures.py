"""Packets of every device family, written byte by byte from docs/device_packets.md.

Nothing here uses our encoders or struct layouts: bytes are hexadecimal literals, and checksums come
from zlib and binascii. IEEE numbers used: 3f800000 is 1, 3f000000 0.5, 3e800000 0.25, be800000
−0.25 (float32); 3ff0… is 1, 3fe0… 0.5, 4000… 2 (float64).
"""

import binascii
import json
import struct
import zlib

import numpy as np
import pytest

from services.acquisition.devices.camera import CameraDecoder
from services.acquisition.devices.finger_tracker import (
    BridgeFingerTrackerDecoder,
    FingerTrackerDecoder,
)
from services.acquisition.devices.justfloat_glove import JustFloatGloveDecoder
from services.acquisition.devices.pose_tracker import (
    BridgePoseTrackerDecoder,
    PoseTrackerDecoder,
)
from services.acquisition.devices.robot_state import RobotStateDecoder
from services.acquisition.devices.tactile_glove import (
    TactileGloveDecoder,
    encode_request,
    parse_identity,
    parse_reply,
    parse_time,
)
from services.acquisition.devices.wuji_glove import WujiGloveDecoder

ARRIVED_NS = 5_000_000_000
SEQUENCE = 0x0A0B0C0D
T_DEVICE_NS = 0x0000_0102_0304_0506
SEQUENCE_AND_TIME = "0d0c0b0a 0605040302010000"
ONE, HALF, QUARTER, MINUS_QUARTER = "0000803f", "0000003f", "0000803e", "000080be"
LEFT, RIGHT, HEAD, NO_SOURCE = "01", "02", "03", "00"


def captured(text):
    """Bytes of hexadecimal text, and their CRC-32 behind them."""
    body = bytes.fromhex(text)
    return body + zlib.crc32(body).to_bytes(4, "little")


def reports(first_bytes, message):
    """HID reports: 5 bytes of header, 59 of the message, padded with zeros."""
    parts = [message[at : at + 59] for at in range(0, len(message), 59)]
    return [
        (first_bytes + bytes([i, len(parts), len(part)]) + part).ljust(64, b"\0")
        for i, part in enumerate(parts)
    ]


def only(readings, stream, *, sequence=SEQUENCE, t_device_ns=T_DEVICE_NS):
    """The one sample of a stream, with the stamps of the capture."""
    (sample,) = readings[stream]
    assert (sample.t_host_ns, sample.sequence) == (ARRIVED_NS, sequence)
    assert sample.t_device_ns == t_device_ns
    return sample.values


def test_checksum_is_the_one_of_the_catalogues():
    assert captured(b"123456789".hex())[9:].hex() == "2639f4cb"


# 360 counts: cell n of the scan shows 256 · (n modulo 256) + 7, low byte first.
GLOVE_COUNTS = "".join(f"07{number % 256:02x}" for number in range(360))
GLOVE = captured(f"44585447 01 {LEFT} d0020000 {SEQUENCE_AND_TIME} {GLOVE_COUNTS}")


def test_tactile_glove():
    assert len(GLOVE) == 746
    decoder = TactileGloveDecoder("left")
    counts = only(decoder.decode(GLOVE, ARRIVED_NS), "tactile_left")
    assert counts.tolist() == [256 * (number % 256) + 7 for number in range(360)]
    assert decoder.statistics.packets == 1


def replied(body):
    """A reply with request number 9, of the right glove, at time 0x10."""
    size = len(bytes.fromhex(body)).to_bytes(4, "little").hex()
    return captured(f"44585452 01 {RIGHT} {size} 09000000 1000000000000000 {body}")


def heard(packet):
    """What the decoder gives of a reply between data packets: the packet and its arrival."""
    found = []
    decoder = TactileGloveDecoder("left", on_reply=lambda *reply: found.append(reply))
    assert len(decoder.feed(packet + GLOVE, ARRIVED_NS)) == 1
    ((reply, t_host_ns),) = found
    assert (reply.sequence, reply.t_device_ns, t_host_ns) == (9, 16, ARRIVED_NS)
    return reply


def test_replies_of_the_tactile_glove():
    serial = b"DXT-0042".hex() + "00" * 8
    identity = heard(replied(f"01 00 0000 {serial} 02 0b 05 00"))
    command, status, body = parse_reply(identity)
    assert (command, status) == (1, 0)
    found = parse_identity(body, identity.source)
    assert (found.serial_number, found.firmware, found.side) == ("DXT-0042", "2.11.5", "right")
    told = "03 00 0000 0000000001000000"
    assert parse_time(parse_reply(heard(replied(told)))[2]) == 2**32


def test_requests_to_the_tactile_glove():
    # Time sync: command 3, without an argument.
    wanted = captured(f"44585443 01 {NO_SOURCE} 04000000 09000000 0000000000000000 03 00 0000")
    assert encode_request(3, request=9) == wanted


# The tracker's own order: the little finger first, from tip to metacarpal, the wrist last.
NODES = [(c, j) for c in (5, 4, 3, 2) for j in (5, 4, 3, 2, 1)] + [
    *((1, 5), (1, 4), (1, 2), (1, 1)),
    (0, 0),
]
# Where each of these stands in ours: wrist, thumb (4 nodes), then four fingers of five nodes, each
# from the metacarpal to the tip.
OUR_PLACES = [
    *(24, 23, 22, 21, 20, 19, 18, 17, 16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5),
    *(4, 3, 2, 1, 0),
]
NODE_BYTES = "".join(f"{chain:02x}{joint:02x}" for chain, joint in NODES)
DESCRIBED = captured(f"44584644 01 {RIGHT} 32000000 00000000 0000000000000000 {NODE_BYTES}")
# Node 3 (the little finger's proximal) is not seen: bit 3 of 25 is 0.
SEEN = "f7ffff01"
# All nodes at (1, 0.5, −0.25) m but the last, the wrist, at (0, 0, 0.25) m.
POINTS = (ONE + HALF + MINUS_QUARTER) * 24 + "00000000" * 2 + QUARTER
FINGERS = captured(f"44584654 01 {RIGHT} 30010000 {SEQUENCE_AND_TIME} {SEEN} {POINTS}")


def check_keypoints(points):
    expected = np.tile([1.0, 0.5, -0.25], (25, 1))
    expected[0] = 0.0, 0.0, 0.25
    expected[OUR_PLACES[3]] = np.nan
    np.testing.assert_array_equal(points, expected)


def test_finger_tracker_by_reports():
    decoder = FingerTrackerDecoder("right")
    asked = reports(b"\x02\x00", DESCRIBED)
    sent = reports(b"\x01\x07", FINGERS)
    assert (len(FINGERS), len(sent), len(asked)) == (330, 6, 2)
    for report in [*asked, *sent[:-1]]:
        assert decoder.decode(report, 0) == {}
    check_keypoints(only(decoder.decode(sent[-1], ARRIVED_NS), "keypoints_right"))
    assert decoder.unseen_nodes == 1


def hello(**more):
    """The first line of a bridge whose coordinates are ours."""
    frame = {"handedness": "right", "axes": ["+x", "+y", "+z"]}
    line = {"protocol": "dextouch-bridge", "version": 1, "software": "x", "frame": frame, **more}
    return json.dumps(line).encode() + b"\n"


def test_finger_tracker_behind_a_bridge():
    chains = ("wrist", "thumb", "index", "middle", "ring", "little")
    joints = ("wrist", "metacarpal", "proximal", "intermediate", "distal", "tip")
    nodes = [(chains[chain], joints[joint]) for chain, joint in NODES]
    device = {"index": 0, "serial_number": "R", "source": "right"}
    line = hello(kind="finger_tracker", devices=[device], length_unit="cm", nodes=nodes)
    decoder = BridgeFingerTrackerDecoder("right")
    values = only(decoder.decode(line + FINGERS, ARRIVED_NS), "keypoints_right")
    check_keypoints(values * 100)


def test_pose_tracker_by_reports():
    # State 200, x y z = 1, 0.5, −0.25 m, and half a turn about y.
    body = f"c8 000000 {ONE} {HALF} {MINUS_QUARTER} 00000000 00000000 {ONE} 00000000"
    packet = captured(f"44585054 01 {HEAD} 20000000 {SEQUENCE_AND_TIME} {body}")
    (report,) = reports(b"\x01\xff", packet)
    assert len(packet) == 58
    pose = only(PoseTrackerDecoder("head").decode(report, ARRIVED_NS), "head")
    assert pose.tolist() == [1.0, 0.5, -0.25, 0.0, 0.0, 1.0, 0.0]


def test_pose_tracker_behind_a_bridge():
    # Device 0x0201, flagged valid, result 200, at 1.5 s; R is a quarter turn about z.
    turned = f"00000000 000080bf 00000000 {ONE}  {ONE} 00000000 00000000 {HALF}"
    body = f"0102 01 00 c8000000 000000000000f83f {turned} 00000000 00000000 {ONE} {QUARTER}"
    packet = captured(f"4458504d 01 {LEFT} 40000000 {SEQUENCE_AND_TIME} {body}")
    device = {"index": 0x0201, "serial_number": "LHR-1", "source": "left"}
    line = hello(kind="pose_tracker", devices=[device], length_unit="m")
    readings = BridgePoseTrackerDecoder("wrist_left").decode(line + packet, ARRIVED_NS)
    pose = only(readings, "wrist_left", t_device_ns=1_500_000_000)
    half = 0.5**0.5
    np.testing.assert_allclose(pose, [1.0, 0.5, 0.25, half, 0.0, 0.0, half], atol=1e-7)


def test_camera_bridge():
    # 2 rows of 3 pixels.
    pixels = "ff0000 00ff00 0000ff 010203 040506 070809"
    packet = captured(
        f"44584349 01 {NO_SOURCE} 1a000000 {SEQUENCE_AND_TIME} 0200 0300 00 000000 {pixels}"
    )
    decoder = CameraDecoder("camera_head", height_px=2, width_px=3)
    image = only(decoder.decode(packet, ARRIVED_NS), "camera_head")
    assert image.tolist() == [
        [[255, 0, 0], [0, 255, 0], [0, 0, 255]],
        [[1, 2, 3], [4, 5, 6], [7, 8, 9]],
    ]


def test_robot_state():
    one, half, two = "000000000000f03f", "000000000000e03f", "0000000000000040"
    zero = "0000000000000000"
    measured = one * 20 + half * 20
    commanded = two * 20 + zero * 20
    # Each wrist has another x, and no turn.
    wrists = "".join(x + zero * 2 + one + zero * 3 for x in (one, half, two, zero))
    packet = captured(
        f"44585253 01 {NO_SOURCE} 60030000 {SEQUENCE_AND_TIME} {measured} {commanded} {wrists}"
    )
    readings = RobotStateDecoder().decode(packet, ARRIVED_NS)
    assert only(readings, "joints_measured").tolist() == [1.0] * 20 + [0.5] * 20
    assert only(readings, "joints_commanded").tolist() == [2.0] * 20 + [0.0] * 20
    places = {"wrist_left": 1, "wrist_right": 0.5}
    places |= {"wrist_left_commanded": 2, "wrist_right_commanded": 0}
    for name, x_m in places.items():
        assert only(readings, name).tolist() == [x_m, 0, 0, 1, 0, 0, 0]


def test_wuji_glove():
    # The right hand; row 0 has 1, 0.5 and 0.25 of full scale, then no cell; all others are 0.
    cells = f"{ONE}{HALF}{QUARTER}0000c07f" + "00000000" * 764
    body = bytes.fromhex(f"100c 01 000000 {cells} 0d0c 04030201")
    packet = b"\xaa\x55" + body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "little")
    assert len(packet) == 3088
    readings = WujiGloveDecoder("right").decode(packet, ARRIVED_NS)
    milliseconds = 0x01020304
    values = only(readings, "tactile_right", sequence=0x0C0D, t_device_ns=milliseconds * 1_000_000)
    np.testing.assert_array_equal(values, [1.0, 0.5, 0.25, np.nan] + [0.0] * 764)


def test_justfloat_glove():
    # 1, 0.5, 0.25 and 401 − 3 zeros; the tail is what infinity looks like.
    packet = bytes.fromhex(f"{ONE}{HALF}{QUARTER}" + "00000000" * 398 + "0000807f")
    decoder = JustFloatGloveDecoder("left", num_values=401, full_scale=1.0, rate_hz=60.0)
    # Where the first packet began is not known.
    readings = decoder.decode(packet + packet, ARRIVED_NS)
    values = only(readings, "tactile_left", sequence=-1, t_device_ns=-1)
    assert values.tolist() == [1.0, 0.5, 0.25] + [0.0] * 398


@pytest.mark.parametrize(("text", "number"), [(ONE, 1.0), (HALF, 0.5), (MINUS_QUARTER, -0.25)])
def test_numbers_of_the_captures(text, number):
    assert struct.unpack("<f", bytes.fromhex(text)) == (number,)
