"""Contact timing errors between a human take and its replay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.tactile import PADS, in_contact
from dextouch.tactile.layout import SIDES, split_pads
from services.twin.episodes import TruthStream

# The whole hand comes last: in contact if any of its pads is.
PLACES: Final = (*PADS, "hand")
_NS_PER_MS: Final = 1e6


@dataclass(frozen=True)
class ContactTimes:
    """First and last contact of each pad of the left and the right hand; NaN: never touched."""

    first_ms: Float64[np.ndarray, "2 7"]
    last_ms: Float64[np.ndarray, "2 7"]


@dataclass(frozen=True)
class TimingErrors:
    """Replay minus human in milliseconds, for pads with contact in both, over many takes."""

    hand_first_ms: tuple[float, ...]
    hand_last_ms: tuple[float, ...]
    pad_first_ms: tuple[float, ...]
    pad_last_ms: tuple[float, ...]
    num_missing: int
    num_extra: int


def contact_times(streams: Mapping[str, TruthStream]) -> ContactTimes:
    """Contact times of every pad in the streams `tactile_left` and `tactile_right`."""
    first, last = np.full((2, len(SIDES), len(PLACES)), np.nan)
    for row, side in enumerate(SIDES):
        stream = streams[f"tactile_{side}"]
        tips, palm = split_pads(in_contact(stream.values))
        palm_touches = np.asarray(palm.any(axis=(1, 2)))[:, None]
        pads = np.concatenate([tips.any(axis=(2, 3)), palm_touches], axis=1)
        places = np.concatenate([pads, pads.any(axis=1, keepdims=True)], axis=1)
        for column in np.flatnonzero(places.any(axis=0)):
            at = np.flatnonzero(places[:, column])
            first[row, column] = stream.t_ref_ns[at[0]] / _NS_PER_MS
            last[row, column] = stream.t_ref_ns[at[-1]] / _NS_PER_MS
    return ContactTimes(first, last)


def timing_errors(pairs: Sequence[tuple[ContactTimes, ContactTimes]]) -> TimingErrors:
    """Errors of all takes, as (human, replay) pairs.

    `num_missing` counts pads with contact in the human take only, `num_extra` in the replay only.
    """
    first, last = (
        np.array([[getattr(take, name) for take in pair] for pair in pairs])
        for name in ("first_ms", "last_ms")
    )
    late = [times[:, 1] - times[:, 0] for times in (first, last)]
    human, replay = np.moveaxis(np.isfinite(first[..., :-1]), 1, 0)
    hand_first, hand_last = (_finite(times[..., -1]) for times in late)
    pad_first, pad_last = (_finite(times[..., :-1]) for times in late)
    missing, extra = int((human & ~replay).sum()), int((replay & ~human).sum())
    return TimingErrors(hand_first, hand_last, pad_first, pad_last, missing, extra)


def _finite(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values[np.isfinite(values)].tolist())
