"""Synchronization of streams with clocks of their own to one reference clock and one grid."""

from collections.abc import Callable
from typing import Literal, NamedTuple

Stage = Literal["dating", "placing", "retargeting", "objects", "writing"]
# Where each stage begins, as a share of the whole; by the seconds of an hour's recording.
STAGE_BEGINS: dict[Stage, float] = {
    "dating": 0.0,
    "placing": 0.35,
    "retargeting": 0.37,
    "objects": 0.55,
    "writing": 0.7,
}


class Progress(NamedTuple):
    """Progress of an alignment; `share` goes from 0 to 1 and never decreases."""

    share: float
    stage: Stage
    stream: str | None = None


OnProgress = Callable[[Progress], None]


def progress_within(stage: Stage, done: float, stream: str | None = None) -> Progress:
    """Progress where a share `done`, 0 … 1, of one stage is done."""
    begin = STAGE_BEGINS[stage]
    end = min((other for other in STAGE_BEGINS.values() if other > begin), default=1.0)
    return Progress(begin + min(max(done, 0.0), 1.0) * (end - begin), stage, stream)
