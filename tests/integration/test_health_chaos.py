"""What goes wrong at a station and the one line that an operator must read first."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import pytest

from dextouch.schemas import TakePrompt
from services.acquisition.clock import PeriodicCall, VirtualClock
from services.acquisition.health.station import DiskCheck, HostCheck
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams

PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")
STREAMS = ("tactile_left", "tactile_right", "wrist_left", "wrist_right", "head")
SECONDS = 9.0
AT_S = 2.0
LOOK_S = 7.0
# About what these streams bring: two gloves of 360 counts, three poses of seven numbers.
BYTES_A_S = 2 * 60 * 720 + 3 * 100 * 56
SIMULATED = (
    "This device is simulated: a fault button of the Station page (Unplug: key F), its fault "
    "script or the load of this computer causes it."
)


class SetWallClock(VirtualClock):
    """A host whose wall clock is set forward by an hour, 2 s after the start."""

    def wall_offset_ns(self):
        return 3600 * 10**9 if self.now_ns() > (1 + AT_S) * 1e9 else 0


class SleepyHost(VirtualClock):
    """A host that was suspended for 12 s, 2 s after the start."""

    def suspended_ns(self):
        return 12 * 10**9 if self.now_ns() > (1 + AT_S) * 1e9 else 0


def host_judge(station):
    """The check of the station's computer."""
    return next(j for j in station.health._itself.judges if isinstance(j, HostCheck))


def busy(station):
    """Every thread of the station waits 0.18 s for a processor; so do samples after their read."""
    judge, late_ns = host_judge(station), 180_000_000
    judge._load = lambda: (15.0, 2)
    station.health._ticks.on_wake = lambda now_ns, _: judge.note(now_ns, late_ns)
    for queue in station.health.queues.values():
        add = queue.add
        queue.add = lambda samples, now_ns, add=add: add(samples, now_ns + late_ns)


def saturated(station):
    """The health thread still wakes in time, but processors are full and all streams are late."""
    ticks = {"all": 0}

    def cpu_times():
        ticks["all"] += 200
        return round(0.97 * ticks["all"]), ticks["all"]

    host_judge(station)._cpu_times = cpu_times


def nearly_full(station):
    """The disk has room for 20 minutes."""
    disk = DiskCheck(
        station.recorder.spool_root,
        station.supervisors,
        station.clock.now_ns(),
        free_bytes=lambda: 20 * 60 * BYTES_A_S,
    )
    station.health.watch(disk)


@dataclass(frozen=True)
class Chaos:
    """What happens, and the cause, line and advice (globs) that must be told, widest first."""

    lines: tuple[tuple[str, str, str], ...]
    happen: Callable | None = None
    clock: type = VirtualClock
    faults: Mapping[str, Mapping] = field(default_factory=dict)
    num_streams: int = 0


STALLED = {"stalls_s": ((AT_S, SECONDS + 5),)}
BURSTS = {"burst_ms": 80.0}
CHAOS = {
    "a loaded computer": Chaos(
        (
            (
                "host",
                "This computer is overloaded: the station's threads wake 180 ms late "
                "(15 tasks on 2 processors)",
                "Close other programs, or set the cameras to smaller or fewer images.",
            ),
        ),
        busy,
        num_streams=5,
    ),
    "a computer without a free processor": Chaos(
        (
            (
                "host",
                "This computer is overloaded: processors 97 % busy, 5 devices late",
                "Close other programs, or set the cameras to smaller or fewer images.",
            ),
        ),
        saturated,
        faults=dict.fromkeys(("others",), BURSTS),
        num_streams=5,
    ),
    "a disk nearly full": Chaos(
        (
            (
                "station",
                "the disk is full in [12]? minutes; upload or delete takes",
                "Upload and delete takes, or use a larger disk for the spool.",
            ),
        ),
        nearly_full,
    ),
    "the wall clock is set": Chaos(
        (
            (
                "station",
                "its wall clock was set by 3600.0 s",
                "Set up time synchronization (chrony); timestamps within takes are not affected.",
            ),
        ),
        clock=SetWallClock,
    ),
    "the computer slept": Chaos(
        (
            (
                "host",
                "This computer slept: it was suspended for 12.0 s",
                "Turn off sleep and hibernation on this computer while the station runs.",
            ),
        ),
        clock=SleepyHost,
    ),
    "a device that stopped": Chaos(
        (("gone", "glove_right: no data for 5.? s", SIMULATED),),
        faults={"glove_right": STALLED},
        num_streams=1,
    ),
    "a device that was unplugged": Chaos(
        (("gone", "glove_right: *", SIMULATED),),
        faults={"glove_right": {"unplugged_s": ((AT_S, SECONDS + 5),)}},
        num_streams=1,
    ),
    "a clock that was set": Chaos(
        (
            (
                "clock",
                "glove_left: its clock was set or restarted 1 times within an hour",
                SIMULATED,
            ),
        ),
        faults={"glove_left": {"clock_step_at_s": AT_S, "clock_step_s": 0.2}},
        num_streams=1,
    ),
    "a device that stopped at a loaded computer": Chaos(
        (
            ("host", "This computer is overloaded: the station's threads wake 180 ms late*", "*"),
            ("gone", "glove_right: no data for ?.? s", SIMULATED),
        ),
        busy,
        faults={"glove_right": STALLED},
        num_streams=4,
    ),
    "nothing": Chaos(()),
}


def observed(chaos, spool_root):
    """The station's health 7 s into a take, in virtual time."""
    clock = chaos.clock()
    streams = [s for s in pattern_streams(SECONDS) if s.descriptor.name in STREAMS]
    faults = {name: DeviceFaults.model_validate(dict(f)) for name, f in chaos.faults.items()}
    script = FaultScript(devices=faults, others=faults.get("others", DeviceFaults()))
    mock = MockStation(
        streams, script, 5, clock, spool_root=spool_root, calibration=pattern_calibration()
    )
    if chaos.happen is not None:
        chaos.happen(mock.station)
    reports = []

    def look():
        reports.append((clock.now_ns(), mock.station.health.report()))

    with mock:
        started_ns = clock.now_ns()
        looks = PeriodicCall(look, period_ns=500_000_000, clock=clock, name="look")
        looks.start()
        mock.run_take(PROMPT, recording_id="take")
        looks.stop()
    return next(report for t_ns, report in reports if t_ns >= started_ns + LOOK_S * 1e9)


@pytest.mark.parametrize("name", CHAOS)
@pytest.mark.slow
def test_each_has_exactly_its_causes_on_top(name, tmp_path):
    chaos = CHAOS[name]
    causes = observed(chaos, tmp_path).causes
    assert len(causes) == len(chaos.lines), [cause.message for cause in causes]
    for cause, (code, message, advice) in zip(causes, chaos.lines, strict=True):
        assert cause.code == code
        assert fnmatchcase(cause.message, message), cause.message
        assert fnmatchcase(cause.advice, advice), cause.advice
    if causes:
        assert len(causes[0].streams) == chaos.num_streams
