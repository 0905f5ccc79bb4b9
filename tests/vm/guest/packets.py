"""Packets that the devices of these tests send, and what must come out of them."""

import numpy as np

from services.acquisition.drivers import pose_tracker, tactile_glove
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.reports import DATA_REPORT, split_into_reports

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
