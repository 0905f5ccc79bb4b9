"""Contact timing errors between a human take and its replay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.tactile import PADS, in_contact
from dextouch.tactile.layout import SIDES, split_pads
from services.twin.episodes import TruthStream

# The whole hand comes last: in contact if any of its pads is.
PLACES: Final = (*PADS, "hand")
_NS_PER_MS: Final = 1e6


@dataclass(frozen=True)
class ContactTimes:
    """First and last contact of each pad of the left and the right hand.

    `first_ms` and `last_ms` are zero for pads never `touched`.
    """

    touched: Bool[np.ndarray, "2 7"]
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
    touched = np.zeros((len(SIDES), len(PLACES)), dtype=bool)
    first, last = np.zeros(touched.shape), np.zeros(touched.shape)
    for row, side in enumerate(SIDES):
        stream = streams[f"tactile_{side}"]
        tips, palm = split_pads(in_contact(stream.values))
        palm_touches = np.asarray(palm.any(axis=(1, 2)))[:, None]
        pads = np.concatenate([tips.any(axis=(2, 3)), palm_touches], axis=1)
        places = np.concatenate([pads, pads.any(axis=1, keepdims=True)], axis=1)
        for column in np.flatnonzero(places.any(axis=0)):
            at = np.flatnonzero(places[:, column])
            touched[row, column] = True
            first[row, column] = stream.t_ref_ns[at[0]] / _NS_PER_MS
            last[row, column] = stream.t_ref_ns[at[-1]] / _NS_PER_MS
    return ContactTimes(touched, first, last)


def timing_errors(pairs: Sequence[tuple[ContactTimes, ContactTimes]]) -> TimingErrors:
    """Errors of all takes, as (human, replay) pairs.

    `num_missing` counts pads with contact in the human take only, `num_extra` in the replay only.
    """
    hand_first: list[float] = []
    hand_last: list[float] = []
    pad_first: list[float] = []
    pad_last: list[float] = []
    missing = extra = 0
    for human, replay in pairs:
        both = human.touched & replay.touched
        missing += int((human.touched & ~replay.touched)[:, :-1].sum())
        extra += int((replay.touched & ~human.touched)[:, :-1].sum())
        late_first, late_last = replay.first_ms - human.first_ms, replay.last_ms - human.last_ms
        hand_first += late_first[:, -1][both[:, -1]].tolist()
        hand_last += late_last[:, -1][both[:, -1]].tolist()
        pad_first += late_first[:, :-1][both[:, :-1]].tolist()
        pad_last += late_last[:, :-1][both[:, :-1]].tolist()
    return TimingErrors(
        tuple(hand_first), tuple(hand_last), tuple(pad_first), tuple(pad_last), missing, extra
    )
