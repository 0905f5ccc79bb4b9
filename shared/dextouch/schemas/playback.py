"""Schemas for playing recordings and episodes: their streams, extents and gaps."""

from typing import Literal

from pydantic import AwareDatetime

from dextouch.frozen_model import FrozenModel
from dextouch.schemas.catalog import ItemKind
from dextouch.schemas.episodes import LineageEntry
from dextouch.schemas.fields import Domain, Origin


class PlayedStream(FrozenModel):
    """A stream on the item's clock; `gaps_ns` are the longest gaps in order of time.

    A gap is an interval of more than one and a half nominal periods between samples. Times are
    those of the reference clock for episodes, of the host's arrivals for recordings; None if the
    stream has no samples.
    """

    name: str
    kind: str
    shape: tuple[int, ...]
    unit: str
    side: Literal["left", "right"] | None = None
    frame: str | None = None
    nominal_rate_hz: float
    num_samples: int
    first_ns: int | None = None
    last_ns: int | None = None
    num_gaps: int = 0
    gaps_ns: tuple[tuple[int, int], ...] = ()


class Playback(FrozenModel):
    """What can be played of a recording or an episode, from `start_ns` to `stop_ns`.

    `started_t_host_ns` is a recording's host time at its start, `origin_after_start_ns` how much
    later an episode that was aligned from it begins; None where unknown.
    """

    kind: ItemKind
    id: str
    task: str
    instruction: str
    domain: Domain
    origin: Origin
    station: str | None = None
    operator: str | None = None
    success: bool | None = None
    recovered: bool = False
    at: AwareDatetime | None = None
    model_rate_hz: float | None = None
    num_steps: int = 0
    start_ns: int
    stop_ns: int
    started_t_host_ns: int | None = None
    origin_after_start_ns: int | None = None
    lineage: tuple[LineageEntry, ...] = ()
    streams: tuple[PlayedStream, ...] = ()
