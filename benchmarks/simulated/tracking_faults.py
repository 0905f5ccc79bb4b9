"""Motions with injected faults of every kind, and ground truth for each finger."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.random import Generator

from benchmarks.simulated.hand_motions import Motion
from dextouch.hands import CHAINS, chain_indices

DROPOUT_SAMPLES = 60
# Maximum duration of the other faults, and of the clean samples after each.
MAX_FAULT_SAMPLES = 8
CLEAN_SAMPLES = 10
OUTLIER_M = 0.05
_BODY = np.array([node for chain in CHAINS for node in chain_indices(chain)])


@dataclass(frozen=True)
class FuzzedMotion:
    """Keypoints (wrist coordinates) with faults, and ground truth about these.

    `kind` is the index in `FAULTS` of each sample's fault, -1 for none; `hit` are fingers with a
    corrupted point; `since_fault` counts clean samples since the last fault, large before the
    first.
    """

    keypoints_m: Float64[np.ndarray, "time 25 3"]
    kind: Int64[np.ndarray, " time"]
    hit: Bool[np.ndarray, "time 5"]
    since_fault: Int64[np.ndarray, " time"]


def _some_nodes(rng: Generator) -> np.ndarray:
    return rng.choice(_BODY, rng.integers(1, 6), replace=False)


def _nan(samples: np.ndarray, rng: Generator) -> None:
    samples[:, _some_nodes(rng)] = np.nan


def _infinite(samples: np.ndarray, rng: Generator) -> None:
    samples[:, _some_nodes(rng)] = rng.choice([np.inf, -np.inf])


def _zeros(samples: np.ndarray, rng: Generator) -> None:
    samples[:, _some_nodes(rng)] = 0.0


def _denormal(samples: np.ndarray, rng: Generator) -> None:
    samples[:, _some_nodes(rng)] = 5e-324


def _outliers(samples: np.ndarray, rng: Generator) -> None:
    nodes = _some_nodes(rng)
    away = rng.normal(size=(len(samples), len(nodes), 3))
    samples[:, nodes] += OUTLIER_M * away / np.linalg.norm(away, axis=-1, keepdims=True)


def _swapped_fingers(samples: np.ndarray, rng: Generator) -> None:
    first, second = rng.choice(CHAINS[1:], 2, replace=False)
    a, b = chain_indices(first), chain_indices(second)
    samples[:, [*a, *b]] = samples[:, [*b, *a]]


def _dropout(samples: np.ndarray, rng: Generator) -> None:
    samples[:] = np.nan


def _twice_as_large(samples: np.ndarray, rng: Generator) -> None:
    samples *= 2.0


def _millimetres(samples: np.ndarray, rng: Generator) -> None:
    samples *= 1e3


FAULTS: Mapping[str, Callable[[np.ndarray, Generator], None]] = {
    "NaN": _nan,
    "infinite": _infinite,
    "zeros": _zeros,
    "denormal": _denormal,
    "50 mm outliers": _outliers,
    "swapped fingers": _swapped_fingers,
    "1 s dropout": _dropout,
    "twice as large": _twice_as_large,
    "millimetres": _millimetres,
}


def fuzzed(motion: Motion, rng: Generator) -> FuzzedMotion:
    """Inject faults of all kinds one after another, with clean samples in between."""
    keypoints = motion.keypoints_m.copy()
    num = len(keypoints)
    kind = np.full(num, -1, dtype=np.int64)
    names = list(FAULTS)
    at = 2 * CLEAN_SAMPLES
    while at < num - DROPOUT_SAMPLES - CLEAN_SAMPLES:
        index = int(rng.integers(len(names)))
        length = int(rng.integers(1, MAX_FAULT_SAMPLES + 1))
        if names[index] == "1 s dropout":
            length = DROPOUT_SAMPLES
        FAULTS[names[index]](keypoints[at : at + length], rng)
        kind[at : at + length] = index
        at += length + CLEAN_SAMPLES + int(rng.integers(CLEAN_SAMPLES))
    changed = (keypoints != motion.keypoints_m).any(axis=-1)
    # A finger's own four points, without the metacarpal.
    hit = np.stack([changed[:, chain_indices(chain)[-4:]].any(axis=1) for chain in CHAINS], axis=1)
    rows = np.arange(num)
    last = np.maximum.accumulate(np.where(kind >= 0, rows, -num))
    return FuzzedMotion(keypoints, kind, hit, rows - last)
