"""Parts of a recording that are not in its episode, with the reason and the stream.

An episode carries the refused parts as matrices beside its calibration, one a reason and stream:
`refused_<reason>_<stream>_s`, rows of start and stop in seconds after the recording's start.
"""

import re
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from pydantic import FiniteFloat

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Matrix, matrix_rows
from services.alignment.synchronization.resampling import runs_of

# late_start, early_end: a stream that actions need begins later or ends earlier than the others;
# gap: a stream has no samples there; shorter: nothing is wrong but that a longer stretch exists.
RefusedReason = Literal["late_start", "early_end", "gap", "shorter"]
_KEY = re.compile(rf"refused_({'|'.join(get_args(RefusedReason))})(?:_(\w+))?_s")
NS_PER_S = 1e9


class RefusedPart(FrozenModel):
    """A stretch of the recording that is not in the episode.

    `start_s` and `stop_s` count from the recording's start; `stream` is the one to blame, None
    where none is.
    """

    start_s: FiniteFloat
    stop_s: FiniteFloat
    reason: RefusedReason
    stream: str | None = None


def refused_edges(
    first_ns: Mapping[str, int], last_ns: Mapping[str, int], start_ns: int
) -> list[RefusedPart]:
    """Ends of a recording, started at `start_ns`, that not all streams cover.

    `first_ns` and `last_ns` are of the samples of each stream that actions are made of.
    """
    latest = max(first_ns, key=lambda name: first_ns[name])
    earliest = min(last_ns, key=lambda name: last_ns[name])
    return [
        _part(min(first_ns.values()), first_ns[latest], start_ns, "late_start", latest),
        _part(last_ns[earliest], max(last_ns.values()), start_ns, "early_end", earliest),
    ]


def refused_stretches(
    t_ns: np.ndarray, valid: Mapping[str, np.ndarray], taken: tuple[int, int], start_ns: int
) -> list[RefusedPart]:
    """Steps of the grid that are not in the episode, which has the steps `taken`: first, stop.

    `t_ns` are times of at least two steps on the clock of `start_ns`, the recording's start;
    `valid` says of each stream whether it can be read at each step.
    """
    step_ns = int(t_ns[1] - t_ns[0])

    def part(run: tuple[int, int], reason: RefusedReason, stream: str | None) -> RefusedPart:
        stop_ns = int(t_ns[run[1] - 1]) + step_ns
        return _part(int(t_ns[run[0]]), stop_ns, start_ns, reason, stream)

    gaps = [part(run, "gap", name) for name, mine in valid.items() for run in runs_of(~mine)]
    good = np.logical_and.reduce(list(valid.values()))
    return gaps + [part(run, "shorter", None) for run in runs_of(good) if run != taken]


def refused_matrices(parts: list[RefusedPart]) -> dict[str, Matrix]:
    """The parts as an episode carries them."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for part in parts:
        if part.stop_s > part.start_s:
            middle = part.reason if part.stream is None else f"{part.reason}_{part.stream}"
            rows.setdefault(f"refused_{middle}_s", []).append((part.start_s, part.stop_s))
    return {name: matrix_rows(np.array(stretches)) for name, stretches in rows.items()}


def refused_parts(calibration: Mapping[str, Matrix]) -> tuple[RefusedPart, ...]:
    """The refused parts that an episode carries, in order of time."""
    parts = [
        RefusedPart.model_validate(
            {"start_s": start_s, "stop_s": stop_s, "reason": match[1], "stream": match[2]}
        )
        for name, rows in calibration.items()
        if (match := _KEY.fullmatch(name))
        for start_s, stop_s in rows
    ]
    return tuple(sorted(parts, key=lambda part: (part.start_s, part.stop_s, part.stream or "")))


def _part(
    begin_ns: int, end_ns: int, start_ns: int, reason: RefusedReason, stream: str | None
) -> RefusedPart:
    start_s, stop_s = (begin_ns - start_ns) / NS_PER_S, (end_ns - start_ns) / NS_PER_S
    return RefusedPart(start_s=start_s, stop_s=stop_s, reason=reason, stream=stream)
