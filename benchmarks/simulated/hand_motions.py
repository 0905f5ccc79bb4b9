"""Synthetic hand motions with known joint angles: of the robot, of people, and with faults.

Motions are generated, deterministic by seed. Robot motions move all 20 joints independently,
simultaneously and fast, without finger contact; fingers are capsules and the palm is a box, as in
the twin. Joints of people turn about other axes than the robot's: the axes of interphalangeal
joints are oblique by up to about 14°, and those of the thumb's saddle are neither perpendicular nor
do they meet (Hollister et al., J. Orthop. Res. 1992). Joint angles of pinches are solved
numerically: at its centre the tips are less than 3 mm apart.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.random import Generator
from scipy.optimize import least_squares

from dextouch.errors import LimitExceededError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import (
    CHAINS,
    METACARPAL_NODES,
    NODE_INDEX,
    NUM_KEYPOINTS,
    chain_indices,
    mean_hand_m,
    solver_indices,
)
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, HandModel, JointRow
from dextouch.tactile.layout import Side
from services.twin.hands import (
    PALM_THICKNESS_M,
    HumanHand,
    TwinHand,
    human_fingers,
    twin_hand,
)

# Half of the palm's box across and along the hand, metres; smaller than the twin's, whose box also
# covers the knuckles that the first phalanges turn in.
PALM_HALF_M: Final = (0.034, 0.036)
_NUM_LINKS: Final = 3
_PALM_SAMPLES: Final = np.linspace(0.0, 1.0, 6)


def touching(hand: TwinHand, joints_rad: np.ndarray) -> Bool[np.ndarray, "time 5"]:
    """Fingers, thumb … little, that touch another finger or the palm, for joint angles [T, 20].

    The first link of a finger rotates inside the palm and is not checked against it.
    """
    starts, ends, radii = _capsules(hand, joints_rad)
    found = np.zeros((len(starts), NUM_FINGERS), dtype=bool)
    for a, b in combinations(range(NUM_FINGERS), 2):
        p, q = np.divmod(np.arange(_NUM_LINKS**2), _NUM_LINKS)
        gap_m = segment_distance_m(starts[:, a, p], ends[:, a, p], starts[:, b, q], ends[:, b, q])
        meets = (gap_m < radii[a, p] + radii[b, q]).any(axis=1)
        found[:, a] |= meets
        found[:, b] |= meets
    return found | _in_palm(hand, starts, ends, radii)


def _capsules(hand: TwinHand, joints_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both ends [T, 5, 3, 3] of the links' axes, wrist coordinates, and radii [5, 3]; metres."""
    points = hand.kinematics.chain_points_m(joints_rad)
    starts, ends, radii = points[:, :, :-1], points[:, :, 1:].copy(), np.array(hand.shape.radii_m)
    # The tip is on the surface: the axis of the last capsule ends one radius before it.
    last = ends[:, :, 2] - starts[:, :, 2]
    length = np.linalg.norm(last, axis=-1, keepdims=True)
    ends[:, :, 2] -= last / length * radii[:, 2, None]
    return starts, ends, radii


def _in_palm(
    hand: TwinHand, starts: np.ndarray, ends: np.ndarray, radii: np.ndarray
) -> Bool[np.ndarray, "time 5"]:
    depth_m = np.array([0.0, hand.palm_sign * 0.5 * PALM_THICKNESS_M, 0.0])
    half_m = np.array([PALM_HALF_M[0], 0.5 * PALM_THICKNESS_M, PALM_HALF_M[1]])
    along = (ends - starts)[:, :, 1:, None] * _PALM_SAMPLES[:, None]
    points = starts[:, :, 1:, None] + along - (hand.palm_centre_m - depth_m)
    outside = np.maximum(np.abs(points) - half_m, 0.0)
    reach = np.linalg.norm(outside, axis=-1).min(axis=-1)
    return np.asarray((reach < radii[:, 1:]).any(axis=-1))


def segment_distance_m(
    p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray
) -> Float64[np.ndarray, "*batch"]:
    """Distance of the segments p0–p1 and q0–q1, [..., 3] each; none may be a point.

    Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    along_p, along_q, between = p1 - p0, q1 - q0, p0 - q0
    pp, qq = _dot(along_p, along_p), _dot(along_q, along_q)
    pq, pb, qb = _dot(along_p, along_q), _dot(along_p, between), _dot(along_q, between)
    determinant = pp * qq - pq**2
    # For parallel segments any point of the first is valid.
    parallel = determinant < 1e-12 * pp * qq
    s = np.where(parallel, 0.0, (pq * qb - pb * qq) / np.where(parallel, 1.0, determinant))
    t = (pq * s.clip(0.0, 1.0) + qb) / qq
    t = t.clip(0.0, 1.0)
    s = ((pq * t - pb) / pp).clip(0.0, 1.0)
    gap = between + s[..., None] * along_p - t[..., None] * along_q
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("...k,...k->...", a, b))


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
    whole range. Raises LimitExceededError if no motion of this seed is slow enough and
    collision-free.
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


SADDLE_OFFSET_M: Final = 0.003
FASTEST_HZ: Final = 1.0


def oblique_motion(side: Side, oblique_deg: float, num_samples: int, seed: int) -> Motion:
    """Smooth gestures of everyday range at 60 Hz: fingers bend from straight to 85 %.

    Every axis of the person is tilted in a random direction by `oblique_deg` from the mean hand's,
    and those of the thumb's saddle are apart.
    """
    rng = np.random.default_rng(seed)
    hand = _person(side, oblique_deg, rng)
    joints_rad = _gestures(hand, num_samples, rng)
    chains = hand.chain_points_m(joints_rad)
    keypoints_m = np.zeros((num_samples, NUM_KEYPOINTS, 3))
    for finger, chain in enumerate(CHAINS):
        keypoints_m[:, solver_indices(chain)] = chains[:, finger]
    keypoints_m[:, METACARPAL_NODES] = mean_hand_m(side)[METACARPAL_NODES, :]
    return Motion(side, joints_rad, keypoints_m, chains[:, :, 3])


def _person(side: Side, oblique_deg: float, rng: np.random.Generator) -> HandModel:
    fingers = []
    for finger in human_fingers(side):
        rows = [_tilted(row, oblique_deg, rng) for row in finger.joints]
        if finger.chain == "thumb" and oblique_deg:
            offset_m = SADDLE_OFFSET_M * rng.normal(size=3) / np.sqrt(3)
            rows[1] = rows[1]._replace(position_m=tuple(offset_m.tolist()))
        fingers.append(finger._replace(joints=tuple(rows)))
    return HandModel(side, fingers, name="person")


def _tilted(row: JointRow, oblique_deg: float, rng: np.random.Generator) -> JointRow:
    across = np.cross(row.axis, rng.normal(size=3))
    across *= np.deg2rad(oblique_deg) / np.linalg.norm(across)
    axis = rotation_from_vector(across) @ np.array(row.axis)
    return row._replace(axis=tuple((axis / np.linalg.norm(axis)).tolist()))


def _gestures(
    hand: HandModel, num_samples: int, rng: np.random.Generator
) -> Float64[np.ndarray, "time 20"]:
    bends = np.tile([True, False, True, True], len(CHAINS))
    low = np.where(bends, 0.05 * hand.upper_rad, 0.4 * hand.lower_rad)
    high = np.where(bends, 0.85 * hand.upper_rad, 0.4 * hand.upper_rad)
    t_s = np.arange(num_samples)[:, None] / RATE_HZ
    rate_hz = rng.uniform(0.15, FASTEST_HZ, len(low))
    waves = np.sin(2 * np.pi * (rate_hz * t_s + rng.random(len(low))))
    return np.asarray(low + (high - low) * (0.5 + 0.5 * waves))


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
        keypoints[:, METACARPAL_NODES] *= self.size
        return keypoints


def people(side: Side, seed: int) -> list[Person]:
    """Five people from small to large."""
    return [Person(side, size, 1000 * seed + index) for index, size in enumerate(SIZES)]


def pinch_motion(person: Person, side: Side) -> PinchMotion:
    """Four consecutive pinches: closing, holding while the tips roll, opening; 440 samples.

    Raises LimitExceededError if this hand cannot bring a pair of tips together within its limits.
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
