"""Mistakes of demonstrators and policies: changes of the commands of a whole take.

Evaluators are trained on the kinds of `TRAINING`, developed on those of `DEVELOPMENT`, measured on
those of `HELD_OUT`. Each has a size that grows with its strength, 0 … 1; the rest is drawn.
"""

import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import interpolate_linear, interpolate_poses, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import HandTrajectory
from dextouch.tactile.layout import SIDES
from services.twin.demonstrators import NUM_GRID_STEPS, MotionScene
from services.twin.simulation import MODEL_RATE_HZ

_STEPS: Final = np.arange(NUM_GRID_STEPS, dtype=np.float64)
# The first command is the pose at the start; mistakes grow from it within this many steps.
_ONSET_STEPS: Final = 8.0
# Fingers count as closing once they have gone this part of their way from the first posture.
_CLOSING: Final = 0.3
# A hand that goes less far in a take is idle.
_MOVING_M: Final = 0.01
_STREAM: Final = 102
_FORM: Final = re.compile(r"([a-z_]{1,32})=(\d(?:\.\d{1,3})?)")


@dataclass(frozen=True)
class Mistake:
    """One kind of mistake with its strength, 0 (none) … 1."""

    kind: str
    strength: float

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownNameError("kind of mistake", self.kind, list(KINDS))
        if not 0 <= self.strength <= 1:
            raise InvalidInputError(
                f"mistake {self.kind}: got a strength of {self.strength}, expected 0 … 1"
            )

    @classmethod
    def parse(cls, text: str) -> "Mistake":
        """A mistake from KIND=STRENGTH; raises InvalidInputError or UnknownNameError."""
        match = _FORM.fullmatch(text)
        if match is None:
            raise InvalidInputError(f"mistake: got {text!r}, expected KIND=STRENGTH, 0 … 1")
        return cls(match[1], float(match[2]))

    def __str__(self) -> str:
        return f"{self.kind}={self.strength:g}"


def with_mistakes(
    commands: HandTrajectory, mistakes: Sequence[Mistake], scene: MotionScene, seed: int
) -> HandTrajectory:
    """Commands with all mistakes in order, deterministic; the first command and the head stay."""
    for mistake in mistakes:
        kind = zlib.crc32(mistake.kind.encode())
        draw = np.random.default_rng([seed, _STREAM, kind])
        commands = KINDS[mistake.kind](_Take(commands, scene), mistake.strength, draw)
    return commands


@dataclass(frozen=True)
class _Take:
    """Commands that can be changed; per hand, left before right."""

    commands: HandTrajectory
    scene: MotionScene

    @property
    def wrist_poses(self) -> Float64[np.ndarray, "2 81 4 4"]:
        return np.stack([self.commands.Ts_world_wrist_left, self.commands.Ts_world_wrist_right])

    @property
    def joints(self) -> Float64[np.ndarray, "2 81 20"]:
        return np.stack([self.commands.joints_left_rad, self.commands.joints_right_rad])

    def of(self, Ts: np.ndarray | None = None, joints: np.ndarray | None = None) -> HandTrajectory:
        """The take with other wrist poses or joint angles; angles stay within their limits."""
        Ts = self.wrist_poses if Ts is None else Ts
        joints = self.joints if joints is None else joints
        inside = [
            np.clip(q, hand.kinematics.lower_rad, hand.kinematics.upper_rad)
            for q, hand in zip(joints, self.scene.hands, strict=True)
        ]
        Ts[:, 0] = self.wrist_poses[:, 0]
        for changed, before in zip(inside, self.joints, strict=True):
            changed[0] = before[0]
        return HandTrajectory(
            Ts[0], Ts[1], inside[0], inside[1], self.commands.Ts_world_camera_head
        )

    def at(
        self, steps: Float64[np.ndarray, "2 81"], joint_steps: np.ndarray | None = None
    ) -> HandTrajectory:
        """The take sampled at other steps, of each hand and of its fingers."""
        Ts, joints = [], []
        for side in range(len(SIDES)):
            left, weight = _places(steps[side])
            Ts.append(interpolate_poses(self.wrist_poses[side], left, weight))
            if joint_steps is not None:
                left, weight = _places(joint_steps[side])
            joints.append(interpolate_linear(self.joints[side], left, weight))
        return self.of(np.stack(Ts), np.stack(joints))

    def closed_by(self, share: float | np.ndarray) -> HandTrajectory:
        """The take with fingers that go this share of their way from the first posture."""
        first = self.joints[:, :1]
        return self.of(joints=first + share * (self.joints - first))

    def shifted(self, offsets_m: np.ndarray) -> HandTrajectory:
        """The take with both wrists [81, 3], or each [2, 81, 3], moved in the world."""
        Ts = self.wrist_poses.copy()
        Ts[..., :3, 3] += offsets_m
        return self.of(Ts)

    def turned(self, vectors_rad: np.ndarray, *, about_fingers: bool) -> HandTrajectory:
        """The take with each wrist turned in the world [81, 3], about fingertips or wrist."""
        Ts = self.wrist_poses.copy()
        R = rotation_from_vector(vectors_rad)
        for side, hand in enumerate(self.scene.hands):
            tips = hand.kinematics.fingertips_m(self.joints[side]).mean(axis=1)
            centre = tips * float(about_fingers)
            at_m = np.einsum("nij,nj->ni", Ts[side, :, :3, :3], centre) + Ts[side, :, :3, 3]
            turned = R @ Ts[side, :, :3, :3]
            Ts[side] = transform(turned, at_m - np.einsum("nij,nj->ni", turned, centre))
        return self.of(Ts)

    @property
    def closing_step(self) -> int:
        """Step from which the first hand closes; a third of the take where none does."""
        way = np.abs(self.joints - self.joints[:, :1]).max(axis=-1)
        closing = way > _CLOSING * np.maximum(way.max(axis=1, keepdims=True), 0.1)
        found = [int(row.argmax()) for row in closing if row.any()]
        return min(found, default=NUM_GRID_STEPS // 3)


Draw = np.random.Generator


def _places(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    at = np.clip(steps, 0, NUM_GRID_STEPS - 1)
    left = np.minimum(at.astype(np.int64), NUM_GRID_STEPS - 2)
    return left, at - left


def _ramp(first: float, last: float) -> Float64[np.ndarray, "81"]:
    """0 before a step, 1 after another one, smooth in between."""
    share = np.clip((_STEPS - first) / max(last - first, 1e-6), 0, 1)
    return share * share * (3 - 2 * share)


def _onset() -> Float64[np.ndarray, "81 1"]:
    return _ramp(0.0, _ONSET_STEPS)[:, None]


def _bump(middle: float, width: float) -> Float64[np.ndarray, "81 1"]:
    """Bell about a step, zero at the first."""
    return np.exp(-0.5 * ((_STEPS - middle) / width) ** 2)[:, None] * _onset()


def _direction(draw: Draw, size: int = 3) -> np.ndarray:
    vector = draw.normal(size=size)
    return vector / np.linalg.norm(vector)


def _sign(draw: Draw) -> float:
    return 1.0 if draw.random() < 0.5 else -1.0


def _both(steps: np.ndarray) -> Float64[np.ndarray, "2 81"]:
    return np.broadcast_to(steps, (len(SIDES), NUM_GRID_STEPS))


def _one_side(take: "_Take", draw: Draw) -> Float64[np.ndarray, "2 1"]:
    """1 for one of the hands that move, 0 for the other."""
    way_m = np.ptp(take.wrist_poses[:, :, :3, 3], axis=1).max(axis=1)
    moving = np.flatnonzero(way_m >= min(_MOVING_M, way_m.max()))
    side = np.zeros((len(SIDES), 1))
    side[int(draw.choice(moving))] = 1.0
    return side


def _correlated(draw: Draw, tau_s: float, size: int) -> Float64[np.ndarray, "81 size"]:
    """Ornstein-Uhlenbeck noise of unit standard deviation."""
    kept = np.exp(-1 / (MODEL_RATE_HZ * tau_s))
    noise = np.zeros((NUM_GRID_STEPS, size))
    for step in range(1, NUM_GRID_STEPS):
        noise[step] = kept * noise[step - 1] + np.sqrt(1 - kept**2) * draw.normal(size=size)
    return noise


def _height(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    return take.shifted(_onset() * [0, 0, _sign(draw) * 0.025 * strength])


def _offset(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    each = np.stack([_direction(draw), _direction(draw)])
    return take.shifted(0.030 * strength * each[:, None] * _onset())


def _yaw(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    angle = _sign(draw) * np.deg2rad(50) * strength
    return take.turned(_onset() * [0, 0, angle], about_fingers=True)


def _tilt(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    axis = np.array([*_direction(draw, 2), 0.0])
    return take.turned(_onset() * axis * np.deg2rad(30) * strength, about_fingers=True)


def _wrist_turn(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    return take.turned(_onset() * _direction(draw) * np.deg2rad(18) * strength, about_fingers=False)


def _tempo(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    return take.at(_both(_STEPS * 2.0 ** (_sign(draw) * strength)))


def _pause(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    first, length = draw.uniform(5, 60), 2.0 * MODEL_RATE_HZ * strength
    delay = np.clip(_STEPS - first, 0, length)
    return take.at(_both(_STEPS - delay))


def _finger_time(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    late = _sign(draw) * 0.7 * MODEL_RATE_HZ * strength
    return take.at(_both(_STEPS), _both(_STEPS - late))


def _grip(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    share = 1 - strength if draw.random() < 0.6 else 1 + 0.5 * strength
    return take.closed_by(share)


def _opening(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """All fingers more open or closed than meant, at every step."""
    turn = _sign(draw) * 0.6 * strength
    spread = np.tile(np.array([1.0, 0.0, 1.0, 0.6]), 5)
    return take.of(joints=take.joints + turn * spread * _onset())


def _finger(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """One finger does not close, or two do not."""
    chosen = np.zeros(5)
    chosen[draw.permutation(5)[: draw.integers(1, 3)]] = strength
    return take.closed_by(1 - np.repeat(chosen, 4))


def _release(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Fingers open for a while, or for good."""
    first = draw.uniform(12, 65)
    last = first + draw.uniform(3, 15) if draw.random() < 0.5 else NUM_GRID_STEPS + 9.0
    return take.closed_by(1 - strength * (_ramp(first, first + 3) - _ramp(last, last + 3))[:, None])


def _bumps(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """A path with detours at any time."""
    offset = np.zeros((NUM_GRID_STEPS, 3))
    for _ in range(int(draw.integers(1, 4))):
        size = draw.normal(size=3) * np.array([0.060, 0.060, 0.035]) * strength
        offset += _bump(draw.uniform(0, 80), draw.uniform(2, 9)) * size
    return take.shifted(offset)


def _sweep(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """On its way to the first contact a hand comes through an object's place."""
    poses = take.scene.object_poses
    target_m = poses[draw.integers(len(poses)), :3] + draw.normal(size=3) * [0.02, 0.02, 0.01]
    middle = draw.uniform(3, max(4.0, take.closing_step - 2.0))
    row = int(middle)
    Ts = take.wrist_poses.copy()
    tips_m = []
    for side, hand in enumerate(take.scene.hands):
        tips = hand.kinematics.fingertips_m(take.joints[side, row][None])[0].mean(axis=0)
        tips_m.append(Ts[side, row, :3, :3] @ tips + Ts[side, row, :3, 3])
    side = int(np.linalg.norm(np.array(tips_m) - target_m, axis=1).argmin())
    way_m = target_m + np.array([0.0, 0.0, 0.015]) - tips_m[side]
    Ts[side, :, :3, 3] += strength * way_m * _bump(middle, draw.uniform(1.5, 4))
    return take.of(Ts)


def _wrong_object(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Until they hold something, hands go towards another object, or beside the right one."""
    places_m = take.scene.object_poses[:, :2]
    first = int(draw.integers(len(places_m)))
    way_m = _direction(draw, 2) * 0.12
    if len(places_m) > 1 and draw.random() < 0.6:
        other = int(draw.choice(np.delete(np.arange(len(places_m)), first)))
        way_m = places_m[other] - places_m[first]
    side = _one_side(take, draw)[..., None]
    later = take.closing_step + draw.uniform(2, 40)
    back = (1 - _ramp(later, later + 10))[:, None]
    return take.shifted(side * strength * _onset() * back * [*way_m, 0.0])


def _jitter(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    tau_s = draw.uniform(0.1, 0.8)
    moved = take.shifted(_onset() * _correlated(draw, tau_s, 3) * 0.012 * strength)
    turns = _onset() * _correlated(draw, tau_s, 3) * 0.10 * strength
    return _Take(moved, take.scene).turned(turns, about_fingers=False)


def _drift(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    grown = (_STEPS / NUM_GRID_STEPS)[:, None]
    return take.shifted(grown * _direction(draw) * 0.06 * strength)


def _second_half(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """The second place is wrong by centimetres, the first is right."""
    first = draw.uniform(25, 50)
    way = _ramp(first, first + 10)[:, None]
    moved = take.shifted(way * _direction(draw) * 0.05 * strength)
    turns = way * _direction(draw) * np.deg2rad(25) * strength
    return _Take(moved, take.scene).turned(turns, about_fingers=True)


def _one_hand_late(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    late = _one_side(take, draw) * 1.2 * MODEL_RATE_HZ * strength
    return take.at(_STEPS - late)


def _side_approach(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Until the fingers close, hands come in low and from aside instead of from above."""
    closing = take.closing_step
    before = (1 - _ramp(0.3 * closing, closing - 1.0))[:, None] * _onset()
    z_m = take.wrist_poses[:, :, 2, 3]
    lower = np.minimum(0.0, z_m[:, closing, None] - z_m)[..., None] * [0, 0, 1.0]
    aside = np.array([*_direction(draw, 2), 0.0]) * 0.10
    return take.shifted(
        strength * (before * aside + _onset() * (closing > _STEPS)[:, None] * lower)
    )


def _low_rate(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Commands change only every so many steps."""
    every = 1 + round(19 * strength)
    return take.at(_both(np.floor(_STEPS / every) * every + draw.uniform(0, 1e-6)))


def _overshoot(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Hands go on in the direction of their motion and come back late."""
    ahead = 3 + draw.uniform(0, 3)
    later, earlier = (
        _Take(take.at(_both(_STEPS + d)), take.scene).wrist_poses for d in (ahead, -ahead)
    )
    speed_m = later[..., :3, 3] - earlier[..., :3, 3]
    return take.shifted(0.5 * strength * speed_m * _onset())


def _frame_yaw(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """The whole motion is turned about the middle of the table, as by a wrong calibration."""
    angle = _sign(draw) * np.deg2rad(12) * strength
    R = rotation_from_vector(_onset() * [0, 0, angle])
    middle = np.array([0.0, 0.03, 0.0])
    Ts = take.wrist_poses.copy()
    turned = np.einsum("nij,snj->sni", R, Ts[..., :3, 3] - middle) + middle
    Ts[..., :3, :3] = R @ Ts[..., :3, :3]
    Ts[..., :3, 3] = turned
    return take.of(Ts)


def _smooth(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Corners are cut: wrists follow a moving mean of the path."""
    del draw
    reach = round(12 * strength)
    padded = np.pad(take.wrist_poses[..., :3, 3], ((0, 0), (reach, reach), (0, 0)), mode="edge")
    window = np.ones(2 * reach + 1) / (2 * reach + 1)
    mean = np.apply_along_axis(lambda path: np.convolve(path, window, "valid"), 1, padded)
    return take.shifted((mean - take.wrist_poses[..., :3, 3]) * _onset())


def _gain(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Every way from the first place is too long or too short."""
    way_m = take.wrist_poses[..., :3, 3] - take.wrist_poses[:, :1, :3, 3]
    return take.shifted(_sign(draw) * 0.20 * strength * way_m)


def _shake(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    rate_hz, phase = draw.uniform(1.5, 5.0), draw.uniform(0, 2 * np.pi)
    wave = np.sin(2 * np.pi * rate_hz * _STEPS / MODEL_RATE_HZ + phase)[:, None]
    return take.shifted(_onset() * wave * _direction(draw) * 0.025 * strength)


def _regrasp(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """After closing, fingers open and close again."""
    first = take.closing_step + draw.uniform(2, 10)
    length = 2 + 12 * strength
    opened = _ramp(first, first + 3) - _ramp(first + length, first + length + 4)
    return take.closed_by(1 - opened[:, None])


def _short(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Hands never come lower than some height above the lowest of their path."""
    del draw
    z_m = take.wrist_poses[..., 2, 3]
    floor_m = z_m.min(axis=1, keepdims=True) + 0.04 * strength
    raised = np.maximum(z_m, np.minimum(floor_m, z_m[:, :1])) - z_m
    return take.shifted(raised[..., None] * [0, 0, 1.0])


def _roll(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Each wrist is turned about the axis along its fingers."""
    angle = _sign(draw) * np.deg2rad(40) * strength
    R = rotation_from_vector(_onset() * [0, 0, angle])
    Ts = take.wrist_poses.copy()
    Ts[..., :3, :3] = Ts[..., :3, :3] @ R
    return take.of(Ts)


def _rush(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """After closing, the rest is done in a hurry."""
    del draw
    closing = take.closing_step
    return take.at(_both(_STEPS + np.maximum(0, _STEPS - closing) * 3 * strength))


def _quantized(take: _Take, strength: float, draw: Draw) -> HandTrajectory:
    """Places are rounded to a grid."""
    cell_m = 0.002 + 0.05 * strength
    origin = draw.uniform(0, cell_m, size=3)
    at_m = take.wrist_poses[..., :3, 3]
    rounded = np.round((at_m - origin) / cell_m) * cell_m + origin
    return take.shifted((rounded - at_m) * _onset())


Kind = Callable[[_Take, float, Draw], HandTrajectory]


def _named(*kinds: Kind) -> dict[str, Kind]:
    return {kind.__name__.removeprefix("_"): kind for kind in kinds}


TRAINING: Final = _named(
    *(_height, _offset, _yaw, _tilt, _wrist_turn, _tempo, _pause, _finger_time, _grip),
    *(_opening, _finger, _release, _bumps, _sweep, _wrong_object, _jitter, _drift),
    _second_half,
)
DEVELOPMENT: Final = _named(_one_hand_late, _side_approach, _low_rate, _overshoot, _frame_yaw)
HELD_OUT: Final = _named(_smooth, _gain, _shake, _regrasp, _short, _roll, _rush, _quantized)
KINDS: Final[dict[str, Kind]] = TRAINING | DEVELOPMENT | HELD_OUT
