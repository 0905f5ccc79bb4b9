"""Errors and processor time of each clock method in each scene, round by round."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.clocks.rivals import OFFLINE, ONLINE, descriptor
from benchmarks.clocks.scenes import Scene, Take, simulate
from benchmarks.clocks.scores import Score, score
from benchmarks.figures import Figure
from benchmarks.rounds import interleaved
from benchmarks.stages import Bar
from dextouch.clocks import OnlineClock, date_by_counting

Way = Callable[[Take], np.ndarray]
COUNTED, NUMBERED = "counted", "numbered"


@dataclass(frozen=True)
class Result:
    """One method in one scene: score and cost of every round (each with its own seed)."""

    scene: str
    way: str
    scores: tuple[Score, ...]
    us_per_sample: Figure

    @property
    def rms_ms(self) -> Figure:
        """Root mean square errors of the rounds."""
        return Figure.of([found.rms_ms for found in self.scores])

    @property
    def p99_ms(self) -> Figure:
        """99th percentiles of the rounds."""
        return Figure.of([found.p99_ms for found in self.scores])

    @property
    def recovery_s(self) -> Figure | None:
        """Recovery time after a step; None in scenes without one."""
        times = [found.recovery_s for found in self.scores if found.recovery_s is not None]
        return Figure.of(times) if times else None


def compare(
    scenes: Mapping[str, Scene], ways: Mapping[str, Way], seconds: float, seeds: range, bar: Bar
) -> list[Result]:
    """Run all methods alternately in every scene, on a take for each seed."""
    results = []
    with bar("dating", len(scenes) * len(ways) * len(seeds)) as step:
        for scene_name, scene in scenes.items():
            takes = [simulate(scene, seconds=seconds, seed=seed) for seed in seeds]
            subjects = {name: partial(_measure, name, way, takes) for name, way in ways.items()}
            for name, found in interleaved(subjects, len(seeds), on_step=step).items():
                scores = tuple(scored for scored, _ in found)
                results.append(Result(scene_name, name, scores, Figure.of([us for _, us in found])))
    return results


def _measure(name: str, way: Way, takes: list[Take], index: int) -> tuple[Score, float]:
    take = takes[index]
    began_ns = time.thread_time_ns()
    estimate_ns = way(take)
    spent_ns = time.thread_time_ns() - began_ns
    scored = score(estimate_ns, take, is_online=name not in OFFLINE)
    # Copying arrivals takes less time than the clock can resolve.
    return scored, max(spent_ns, 1) / 1e3 / len(take)


def _counted(take: Take) -> np.ndarray:
    period_ns = descriptor(take.scene).period_ns()
    return np.asarray(date_by_counting(take.t_host_ns, period_ns=period_ns).t_host_ns)


def _numbered(take: Take) -> np.ndarray:
    clock = OnlineClock(descriptor(take.scene, has_time=False))
    pairs = zip(take.t_host_ns.tolist(), (take.sequence % 2**16).tolist(), strict=True)
    return np.array([clock.update(t_host_ns=host, sequence=number) for host, number in pairs])


# For streams with sequence numbers only or without any counter.
STAMPLESS: dict[str, Way] = {
    COUNTED: _counted,
    NUMBERED: _numbered,
    "arrival stamps": ONLINE["arrival stamps"],
}
