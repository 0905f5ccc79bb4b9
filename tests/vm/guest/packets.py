"""Packets that the devices of these tests send, and what must come out of them."""

import numpy as np

from dextouch.hands import NODES, NUM_KEYPOINTS
from services.acquisition.devices import finger_tracker, pose_tracker, tactile_glove
from services.acquisition.drivers.base import (
    DATA_REPORT,
    DESCRIPTOR_REPORT,
    split_into_reports,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet

PERIOD_NS = 10_000_000


def pose_values(number):
    """Position and rotation number n of a tracker that moves slowly: float32 [7]."""
    angle = number * 1e-3
    pose = [0.001 * number, 0.2, 1.0, np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]
    return np.array(pose, dtype=np.float32)


def pose_reports(first, count):
    """HID reports of poses first … first + count - 1 of the left wrist, one each."""
    reports = []
    for number in range(first, first + count):
        payload = pose_tracker.PAYLOAD.pack(
            pose_tracker.TrackingState.RUNNING_OK, *pose_values(number)
        )
        packet = Packet(VERSION, SOURCES["left"], number, number * PERIOD_NS, payload)
        data = encode_packet(pose_tracker.MAGIC, packet)
        reports += split_into_reports(DATA_REPORT, number, data)
    return reports


def keypoints(number):
    """Keypoints number n of a hand, in our order: float32 [25, 3] in m, no two of them alike."""
    points = np.arange(NUM_KEYPOINTS * 3, dtype=np.float32).reshape(-1, 3) * 1e-3
    return points + np.float32(1e-4 * number)


def keypoint_reports(first, count):
    """HID reports of keypoints first … first + count - 1 of the left hand, a list for each.

    The device has its nodes in the opposite order.
    """
    messages = []
    for number in range(first, first + count):
        payload = finger_tracker.VALIDITY.pack(finger_tracker.ALL_SEEN)
        payload += keypoints(number)[::-1].astype("<f4").tobytes()
        packet = Packet(VERSION, SOURCES["left"], number, number * PERIOD_NS, payload)
        data = encode_packet(finger_tracker.MAGIC, packet)
        messages.append(split_into_reports(DATA_REPORT, number, data))
    return messages


def answer_with_nodes(asked):
    """What a finger tracker answers to the request for its nodes."""
    if asked[:1] != bytes([DESCRIPTOR_REPORT]):
        return []
    payload = bytes(
        identity
        for chain, joint in reversed(NODES)
        for identity in (finger_tracker.CHAIN_IDS[chain], finger_tracker.JOINT_IDS[joint])
    )
    packet = Packet(VERSION, SOURCES["left"], 0, 0, payload)
    data = encode_packet(finger_tracker.DESCRIPTOR_MAGIC, packet)
    return split_into_reports(DESCRIPTOR_REPORT, 0, data)


def glove_counts(number):
    """Counts number n of a glove: uint16 [360]."""
    return ((np.arange(360) * 7 + number * 13) % 4000).astype("<u2")


def glove_packets(first, count, *, side="left"):
    """Packets first … first + count - 1 of a glove."""
    return [
        encode_packet(
            tactile_glove.MAGIC,
            Packet(VERSION, SOURCES[side], n, n * PERIOD_NS, glove_counts(n).tobytes()),
        )
        for n in range(first, first + count)
    ]
