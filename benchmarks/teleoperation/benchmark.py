"""The benchmark stage `teleoperation`: latency, limits and error of a hand that is followed."""

import argparse
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from benchmarks.figures import Figure, Requirement, at_most, interleaved
from benchmarks.report import ResultTable, StageReport, cells
from benchmarks.simulated.hand_motions import RATE_HZ, Motion, robot_motion
from benchmarks.stages import Amounts, Bar
from benchmarks.teleoperation.server import NAIVE, RATES_HZ
from dextouch.hands import chain_indices
from dextouch.serving import ChildProcess
from dextouch.streams import pack, unpack
from services.pipelines.teleoperation.finger_gaps import FingerGaps
from services.pipelines.teleoperation.settings import CommandLimits
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


OURS: Final = "ours"
MAX_LATENCY_MS: Final = 10.0
AMOUNTS: Final = Amounts(usual={"seconds": 60.0, "rounds": 3}, quick={"seconds": 6.0, "rounds": 1})


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, seconds="length of a play", rounds="plays of each method")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Play a hand with faults to each method in real time, by a client in another process."""
    del folder
    plan = AMOUNTS.of(options)
    performance = Performance.of(plan["seconds"])
    child = ChildProcess("benchmarks.teleoperation.server", environment={"OMP_NUM_THREADS": "1"})
    try:
        urls = child.receive()
        names = [*RATES_HZ, NAIVE]

        def once(name: str, round_index: int) -> tuple[Played, float]:
            del round_index
            child.send({"cpu": True})
            before_s = child.receive()["cpu_s"]
            found = played(urls[name], performance)
            child.send({"cpu": True})
            return found, (child.receive()["cpu_s"] - before_s) / len(performance.is_sent) * 1e3

        with bar("plays", plan["rounds"] * len(names)) as step:
            results = interleaved(
                {name: partial(once, name) for name in names},
                plan["rounds"],
                on_step=step,
            )
    finally:
        child.close()
    return _report(plan, results)


def _report(
    plan: dict[str, float], results: Mapping[str, list[tuple[Played, float]]]
) -> StageReport:
    cpu_ms = {name: Figure.of([cpu for _, cpu in found]) for name, found in results.items()}
    plays = {name: [play for play, _ in found] for name, found in results.items()}
    errors = {name: Figure.of([p.error_deg for p in found]) for name, found in plays.items()}
    rows = []
    for name, found in plays.items():
        figures = [
            *(Figure.of([np.percentile(p.latency_ms, q) for p in found]) for q in (50, 99)),
            errors[name],
            Figure.of([p.speed_rad_s for p in found]),
            Figure.of([100 * p.num_touching / p.num_commands for p in found]),
            Figure.of([p.silence_ms for p in found]),
            cpu_ms[name],
        ]
        rows.append((name, *cells(*figures)))
    columns = (
        *("method", "latency p50 ms", "p99 ms", "error deg", "speed rad/s"),
        *("fingers overlap %", "longest silence ms", "CPU ms a sample"),
    )
    return StageReport(
        stage="teleoperation",
        packages=("numpy", "numba", "fastapi", "uvicorn", "websockets", "msgpack"),
        options=plan,
        tables=[ResultTable("A hand with faults, live", columns, rows)],
        requirements=_requirements(plays[OURS]),
        data={
            "plays": {
                name: [asdict(play) | {"cpu_ms": cpu} for play, cpu in found]
                for name, found in results.items()
            }
        },
        notes=[
            "latency is from the client's sending of a sample to its receipt of the first command "
            "that follows it; a quarter of the samples are faulty"
        ],
    )


def _requirements(ours: list[Played]) -> list[Requirement]:
    latencies_ms = np.concatenate([play.latency_ms for play in ours])
    return [
        at_most(
            "from sample to command, p99",
            float(np.percentile(latencies_ms, 99)),
            MAX_LATENCY_MS,
            "ms",
        ),
        at_most(
            "largest joint step, over speed limit times period",
            max(play.step_rad for play in ours)
            / (CommandLimits().speed_rad_s / RATES_HZ[OURS] + 1e-9),
            1.0,
        ),
        at_most(
            "commands in which fingers overlap", float(sum(play.num_touching for play in ours)), 0.0
        ),
    ]
