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
Fault = Callable[[np.ndarray, Generator], None]
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


def _filled(value: float) -> Fault:
    def fill(samples: np.ndarray, rng: Generator) -> None:
        samples[:, _some_nodes(rng)] = value

    return fill


def _infinite(samples: np.ndarray, rng: Generator) -> None:
    samples[:, _some_nodes(rng)] = rng.choice([np.inf, -np.inf])


def _outliers(samples: np.ndarray, rng: Generator) -> None:
    nodes = _some_nodes(rng)
    away = rng.normal(size=(len(samples), len(nodes), 3))
    samples[:, nodes] += OUTLIER_M * away / np.linalg.norm(away, axis=-1, keepdims=True)


def _swapped_fingers(samples: np.ndarray, rng: Generator) -> None:
    first, second = rng.choice(CHAINS[1:], 2, replace=False)
    a, b = chain_indices(first), chain_indices(second)
    samples[:, [*a, *b]] = samples[:, [*b, *a]]


def _scaled(factor: float) -> Fault:
    def scale(samples: np.ndarray, _: Generator) -> None:
        samples *= factor

    return scale


FAULTS: Mapping[str, Fault] = {
    "NaN": _filled(np.nan),
    "infinite": _infinite,
    "zeros": _filled(0.0),
    "denormal": _filled(5e-324),
    "50 mm outliers": _outliers,
    "swapped fingers": _swapped_fingers,
    "1 s dropout": lambda samples, _: samples.fill(np.nan),
    "twice as large": _scaled(2.0),
    "millimetres": _scaled(1e3),
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
