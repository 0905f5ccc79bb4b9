"""Keypoints of one hand come in; a finger tracker's HID reports, nodes in its own order, go out."""

import numpy as np
from jaxtyping import Int64

from dextouch.hands.skeleton import NODES, NUM_KEYPOINTS
from dextouch.tactile.layout import Side
from services.acquisition.drivers.finger_tracker import (
    CHAIN_IDS,
    DESCRIPTOR_MAGIC,
    JOINT_IDS,
    MAGIC,
    VALIDITY,
)
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.reports import (
    DATA_REPORT,
    DESCRIPTOR_REPORT,
    split_into_reports,
)
from services.acquisition.mocks.replay import ReplayStream

ALL_VALID = (1 << NUM_KEYPOINTS) - 1


class FingerTrackerSource:
    """Reports of one finger tracker.

    Args:
        stream: [n, 25, 3] in m, wrist frame.
        side: which hand.
        noise_m: standard deviation of each coordinate.
        rng: of the noise and of the device's node order.
    """

    def __init__(
        self, stream: ReplayStream, *, side: Side, noise_m: float, rng: np.random.Generator
    ) -> None:
        self._stream = stream
        self._side = side
        self._order = rng.permutation(NUM_KEYPOINTS)
        noise = noise_m * rng.standard_normal(stream.values.shape)
        self._points = (stream.values + noise)[:, self._order].astype("<f4")

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet, split into reports."""
        payload = VALIDITY.pack(ALL_VALID) + self._points[index].tobytes()
        packet = Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, payload)
        return split_into_reports(DATA_REPORT, sequence, encode_packet(MAGIC, packet))

    def answer(self, report: bytes) -> list[bytes]:
        """What the device says to the host's report: its nodes, when asked for them."""
        if report[:1] != bytes([DESCRIPTOR_REPORT]):
            return []
        payload = bytes(
            number
            for node in self._order
            for number in (CHAIN_IDS[NODES[node][0]], JOINT_IDS[NODES[node][1]])
        )
        packet = Packet(VERSION, SOURCES[self._side], 0, 0, payload)
        return split_into_reports(DESCRIPTOR_REPORT, 0, encode_packet(DESCRIPTOR_MAGIC, packet))
