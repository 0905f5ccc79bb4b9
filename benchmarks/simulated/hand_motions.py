"""Synthetic hand motions with known joint angles, their keypoints, noise and dropouts.

Motions are generated, deterministic by seed. Robot motions move all 20 joints independently,
simultaneously and fast, without finger contact. Human ones are in `pinches`.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from numpy.random import Generator

from benchmarks.simulated.finger_contact import touching
from dextouch.errors import LimitExceededError
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS
from dextouch.tactile.layout import Side
from services.twin.hands import TwinHand, twin_hand

RATE_HZ: Final = 60.0
# Maximum joint speed of motions; the real hand reaches about 9.6 rad/s.
MAX_SPEED_RAD_S: Final = 9.0
SINE_RANGE_HZ: Final = (0.15, 1.6)
_NUM_SINES: Final = 3
# Usual ranges: flexion, abduction and the two outer joints of a finger, then of the thumb.
NATURAL_FINGER_RAD: Final = ((-0.15, 1.40), (-0.25, 0.25), (0.0, 1.75), (0.0, 1.25))
NATURAL_THUMB_RAD: Final = ((-0.40, 0.90), (-0.90, 0.35), (0.0, 1.00), (0.0, 1.20))
# Full range ends before the limits, so that true angles are inside them.
_FULL_SHARE: Final = 0.98
# Number of samples over which touching fingers are opened.
_GATE_SAMPLES: Final = 25
_GATE_STEP: Final = 0.1
_MAX_TRIES: Final = 12


@dataclass(frozen=True)
class Motion:
    """A hand motion with known joint angles at 60 Hz, and its tracked keypoints.

    Joint angles are in firmware order; keypoints (NaN: not tracked), in the order of
    `dextouch.hands.NODES`, and true fingertips, thumb … little, in wrist coordinates.
    """

    side: Side
    joints_rad: Float64[np.ndarray, "time 20"]
    keypoints_m: Float64[np.ndarray, "time 25 3"]
    tips_m: Float64[np.ndarray, "time 5 3"]

    def __len__(self) -> int:
        return len(self.joints_rad)


def robot_motion(side: Side, num_samples: int, seed: int, *, natural: bool) -> Motion:
    """Robot hand motion: a sum of sines of 0.15 to 1.6 Hz per joint, collision-free.

    At least 2 samples at 60 Hz; natural: within the usual range of hands, otherwise the joints'
    whole range.

    Raises:
        LimitExceededError: no motion of this seed is slow enough and collision-free.
    """
    hand = twin_hand(side, "robot")
    rng = np.random.default_rng([seed, int(natural), int(side == "right")])
    rate_hz = rng.uniform(*SINE_RANGE_HZ, (NUM_JOINTS, _NUM_SINES))
    turn = rng.random((NUM_JOINTS, _NUM_SINES))
    period_s, fastest = 1.0 / RATE_HZ, np.inf
    for _ in range(_MAX_TRIES):
        t_s = np.arange(num_samples) * period_s
        joints = _without_contact(hand, _waves(hand, t_s, rate_hz, turn, natural=natural))
        fastest = float(np.abs(np.diff(joints, axis=0)).max()) * RATE_HZ
        if fastest <= MAX_SPEED_RAD_S:
            return motion_of(hand, joints)
        # The same motion, played more slowly.
        period_s *= 0.97 * MAX_SPEED_RAD_S / fastest
    raise LimitExceededError(
        f"motion of the {side} hand, seed {seed}: got a joint speed of {fastest:.3g} rad/s after "
        f"{_MAX_TRIES} tries, expected at most {MAX_SPEED_RAD_S:g}; use another seed"
    )


def motion_of(hand: TwinHand, joints_rad: np.ndarray) -> Motion:
    """Motion of a robot hand with joint angles [T, 20]; nodes that it does not have are static."""
    joints = np.asarray(joints_rad, dtype=np.float64)
    points = hand.kinematics.chain_points_m(joints)
    keypoints = np.zeros((len(joints), NUM_KEYPOINTS, 3))
    for index, chain in enumerate(CHAINS):
        keypoints[:, solver_indices(chain)] = points[:, index]
        if (chain, "metacarpal") in NODE_INDEX and chain != "thumb":
            base_m = np.array(hand.kinematics.fingers[index].joints[0].position_m)
            keypoints[:, NODE_INDEX[chain, "metacarpal"]] = 0.4 * base_m
    return Motion(hand.side, joints, keypoints, points[:, :, 3])


def with_noise(motion: Motion, sigma_m: float, rng: Generator) -> Motion:
    """Add Gaussian noise to all nodes except the wrist; joint angles are unchanged."""
    noise = rng.normal(0.0, sigma_m, motion.keypoints_m.shape)
    noise[:, NODE_INDEX["wrist", "wrist"]] = 0.0
    return replace(motion, keypoints_m=motion.keypoints_m + noise)


def with_dropouts(motion: Motion, share: float, rng: Generator) -> Motion:
    """Randomly drop nodes (NaN), except the wrist; joint angles are unchanged."""
    lost: Bool[np.ndarray, "time 25"] = rng.random(motion.keypoints_m.shape[:2]) < share
    lost[:, NODE_INDEX["wrist", "wrist"]] = False
    return replace(motion, keypoints_m=np.where(lost[..., None], np.nan, motion.keypoints_m))


def cold_postures(side: Side, num_postures: int, seed: int) -> Motion:
    """Independent random postures within the limits."""
    hand = twin_hand(side, "robot")
    low, high = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    rng = np.random.default_rng([seed, int(side == "right")])
    return motion_of(hand, rng.uniform(low, high, (num_postures, NUM_JOINTS)))


def _waves(
    hand: TwinHand, t_s: np.ndarray, rate_hz: np.ndarray, turn: np.ndarray, *, natural: bool
) -> Float64[np.ndarray, "time 20"]:
    """Oscillating joint angles over their range, with larger slow components."""
    low, high = hand.kinematics.lower_rad, hand.kinematics.upper_rad
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * _FULL_SHARE
    if natural:
        rows = np.array([NATURAL_THUMB_RAD, *[NATURAL_FINGER_RAD] * (NUM_FINGERS - 1)])
        low, high = np.maximum(rows[..., 0].ravel(), low), np.minimum(rows[..., 1].ravel(), high)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
    weights = rate_hz**-0.5
    weights /= weights.sum(axis=1, keepdims=True)
    sines = np.sin(2 * np.pi * (rate_hz * t_s[:, None, None] + turn))
    return middle + half * (weights * sines).sum(axis=-1)


def _without_contact(hand: TwinHand, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 20"]:
    """The motion with fingers opened as far as needed to avoid contact."""
    fingers = joints_rad.reshape(len(joints_rad), NUM_FINGERS, -1)
    share = np.ones(fingers.shape[:2])
    while True:
        kept = (fingers * _smooth_below(share)[..., None]).reshape(joints_rad.shape)
        contact = touching(hand, kept)
        if not contact.any():
            return kept
        share = np.where(contact, np.maximum(share - _GATE_STEP, 0.0), share)


def _smooth_below(share: np.ndarray) -> Float64[np.ndarray, "time 5"]:
    """A smooth lower bound: moving average of the moving minimum."""
    width = 2 * _GATE_SAMPLES + 1
    least = _windows(share, width).min(axis=-1)
    hat = np.hanning(width + 2)[1:-1]
    return np.asarray(_windows(least, width) @ (hat / hat.sum()))


def _windows(values: np.ndarray, width: int) -> np.ndarray:
    padded = np.pad(values, ((width // 2, width // 2), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
