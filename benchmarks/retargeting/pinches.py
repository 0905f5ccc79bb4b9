"""Pinch motions of simulated people with known bones and joint angles.

The joint angles of a pinch are solved numerically: at its centre the tips are less than 3 mm apart.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares

from benchmarks.simulated.hand_motions import Motion
from dextouch.errors import LimitExceededError
from dextouch.hands import CHAINS, NODE_INDEX
from dextouch.hands.robot_hand import NUM_FINGERS
from dextouch.tactile.layout import Side
from services.twin.hands import METACARPAL_BASES_M, HumanHand, human_fingers

# Sizes of the people against the average; each of their bones differs by up to 8 % more.
SIZES: Final = (0.85, 0.92, 1.0, 1.08, 1.15)
BONE_SPREAD: Final = 0.08
PINCHED_M: Final = 0.003
# Samples at 60 Hz of one pinch: closing, held, opening, at rest. Four pinches are 440.
CLOSING: Final = 36
HELD: Final = 28
RESTING: Final = 10
# Postures solved for while a pinch is held; in between the tips move apart by much less than 3 mm.
_ROLL_SOLVES: Final = 5
# Half-closed start and end posture, thumb first.
_RELAXED_RAD: Final = (0.1, -0.3, 0.2, 0.3, *(0.35, 0.0, 0.45, 0.25) * 4)
# Postures that a solved pinch stays near, as flexion of the fingers' three flexing joints: one at
# its begin, one at its end, so that the tips roll on each other while held.
_PINCH_CURLS_RAD: Final = ((0.75, 0.0, 0.85, 0.40), (0.60, 0.05, 1.05, 0.55))
_PINCH_THUMB_RAD: Final = ((0.4, -0.6, 0.3, 0.4), (0.3, -0.7, 0.4, 0.5))
# Weight: one millimetre between the tips equals 14 degrees of deviation from the posture.
_NEAR_RAD: Final = 0.25
_GAP_SCALE_M: Final = 1e-3


@dataclass(frozen=True)
class PinchMotion(Motion):
    """A motion with one pinch after the other, index … little.

    `gaps_m` are the true distances of the thumb's tip to that of index, middle, ring and little.
    """

    gaps_m: Float64[np.ndarray, "time 4"]

    @property
    def pinched(self) -> Bool[np.ndarray, "time 4"]:
        """Where the human tips are less than 3 mm apart."""
        return np.asarray(self.gaps_m < PINCHED_M)


class Person(HumanHand):
    """A human hand of a size relative to the average, with deviations of all bones by seed."""

    def __init__(self, side: Side, size: float, seed: int) -> None:
        self.size = size
        rng = np.random.default_rng([seed, int(side == "right")])
        fingers = tuple(
            finger._replace(
                joints=tuple(
                    row._replace(position_m=_longer(row.position_m, size, rng))
                    for row in finger.joints
                ),
                tip_m=_longer(finger.tip_m, size, rng),
            )
            for finger in human_fingers(side)
        )
        super().__init__(side, fingers)

    def keypoints_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
        """The 25 tracked nodes in wrist coordinates, metres, for joint angles [T, 20]."""
        keypoints = super().keypoints_m(joints_rad)
        for chain in METACARPAL_BASES_M:
            keypoints[:, NODE_INDEX[chain, "metacarpal"]] *= self.size
        return keypoints


def people(side: Side, seed: int) -> list[Person]:
    """Five people from small to large."""
    return [Person(side, size, 1000 * seed + index) for index, size in enumerate(SIZES)]


def pinch_motion(person: Person, side: Side) -> PinchMotion:
    """Four consecutive pinches: closing, holding while the tips roll, opening; 440 samples.

    Raises:
        LimitExceededError: this hand cannot bring a pair of tips together within its limits.
    """
    relaxed = np.array(_RELAXED_RAD)
    parts = []
    for finger in range(1, NUM_FINGERS):
        closed, rolled = (_solve_pinch(person, finger, posture) for posture in range(2))
        held = _roll(person, finger, closed, rolled)
        parts += [
            _glide(relaxed, closed, CLOSING),
            held,
            _glide(rolled, relaxed, CLOSING),
            np.repeat(relaxed[None], RESTING, axis=0),
        ]
    joints = np.concatenate(parts)
    tips = person.fingertips_m(joints)
    gaps = np.linalg.norm(tips[:, 1:] - tips[:, :1], axis=-1)
    return PinchMotion(side, joints, person.keypoints_m(joints), tips, gaps)


@lru_cache(maxsize=4)
def pinch_motions(side: Side, seed: int) -> tuple[PinchMotion, ...]:
    """The pinches of five people, small to large."""
    return tuple(pinch_motion(person, side) for person in people(side, seed))


def _longer(
    place_m: tuple[float, float, float], size: float, rng: np.random.Generator
) -> tuple[float, float, float]:
    factor = size * (1.0 + rng.uniform(-BONE_SPREAD, BONE_SPREAD))
    x, y, z = place_m
    return x * factor, y * factor, z * factor


def _solve_pinch(person: Person, finger: int, posture: int) -> Float64[np.ndarray, "20"]:
    """Joint angles with the tips of thumb and finger together, near a posture, within limits."""
    near = np.array(_RELAXED_RAD)
    near[:4] = _PINCH_THUMB_RAD[posture]
    near[4 * finger : 4 * finger + 4] = _PINCH_CURLS_RAD[posture]
    return _together(person, finger, near)


def _together(person: Person, finger: int, near_rad: np.ndarray) -> Float64[np.ndarray, "20"]:
    """The joint angles nearest to a posture that bring both tips together."""
    moving = np.r_[0:4, 4 * finger : 4 * finger + 4]
    joints = near_rad.copy()
    low, high = person.lower_rad[moving], person.upper_rad[moving]

    def residual(angles_rad: np.ndarray) -> np.ndarray:
        joints[moving] = angles_rad
        tips = person.fingertips_m(joints[None])[0]
        off = (angles_rad - near_rad[moving]) / _NEAR_RAD
        return np.concatenate([(tips[finger] - tips[0]) / _GAP_SCALE_M, off])

    begin = np.clip(near_rad[moving], low + 1e-3, high - 1e-3)
    joints[moving] = least_squares(residual, begin, bounds=(low, high)).x
    tips = person.fingertips_m(joints[None])[0]
    gap_m = float(np.linalg.norm(tips[finger] - tips[0]))
    if gap_m >= PINCHED_M:
        raise LimitExceededError(
            f"pinch of thumb and {CHAINS[finger]}, {person.side} hand of size {person.size:g}: the "
            f"tips stay {gap_m * 1e3:.2g} mm apart, expected less than {PINCHED_M * 1e3:g} mm"
        )
    return joints


def _roll(
    person: Person, finger: int, first: np.ndarray, last: np.ndarray
) -> Float64[np.ndarray, "time 20"]:
    """Transition from one pinch posture to another with the tips in contact."""
    between = _glide(first, last, _ROLL_SOLVES)[1:-1]
    solved = np.array([first, *(_together(person, finger, near) for near in between), last])
    when = np.linspace(0, _ROLL_SOLVES - 1, HELD)
    before = np.minimum(when.astype(int), _ROLL_SOLVES - 2)
    part = (when - before)[:, None]
    return np.asarray(solved[before] * (1 - part) + solved[before + 1] * part)


def _glide(first: np.ndarray, last: np.ndarray, num_samples: int) -> Float64[np.ndarray, "time 20"]:
    """Smooth transition between two postures, both ends included."""
    t = np.linspace(0.0, 1.0, num_samples)[:, None]
    return np.asarray(first + (last - first) * t**3 * (10 - 15 * t + 6 * t**2))
