"""Checks whether poses of a head and two wrists can be those of one body, live or recorded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import rotation_angle

WRISTS: Final = ("wrist_left", "wrist_right")
BODIES: Final = ("head", *WRISTS)
COMMANDED: Final = "_commanded"
# Calibration of each tracker's mount on its body (docs/streams.md).
MOUNTS: Final = {
    "wrist_left": "T_tracker_left_wrist_left",
    "wrist_right": "T_tracker_right_wrist_right",
    "head": "T_tracker_head_camera_head",
}
# Steps in which hands are where heads look and arms reach, if quaternions are read rightly.
RIGHT_SHARE: Final = 0.9
WRONG_SHARE: Final = 0.3
ALWAYS_SHARE: Final = 0.98
MAX_VIEW_RAD: Final = np.radians(75.0)
# A wrist that is commanded over the first distance does not stay within the second one.
MIN_COMMANDED_M: Final = 0.05
MAX_STILL_M: Final = 0.01
# By so much a robot's wrist is behind its command; another wrist is further away.
MAX_LAG_RAD: Final = np.radians(30.0)
MAX_LAG_M: Final = 0.15
MIN_BODY_SAMPLES: Final = 60
LEAST_DISTANCE_M: Final = 1e-6
# A tall person's wrist is 1 m from the head at most; bodies have a size, and trackers are not in
# the same place.
MAX_REACH_M: Final = 1.3
MIN_APART_M: Final = 0.02
# Hands that are apart by more are on their own sides for a while at least.
MIN_ASIDE_M: Final = 0.1
USUAL_REACH_M: Final = 0.6
REACHES_M: Final = (0.15, 1.1)
UNITS: Final = {
    "millimetres": 1e3,
    "centimetres": 1e2,
    "inches": 39.37,
    "decimetres": 10.0,
    "feet": 3.281,
    "kilometres": 1e-3,
}
# From the poses [n, 7] of a tracker to those of its body.
ToBody = Callable[[np.ndarray], np.ndarray]
_Poses = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class ImplausibleBody:
    """Why the poses of a stream cannot be those of its body, beside the others."""

    stream: str
    cause: Literal["unit", "quaternion_order", "axes", "swapped", "frozen"]
    message: str


def _reordered(poses: np.ndarray, columns: tuple[int, ...], signs: tuple[int, ...]) -> np.ndarray:
    return poses[:, [0, 1, 2, *columns]] * [1, 1, 1, *signs]


def _mirrored(poses: np.ndarray, axis: int) -> np.ndarray:
    signs = -np.ones(7)
    signs[:3] = np.where(np.arange(3) == axis, -1, 1)
    signs[[3, 4 + axis]] = 1
    return poses * signs


def _scaled(poses: np.ndarray, by: float) -> np.ndarray:
    return np.asarray(poses * ([by] * 3 + [1] * 4))


def _moved(poses: np.ndarray, axis: int) -> np.ndarray:
    return poses * np.where(np.arange(7) == axis, -1, 1)


def _y_up(poses: np.ndarray) -> np.ndarray:
    x, y, z, w, a, b, c = poses.T
    half = np.sqrt(0.5)
    turned = (half * (w - a), half * (w + a), half * (b - c), half * (b + c))
    return np.stack([x, -z, y, *turned], axis=1)


# What quaternions of one stream may be instead, and the axes of all.
_XYZW: Final = "x, y, z, w"
_TURNS: Final[Mapping[str, ToBody]] = {
    _XYZW: partial(_reordered, columns=(6, 3, 4, 5), signs=(1, 1, 1, 1)),
    "conjugates": partial(_reordered, columns=(3, 4, 5, 6), signs=(1, -1, -1, -1)),
    "conjugates x, y, z, w": partial(_reordered, columns=(6, 3, 4, 5), signs=(1, -1, -1, -1)),
}
_WORLDS: Final[Mapping[str, ToBody]] = {
    "a world whose y points up": _y_up,
    "left-handed axes with a mirrored x": partial(_mirrored, axis=0),
    "left-handed axes with a mirrored y": partial(_mirrored, axis=1),
    "left-handed axes with a mirrored z": partial(_mirrored, axis=2),
    "axes with a mirrored x of positions only": partial(_moved, axis=0),
    "axes with a mirrored y of positions only": partial(_moved, axis=1),
}


def implausible_bodies(
    poses: Mapping[str, Float64[np.ndarray, "n 7"]],
    to_body: Mapping[str, ToBody],
    *,
    of_robot: bool,
) -> ImplausibleBody | None:
    """The first reason why a head and two wrists cannot be those of one body, None without one.

    Heads are upright and look at the hands, a person's hands are within reach, on their own sides,
    with fingers that point away from the head, and a robot's wrists are where they are commanded.
    Where that does not hold, but does with another reading of the poses, they are to be read so.
    Fewer than 60 samples say nothing, and nor do poses without one of the three bodies.

    Args:
        poses: of the trackers as they were sent, x y z (m) qw qx qy qz, at common times, by stream;
            those that are commanded, too.
        to_body: mounts of trackers on their bodies, by stream.
        of_robot: whether they are a robot's.
    """
    if min((len(poses.get(name, ())) for name in BODIES), default=0) < MIN_BODY_SAMPLES:
        return None
    whole = _Bodies(poses, to_body)
    checks: tuple[Callable[[_Bodies], ImplausibleBody | None], ...] = (
        (_check_commanded, partial(_check_head, of_robot=True))
        if of_robot
        else (_check_reach, _check_head, _check_wrists, _check_sides)
    )
    return next((found for check in checks if (found := check(whole))), None)


class _Bodies:
    """Poses that may be read otherwise."""

    def __init__(self, poses: _Poses, to_body: Mapping[str, ToBody]) -> None:
        self.sent, self._to_body = dict(poses), to_body
        self._Ts: dict[str, np.ndarray] = {}

    def changed(self, change: ToBody, *names: str) -> "_Bodies":
        """Those of these streams read otherwise, by default of all."""
        changed = {name: change(self.sent[name]) for name in names or self.sent}
        return _Bodies(self.sent | changed, self._to_body)

    def exchanged(self, one: str, other: str) -> "_Bodies":
        return _Bodies(self.sent | {one: self.sent[other], other: self.sent[one]}, self._to_body)

    def transforms(self, name: str) -> Float64[np.ndarray, "n 4 4"]:
        if name not in self._Ts:
            to_body = self._to_body.get(name, np.asarray)
            self._Ts[name] = transform_from_pose(to_body(self.sent[name]))
        return self._Ts[name]

    def at_m(self, name: str) -> Float64[np.ndarray, "n 3"]:
        return np.asarray(self.transforms(name)[:, :3, 3])

    def apart_m(self, one: str, other: str) -> float:
        return float(np.median(np.linalg.norm(self.at_m(one) - self.at_m(other), axis=1)))

    def upright(self) -> float:
        """Share of the samples in which the head is upright and sees the hands."""
        head = self.transforms("head")
        hands_m = (self.at_m(WRISTS[0]) + self.at_m(WRISTS[1])) / 2
        sees = _cosines(hands_m - head[:, :3, 3], head[:, :3, 2]) > np.cos(MAX_VIEW_RAD)
        # Rows of images go down, and z of the world goes up.
        return float((sees & (head[:, 2, 1] < -np.cos(MAX_VIEW_RAD))).mean())

    def crossed(self) -> float:
        """How far (m) the left wrist always is right, by the head's x, of the other; or 0."""
        apart_m = self.at_m(WRISTS[0]) - self.at_m(WRISTS[1])
        aside_m = (apart_m * self.transforms("head")[:, :3, 0]).sum(axis=1)
        always = float((aside_m > MIN_ASIDE_M).mean()) >= ALWAYS_SHARE
        return float(np.median(aside_m)) if always else 0.0

    def forward(self, name: str) -> float:
        """Share of the samples in which fingers, along -z of the wrist, point from the head."""
        T = self.transforms(name)
        return float((_cosines(T[:, :3, 3] - self.at_m("head"), -T[:, :3, 2]) > 0).mean())

    def as_commanded(self, name: str) -> float:
        """Share of the samples in which a wrist is turned about as it was commanded."""
        R, commanded = (
            self.transforms(name)[:, :3, :3],
            self.transforms(name + COMMANDED)[:, :3, :3],
        )
        apart_rad = rotation_angle(np.swapaxes(R, -1, -2) @ commanded)
        return float((apart_rad < MAX_LAG_RAD).mean())


def _check_commanded(bodies: _Bodies) -> ImplausibleBody | None:
    """A robot's wrists turn as commanded, and are nearer to their commands than to the other's."""
    for name, other in zip(WRISTS, WRISTS[::-1], strict=True):
        if len(bodies.sent.get(name + COMMANDED, ())) < MIN_BODY_SAMPLES:
            continue
        ways_m = [np.ptp(bodies.at_m(of), axis=0).max() for of in (name, name + COMMANDED)]
        if ways_m[0] < MAX_STILL_M and ways_m[1] > MIN_COMMANDED_M:
            text = f"stands still while it is commanded over {ways_m[1]:.2f} m"
            text += ": check that it is enabled and reports its pose"
            return ImplausibleBody(name, "frozen", text)
        if (as_read := bodies.as_commanded(name)) <= WRONG_SHARE:
            share, turn = max(
                (bodies.changed(_TURNS[one], name).as_commanded(name), one) for one in _TURNS
            )
            if found := _compared(name, "turned as commanded", (as_read, share), turn):
                return found
        off_m = bodies.apart_m(name, name + COMMANDED)
        if off_m > MAX_LAG_M > bodies.apart_m(other, name + COMMANDED):
            text = (
                f"{off_m:.2f} m from where it is commanded, but {other!r} is there: exchange them"
            )
            return ImplausibleBody(name, "swapped", text)
    return None


def _check_head(bodies: _Bodies, *, of_robot: bool = False) -> ImplausibleBody | None:
    usual, as_read = "upright and sees the hands", bodies.upright()
    if as_read > WRONG_SHARE:
        return None
    # Cameras may stand opposite a robot.
    turns = [_XYZW] if of_robot else list(_TURNS)
    share, turn = max((bodies.changed(_TURNS[one], "head").upright(), one) for one in turns)
    if of_robot:
        return _compared("head", usual, (as_read, share), turn)
    worlds = {one: bodies.changed(change) for one, change in _WORLDS.items()}
    swapped = {one: bodies.exchanged("head", one) for one in WRISTS}
    others = [
        (read.upright(), of_worlds, one)
        for of_worlds, group in ((True, worlds), (False, swapped))
        for one, read in group.items()
        if not (of_worlds and read.crossed())
    ]
    best, of_worlds, one = max(others, key=lambda other: other[0], default=(0.0, True, ""))
    if best <= share or best < RIGHT_SHARE:
        return _compared("head", usual, (as_read, share), turn)
    text = f"{usual} in {as_read:.0%} of the samples, but in {best:.0%} of them if "
    if of_worlds:
        text += f"all poses are in {one}: send right-handed axes with z up"
        return ImplausibleBody("head", "axes", text)
    text += f"it is exchanged with {one!r}: exchange the trackers or their settings"
    return ImplausibleBody("head", "swapped", text)


def _check_wrists(bodies: _Bodies) -> ImplausibleBody | None:
    """A person's hand may turn to the face, hardly all the time.

    Conjugates are not tried: a hand that rests turned to the face points forward by them.
    """
    as_read = {name: bodies.forward(name) for name in WRISTS}
    if min(as_read.values()) > 1 - ALWAYS_SHARE:
        return None
    read = {name: bodies.changed(_TURNS[_XYZW], name).forward(name) for name in WRISTS}
    if min(max(as_read[name], read[name]) for name in WRISTS) < ALWAYS_SHARE:
        return None
    for name in WRISTS:
        if as_read[name] <= 1 - ALWAYS_SHARE:
            return _compared(name, "pointing forward", (as_read[name], read[name]), _XYZW)
    return None


def _check_reach(bodies: _Bodies) -> ImplausibleBody | None:
    apart_m = {name: bodies.apart_m(name, "head") for name in WRISTS}
    hands_m = bodies.apart_m(*WRISTS)
    near = min(*apart_m.values(), hands_m)
    far = [name for name in WRISTS if apart_m[name] > MAX_REACH_M]
    moves = all(np.ptp(bodies.at_m(name), axis=0).max() > 0 for name in BODIES)
    if not far and (near >= MIN_APART_M or not moves):
        return None
    if not far and max(*apart_m.values(), hands_m) >= MIN_APART_M:
        pair = min((*((name, "head") for name in WRISTS), WRISTS), key=lambda p: bodies.apart_m(*p))
        text = f"{near * 1e3:.1f} mm from {pair[1]!r}: both streams are of the same tracker"
        return ImplausibleBody(pair[0], "swapped", f"{text}; correct their settings")
    name = far[0] if far else WRISTS[0]
    scope = [name] if len(far) == 1 else []
    likely = {}
    for unit, factor in UNITS.items():
        in_m = bodies.changed(partial(_scaled, by=1 / factor), *scope)
        likely[unit] = in_m.apart_m(name, "head")
    unit = min(
        likely,
        key=lambda one: abs(float(np.log(max(likely[one], LEAST_DISTANCE_M) / USUAL_REACH_M))),
    )
    low, high = REACHES_M
    hint = "have both trackers the same origin?"
    if low <= likely[unit] <= high:
        hint = f"these look like {unit}; send metres"
    text = f"{apart_m[name]:.3g} m from the head, expected {MIN_APART_M} … {MAX_REACH_M} m: {hint}"
    return ImplausibleBody(name, "unit", text)


def _check_sides(bodies: _Bodies) -> ImplausibleBody | None:
    if bodies.upright() < RIGHT_SHARE or not (aside_m := bodies.crossed()):
        return None
    text = (
        f"right of the right wrist, by {aside_m:.2f} m as the head sees it: exchange the trackers"
    )
    return ImplausibleBody(WRISTS[0], "swapped", f"{text}, or send right-handed axes")


def _compared(
    name: str, usual: str, shares: tuple[float, float], turn: str
) -> ImplausibleBody | None:
    """What is not as usual but where quaternions are something else."""
    as_read, otherwise = shares
    if otherwise < RIGHT_SHARE:
        return None
    text = (
        f"{usual} in {as_read:.0%} of the samples, but in {otherwise:.0%} of them if its "
        f"quaternions are {turn}; expected w, x, y, z from body to world: correct them where they "
        "are sent"
    )
    return ImplausibleBody(name, "quaternion_order", text)


def _cosines(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(some, axis=1) * np.linalg.norm(others, axis=1)
    return np.asarray((some * others).sum(axis=1) / np.maximum(lengths, LEAST_DISTANCE_M))
