"""Checks whether motion and touch of hands belong together: exchanged gloves, still trackers."""

from collections import defaultdict
from typing import Final

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.hands import CHAINS, NUM_KEYPOINTS, chain_indices
from dextouch.tactile.layout import FINGERS, SIDES, TactileLayout

BIN_NS: Final = 500_000_000
MIN_BINS: Final = 8
# A finger or hand moves by so much in half a second, noise of trackers is far less; a pad is
# touched by so much. It does so alone if the others do less than a third of it.
MIN_MOVE_M: Final = 0.01
MIN_CURL_M: Final = 0.005
MIN_TOUCH_N: Final = 0.2
ALONE: Final = 1 / 3
# Of two that are exchanged, each shows what the other one does as often, and hardly its own: eight
# hits among five fingers by chance have a probability of 0.2**8.
MIN_HITS: Final = 4
MAX_OWN_SHARE: Final = 0.1
# A tracker stands still if means of half seconds scatter by less than those of any living hand (m,
# and parts of quaternions) for ten seconds, while fingers of its hand open or close by so much.
# Noise of more hides how a hand lives, or is a hand that shakes; poses without any were filled in,
# or are rounded.
LEAST_LIFE: Final = np.array([5e-5] * 3 + [2.5e-4] * 4)
MIN_STILL_BINS: Final = 20
MIN_CLOSING_M: Final = 0.02
NOISE_M: Final = (1e-6, 5e-4)


class HandTraces:
    """Means of half seconds of what hands do: curls of fingers, poses of wrists, forces of pads.

    Args:
        num_bins: how many of the newest half seconds are kept; None of all.
    """

    def __init__(self, num_bins: int | None = None) -> None:
        self._num_bins = num_bins
        self._bins: dict[str, dict[int, np.ndarray]] = defaultdict(dict)
        # The last quaternion of each wrist.
        self._last: dict[str, np.ndarray] = {}

    def add(
        self,
        name: str,
        t_ns: Int64[np.ndarray, " n"],
        values: np.ndarray,
        layout: TactileLayout | None = None,
    ) -> None:
        """Samples of keypoints (m), of a wrist's poses, or of the pressures (kPa) of a layout.

        Keypoints that are not our 25, and wrists that are not single poses, say nothing.
        """
        rows = np.asarray(values, dtype=np.float64)
        if layout is not None:
            rows = layout.pad_forces_n(np.nan_to_num(rows))
        if name.startswith("keypoints"):
            if rows.shape[1:] != (NUM_KEYPOINTS, 3):
                return
            ends = [(chain_indices(chain)[0], chain_indices(chain)[-1]) for chain in CHAINS]
            rows = np.stack([np.linalg.norm(rows[:, b] - rows[:, a], axis=1) for a, b in ends], 1)
        if name.startswith("wrist") and rows.shape[1:] != (7,):
            return
        known = np.isfinite(rows).all(axis=1)
        rows = rows[known]
        if name.startswith("wrist") and len(rows):
            # Of the two quaternions of a rotation the one nearer to those before.
            away = rows[:, 3:] @ self._last.get(name, rows[0, 3:]) < 0
            rows[away, 3:] *= -1
            self._last[name] = rows[-1, 3:].copy()
        numbers, inverse = np.unique(t_ns[known] // BIN_NS, return_inverse=True)
        sums = np.zeros((len(numbers), 1 + 2 * rows.shape[1]))
        np.add.at(sums, inverse, np.hstack([np.ones((len(rows), 1)), rows, rows**2]))
        bins = self._bins[name]
        for number, row in zip(numbers.tolist(), sums, strict=True):
            bins[number] = bins.get(number, 0.0) + row
        while self._num_bins and len(bins) > self._num_bins:
            del bins[min(bins)]

    def _means(self, *names: str) -> dict[str, Float64[np.ndarray, "bins columns"]]:
        """Means of the half seconds that all have, or nothing."""
        common = sorted(set.intersection(*(set(self._bins.get(name, ())) for name in names)))
        if len(common) < MIN_BINS:
            return {}
        rows = {name: np.stack([self._bins[name][one] for one in common]) for name in names}
        return {n: of[:, 1 : (of.shape[1] + 1) // 2] / of[:, :1] for n, of in rows.items()}

    def found(self) -> dict[str, tuple[str, str]]:
        """Cause (`frozen`, `swapped`) and message by stream."""
        found = {}
        for side in SIDES:
            if self._stands_still(side):
                text = "poses stand still but for noise, while the fingers of this hand move"
                found[f"wrist_{side}"] = "frozen", f"{text}: restart the tracker"
            if pair := self._exchanged_pads(side):
                text = f"{pair[0]} and {pair[1]} are touched when the other one of them moves"
                found[f"tactile_{side}"] = "swapped", f"{text}: exchange their pads"
        if self._are_gloves_exchanged():
            text = "is touched when the other hand moves: exchange the gloves or their settings"
            found["tactile_left"] = "swapped", text
        return found

    def _stands_still(self, side: str) -> bool:
        wrist, keypoints = f"wrist_{side}", f"keypoints_{side}"
        if not (means := self._means(wrist, keypoints)):
            return False
        rows = np.stack([*self._bins[wrist].values()])
        count, (some, squares) = rows[:, :1], np.split(rows[:, 1:] / rows[:, :1], 2, axis=1)
        noise_m = np.sqrt(np.maximum(squares - some**2, 0.0))[count[:, 0] > 1, :3]
        if len(noise_m) < MIN_STILL_BINS or np.ptp(means[keypoints], axis=0).max() < MIN_CLOSING_M:
            return False
        has_noise = np.median(noise_m, axis=0).min() > NOISE_M[0] and noise_m.max() < NOISE_M[1]
        return bool(has_noise and (some.std(axis=0) < LEAST_LIFE).all())

    def _exchanged_pads(self, side: str) -> tuple[str, str] | None:
        names = f"tactile_{side}", f"keypoints_{side}"
        if not (means := self._means(*names)):
            return None
        touched, moved = (np.abs(np.diff(means[name][:, :5], axis=0)) for name in names)
        hits = _hits(_alone(touched, MIN_TOUCH_N), _alone(moved, MIN_CURL_M), len(FINGERS))
        pairs = [
            (a, b) for a in range(5) for b in range(a) if _are_exchanged(hits[[a, b]][:, [a, b]])
        ]
        return (FINGERS[pairs[0][1]], FINGERS[pairs[0][0]]) if pairs else None

    def _are_gloves_exchanged(self) -> bool:
        kinds = ("tactile", "keypoints", "wrist")
        if not (means := self._means(*(f"{kind}_{side}" for kind in kinds for side in SIDES))):
            return False
        force_n, curls_m, at_m = (
            np.stack([np.abs(np.diff(means[f"{kind}_{side}"], axis=0)) for side in SIDES], axis=1)
            for kind in kinds
        )
        moved = np.maximum(curls_m.max(axis=2), np.linalg.norm(at_m[..., :3], axis=2))
        touched = force_n.sum(axis=2)
        hits = _hits(_alone(touched, MIN_TOUCH_N), _alone(moved, MIN_MOVE_M), 2)
        return _are_exchanged(hits)


def _alone(amounts: np.ndarray, least: float) -> np.ndarray:
    """Which one of each row [n, columns] does that much alone; -1 of none."""
    ordered = np.sort(amounts, axis=1)
    alone = (ordered[:, -1] >= least) & (ordered[:, -2] <= ALONE * ordered[:, -1])
    return np.where(alone, amounts.argmax(axis=1), -1)


def _hits(touched: np.ndarray, moved: np.ndarray, size: int) -> Int64[np.ndarray, "size size"]:
    """How often one [row] alone is touched while one [column] alone moves."""
    hits = np.zeros((size, size), dtype=np.int64)
    both = (touched >= 0) & (moved >= 0)
    np.add.at(hits, (touched[both], moved[both]), 1)
    return hits


def _are_exchanged(hits: np.ndarray) -> bool:
    others = hits[0, 1], hits[1, 0]
    return bool(min(others) >= MIN_HITS and np.trace(hits) <= MAX_OWN_SHARE * sum(others))
