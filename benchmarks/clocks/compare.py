"""Errors and processor time of each clock method in each scene, round by round."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.clocks.rivals import OFFLINE, ONLINE, descriptor
from benchmarks.clocks.scenes import STAMPLESS_SCENES, Scene, Take, simulate
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

    def to_data(self) -> dict[str, Any]:
        """Every round, for JSON."""
        return {
            "scene": self.scene,
            "way": self.way,
            "rounds": [asdict(found) for found in self.scores],
            "us_per_sample": list(self.us_per_sample.values),
        }


def compare(
    scenes: Mapping[str, Scene], *, seconds: float, num_rounds: int, seed: int, bar: Bar
) -> list[Result]:
    """Run all methods alternately in every scene."""
    ways: list[tuple[str, Way, bool]] = [(name, way, True) for name, way in ONLINE.items()]
    ways += [(name, way, False) for name, way in OFFLINE.items()]
    return _compare(scenes, ways, (seconds, num_rounds, seed), bar)


def compare_stampless(*, seconds: float, num_rounds: int, seed: int, bar: Bar) -> list[Result]:
    """Compare on streams with sequence numbers only or no counter, at several loss rates."""
    ways: list[tuple[str, Way, bool]] = [
        (COUNTED, _counted, True),
        (NUMBERED, _numbered, True),
        ("arrival stamps", ONLINE["arrival stamps"], True),
    ]
    return _compare(STAMPLESS_SCENES, ways, (seconds, num_rounds, seed), bar)


def _compare(
    scenes: Mapping[str, Scene],
    ways: list[tuple[str, Way, bool]],
    effort: tuple[float, int, int],
    bar: Bar,
) -> list[Result]:
    seconds, num_rounds, seed = effort
    results = []
    with bar("dating", len(scenes) * len(ways) * num_rounds) as step:
        for scene_name, scene in scenes.items():
            takes = [simulate(scene, seconds=seconds, seed=seed + k) for k in range(num_rounds)]
            subjects = {
                name: partial(_measure, way, takes, is_online) for name, way, is_online in ways
            }
            for name, found in interleaved(subjects, num_rounds, on_step=step).items():
                scores = tuple(scored for scored, _ in found)
                results.append(Result(scene_name, name, scores, Figure.of([us for _, us in found])))
    return results


def _measure(way: Way, takes: list[Take], is_online: bool, index: int) -> tuple[Score, float]:  # noqa: FBT001 (bound by partial)
    take = takes[index]
    began_ns = time.thread_time_ns()
    estimate_ns = way(take)
    spent_ns = time.thread_time_ns() - began_ns
    # Copying arrivals takes less time than the clock can resolve.
    return score(estimate_ns, take, is_online=is_online), max(spent_ns, 1) / 1e3 / len(take)


def _counted(take: Take) -> np.ndarray:
    period_ns = descriptor(take.scene).period_ns()
    return np.asarray(date_by_counting(take.t_host_ns, period_ns=period_ns).t_host_ns)


def _numbered(take: Take) -> np.ndarray:
    clock = OnlineClock(descriptor(take.scene, has_time=False))
    pairs = zip(take.t_host_ns.tolist(), (take.sequence % 2**16).tolist(), strict=True)
    return np.array([clock.update(t_host_ns=host, sequence=number) for host, number in pairs])
