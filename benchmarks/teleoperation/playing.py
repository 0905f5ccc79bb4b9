"""A tracked hand played to a server in real time, with faults, and the commands that it gives."""

import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from benchmarks.simulated.hand_motions import RATE_HZ, Motion, robot_motion
from dextouch.hands import chain_indices
from dextouch.streams import pack, unpack
from services.pipelines.teleoperation.finger_gaps import FingerGaps
from services.twin.hands import twin_hand

MAX_BYTES: Final = 2**20
# In which the speed of joints is measured; much longer than what a network delays.
WINDOW_S: Final = 0.1
OVERLAP_M: Final = 1e-6
# Without faults: while the service checks the hand, and for the way to it.
START_S: Final = 4.0
FAULT_EVERY: Final = 90
FAULT_SAMPLES: Final = 24
# After a fault the way back is no error of following.
SETTLE_SAMPLES: Final = 40
_INDEX, _RING = list(chain_indices("index")), list(chain_indices("ring"))


@dataclass(frozen=True)
class Played:
    """Commands of one play.

    Attributes:
        latency_ms: from a sample to the first command that follows it, both at the client.
        error_deg: mean error of joints, against where the hand is when a command arrives, of
            commands long after any fault.
        step_rad: largest change of a joint from one command to the next.
        speed_rad_s: largest change of a joint within 0.1 s, by the time.
        num_touching: commands in which fingers overlap.
        silence_ms: longest time without a command.
        num_commands: all of them.
    """

    latency_ms: Float64[np.ndarray, " samples"]
    error_deg: float
    step_rad: float
    speed_rad_s: float
    num_touching: int
    silence_ms: float
    num_commands: int


@dataclass(frozen=True)
class Performance:
    """A motion with faults: 0.4 s of every 1.5 s lost, swapped, jumped or late, in turn."""

    motion: Motion
    keypoints_m: Float64[np.ndarray, "time 25 3"]
    is_sent: Bool[np.ndarray, " time"]
    is_clean: Bool[np.ndarray, " time"]
    delay_s: Float64[np.ndarray, " time"]

    @classmethod
    def of(cls, seconds: float) -> "Performance":
        """A performance of this length, the same each time."""
        num = round((START_S + seconds) * RATE_HZ)
        motion = robot_motion("right", num, 3, natural=True)
        rng = np.random.default_rng(0)
        keypoints = motion.keypoints_m + rng.normal(0, 5e-4, motion.keypoints_m.shape)
        is_sent, is_clean, delay_s = np.ones(num, bool), np.ones(num, bool), np.zeros(num)
        for number, start in enumerate(range(round(START_S * RATE_HZ), num, FAULT_EVERY)):
            at = slice(start, start + FAULT_SAMPLES)
            is_clean[start : start + FAULT_SAMPLES + SETTLE_SAMPLES] = False
            if number % 4 == 0:
                is_sent[at] = False
            elif number % 4 == 1:
                keypoints[at, _INDEX], keypoints[at, _RING] = (
                    keypoints[at, _RING].copy(),
                    keypoints[at, _INDEX].copy(),
                )
            elif number % 4 == 2:
                keypoints[at] = motion.keypoints_m[num - 1 - start]
            else:
                delay_s[at] = np.arange(len(delay_s[at]))[::-1] / RATE_HZ
        return cls(motion, keypoints, is_sent, is_clean, delay_s)


def played(url: str, performance: Performance) -> Played:
    """Play a performance to a server, in real time."""
    hand = twin_hand("right", "robot").kinematics
    commands: list[tuple[float, dict[str, object]]] = []
    address = f"{url.replace('http', 'ws')}/v1/teleop/right"
    with connect(address, compression=None, proxy=None) as socket:
        rest = dict.fromkeys(hand.joint_names, 0.0)
        socket.send(pack({"start": rest}, {}))
        socket.recv()
        reader = threading.Thread(target=_read, args=(socket, commands))
        reader.start()
        began_s = time.monotonic()
        sent_s: dict[int, float] = {}
        due_s = np.arange(len(performance.is_sent)) / RATE_HZ + performance.delay_s
        for index in np.flatnonzero(performance.is_sent):
            time.sleep(max(0.0, began_s + due_s[index] - time.monotonic()))
            stamp = 1 + round(int(index) * 1e9 / RATE_HZ)
            sent_s[stamp] = time.monotonic()
            keypoints_m = performance.keypoints_m[index].astype(np.float32)
            socket.send(pack({"sample": {"t_device_ns": stamp}}, {"keypoints_m": keypoints_m}))
        time.sleep(0.1)
    reader.join()
    return _judged(performance, commands, sent_s, began_s)


def _read(socket: ClientConnection, commands: list[tuple[float, dict[str, object]]]) -> None:
    with suppress(ConnectionClosed):
        while True:
            message = socket.recv(decode=False)
            commands.append((time.monotonic(), unpack(message, max_bytes=MAX_BYTES)[0]))


def _judged(
    performance: Performance,
    commands: list[tuple[float, dict[str, object]]],
    sent_s: dict[int, float],
    began_s: float,
) -> Played:
    times_s = np.array([t_s for t_s, _ in commands])
    joints = np.array([list(c["joints_rad"].values()) for _, c in commands])  # type: ignore[attr-defined]
    first_s: dict[int, float] = {}
    for t_s, command in commands:
        stamp = command["t_device_ns"]
        if isinstance(stamp, int):
            first_s.setdefault(stamp, t_s)
    index = ((times_s - began_s) * RATE_HZ).astype(int).clip(0, len(performance.is_clean) - 1)
    follows = (times_s > began_s + START_S) & performance.is_clean[index]
    errors = np.abs(joints - performance.motion.joints_rad[index])[follows]
    # The first output of the loop that answers is wherever the hand is.
    later = slice(1, None)
    before = np.searchsorted(times_s[later], times_s[later] - WINDOW_S)
    moved_rad = np.abs(joints[later] - joints[later][before])
    twin = twin_hand("right", "robot")
    gaps_m = FingerGaps(twin.kinematics, np.array(twin.shape.radii_m)).gaps_m(joints)
    return Played(
        latency_ms=1e3 * np.array([first_s[stamp] - sent_s[stamp] for stamp in first_s]),
        error_deg=float(np.rad2deg(errors.mean())),
        step_rad=float(np.abs(np.diff(joints[later], axis=0)).max()),
        speed_rad_s=float(moved_rad.max()) / WINDOW_S,
        num_touching=int((gaps_m.min(axis=1) < -OVERLAP_M).sum()),
        silence_ms=1e3 * float(np.diff(times_s).max()),
        num_commands=len(commands),
    )
