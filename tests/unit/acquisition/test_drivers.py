import numpy as np
import pytest

from dextouch.errors import DeviceError, PacketError
from dextouch.hands import NODES
from dextouch.images import decode_jpeg, encode_jpeg
from services.acquisition.devices.camera import ENCODING_CODES, PAYLOAD_HEADER, CameraDecoder
from services.acquisition.devices.camera import MAGIC as CAMERA_MAGIC
from services.acquisition.devices.finger_tracker import (
    CHAIN_IDS,
    DESCRIPTOR_MAGIC,
    JOINT_IDS,
    VALIDITY,
    FingerTrackerDecoder,
    parse_node_order,
)
from services.acquisition.devices.finger_tracker import MAGIC as FINGER_MAGIC
from services.acquisition.devices.pose_tracker import MAGIC as POSE_MAGIC
from services.acquisition.devices.pose_tracker import PAYLOAD as POSE_PAYLOAD
from services.acquisition.devices.pose_tracker import PoseTrackerDecoder, TrackingState
from services.acquisition.devices.robot_state import MAGIC as ROBOT_MAGIC
from services.acquisition.devices.robot_state import PAYLOAD as ROBOT_PAYLOAD
from services.acquisition.devices.robot_state import RobotStateDecoder
from services.acquisition.drivers.base import (
    DATA_REPORT,
    DESCRIPTOR_REPORT,
    split_into_reports,
)
from services.acquisition.drivers.packets import SOURCES, Packet, encode_packet

POSE = (1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0)


def node_bytes(order):
    return bytes(n for i in order for n in (CHAIN_IDS[NODES[i][0]], JOINT_IDS[NODES[i][1]]))


def describe(decoder, order):
    packet = encode_packet(DESCRIPTOR_MAGIC, Packet(1, SOURCES["left"], 0, 0, node_bytes(order)))
    for report in split_into_reports(DESCRIPTOR_REPORT, 0, packet):
        assert decoder.decode(report, 0) == {}


def keypoint_reports(points, valid=(1 << 25) - 1, sequence=4):
    payload = VALIDITY.pack(valid) + points.astype("<f4").tobytes()
    packet = encode_packet(FINGER_MAGIC, Packet(1, SOURCES["left"], sequence, 99, payload))
    return split_into_reports(DATA_REPORT, sequence, packet)


def feed(decoder, reports, t_host_ns=5):
    found = {}
    for report in reports:
        for name, samples in decoder.decode(report, t_host_ns).items():
            found.setdefault(name, []).extend(samples)
    return found


def pose_report(state=TrackingState.RUNNING_OK, numbers=POSE, source="left"):
    payload = POSE_PAYLOAD.pack(state, *numbers)
    packet = encode_packet(POSE_MAGIC, Packet(1, SOURCES[source], 1, 10, payload))
    (report,) = split_into_reports(DATA_REPORT, 1, packet)
    return report


def test_nodes_are_resolved_by_their_ids(rng):
    decoder = FingerTrackerDecoder("left")
    order = rng.permutation(25)
    points = rng.uniform(-0.1, 0.1, (25, 3)).astype(np.float32)
    describe(decoder, order)
    (sample,) = feed(decoder, keypoint_reports(points[order]))["keypoints_left"]
    np.testing.assert_array_equal(sample.values, points)
    assert (sample.sequence, sample.t_device_ns, sample.t_host_ns) == (4, 99, 5)


def test_unseen_nodes_are_nan_and_counted(rng):
    decoder = FingerTrackerDecoder("left")
    describe(decoder, range(25))
    points = rng.uniform(-0.1, 0.1, (25, 3))
    reports = keypoint_reports(points, valid=((1 << 25) - 1) & ~(1 << 7))
    (sample,) = feed(decoder, reports)["keypoints_left"]
    assert np.flatnonzero(np.isnan(sample.values).all(axis=1)).tolist() == [7]
    assert decoder.unseen_nodes == 1


def test_keypoints_without_a_descriptor_are_not_guessed(rng):
    decoder = FingerTrackerDecoder("left")
    assert feed(decoder, keypoint_reports(rng.uniform(size=(25, 3)))) == {}


@pytest.mark.parametrize("order", [[0] * 25, range(24), [*range(24), 0]])
def test_wrong_descriptors_are_refused(order):
    with pytest.raises(PacketError, match="descriptor"):
        parse_node_order(node_bytes(order))


def test_descriptor_of_the_other_hand_is_refused():
    packet = encode_packet(
        DESCRIPTOR_MAGIC, Packet(1, SOURCES["right"], 0, 0, node_bytes(range(25)))
    )
    with pytest.raises(DeviceError, match="'right'"):
        feed(FingerTrackerDecoder("left"), split_into_reports(DESCRIPTOR_REPORT, 0, packet))


def test_pose_of_a_running_tracker():
    decoder = PoseTrackerDecoder("wrist_left")
    (sample,) = decoder.decode(pose_report(), 3)["wrist_left"]
    np.testing.assert_allclose(sample.values, POSE, atol=1e-6)
    assert np.linalg.norm(sample.values[3:]) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(
    "state", [s for s in TrackingState if s != TrackingState.RUNNING_OK] + [77]
)
def test_pose_of_another_state_is_a_gap(state):
    decoder = PoseTrackerDecoder("wrist_left")
    assert decoder.decode(pose_report(state), 3) == {}
    assert decoder.tracking["occluded"] == 1
    assert decoder.statistics.packets == 1


@pytest.mark.parametrize("numbers", [(float("nan"), *POSE[1:]), (1, 2, 3, 0, 0, 0, 0)])
def test_pose_that_is_none_is_refused(numbers):
    decoder = PoseTrackerDecoder("wrist_left")
    assert decoder.decode(pose_report(numbers=numbers), 3) == {}
    assert decoder.statistics.refused == 1


def test_swapped_trackers_are_noticed():
    with pytest.raises(DeviceError, match="'right'"):
        PoseTrackerDecoder("wrist_left").decode(pose_report(source="right"), 0)


def camera_packet(image, code, body=None):
    header = PAYLOAD_HEADER.pack(*image.shape[:2], code)
    payload = header + (image.tobytes() if body is None else body)
    return encode_packet(CAMERA_MAGIC, Packet(1, 0, 0, 0, payload))


def test_raw_and_jpeg_images(rng):
    image = np.full((16, 24, 3), 90, np.uint8)
    raw = CameraDecoder("camera_head", height_px=16, width_px=24)
    (sample,) = raw.decode(camera_packet(image, ENCODING_CODES["rgb8"]), 0)["camera_head"]
    np.testing.assert_array_equal(sample.values, image)
    jpeg = CameraDecoder("camera_head", height_px=16, width_px=24, encoding="jpeg")
    packet = camera_packet(image, ENCODING_CODES["jpeg"], encode_jpeg(image))
    (sample,) = jpeg.decode(packet, 0)["camera_head"]
    assert jpeg.descriptors[0].unit == "jpeg"
    assert np.abs(decode_jpeg(sample.values.item()).astype(int) - image).max() <= 2


@pytest.mark.parametrize("body", [b"no image", encode_jpeg(np.zeros((8, 8, 3), np.uint8))])
def test_jpeg_that_is_none_is_refused(body):
    decoder = CameraDecoder("camera_head", height_px=16, width_px=24, encoding="jpeg")
    image = np.zeros((16, 24, 3), np.uint8)
    assert decoder.decode(camera_packet(image, 1, body), 0) == {}
    assert decoder.statistics.refused == 1


def test_truncated_raw_image_is_refused():
    decoder = CameraDecoder("camera_head", height_px=16, width_px=24)
    assert decoder.decode(camera_packet(np.zeros((16, 24, 3), np.uint8), 0, b"123"), 0) == {}
    assert decoder.statistics.refused == 1


def test_image_of_another_size_is_a_device_error():
    decoder = CameraDecoder("camera_head", height_px=16, width_px=24)
    with pytest.raises(DeviceError, match="8 by 8"):
        decoder.decode(camera_packet(np.zeros((8, 8, 3), np.uint8), 0), 0)


def robot_packet(numbers):
    return encode_packet(ROBOT_MAGIC, Packet(1, 0, 9, 8, ROBOT_PAYLOAD.pack(*numbers)))


def test_robot_state_is_six_streams():
    numbers = np.arange(108.0)
    readings = RobotStateDecoder().decode(robot_packet(numbers), 1)
    assert {name: s[0].values.tolist() for name, s in readings.items()} == {
        "joints_measured": numbers[:40].tolist(),
        "joints_commanded": numbers[40:80].tolist(),
        "wrist_left": numbers[80:87].tolist(),
        "wrist_right": numbers[87:94].tolist(),
        "wrist_left_commanded": numbers[94:101].tolist(),
        "wrist_right_commanded": numbers[101:].tolist(),
    }
    assert {s[0].sequence for s in readings.values()} == {9}


def test_robot_state_with_nan_is_refused():
    decoder = RobotStateDecoder()
    assert decoder.decode(robot_packet([float("nan")] * 108), 1) == {}
    assert decoder.statistics.refused == 1
