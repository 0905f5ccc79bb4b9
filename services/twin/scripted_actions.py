"""Open-loop policies of graded quality: the demonstrator with mistakes, and three that fail."""

import re
from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import UnknownNameError
from dextouch.geometry import transform
from dextouch.hands.actions import AnchorPoses, actions_from_poses, poses_from_actions
from services.twin.demonstrators import NUM_GRID_STEPS, MotionScene
from services.twin.mistakes import Mistake, with_mistakes
from services.twin.stage import Stage

# Names of the policies that should fail; others are named by `script_name` and `mistake_name`.
HOLD, RETREAT, ELSEWHERE = "hold", "retreat", "another scene's actions"
FAILING: Final = (HOLD, RETREAT, ELSEWHERE)
_SCRIPT: Final = re.compile(r"script (\d{1,3}(?:\.\d+)?) mm")
_MISTAKE: Final = re.compile(r"([a-z_]{1,32}) (\d(?:\.\d{1,3})?)")
# Added to the seed for the actions of another scene: the same task, objects elsewhere.
OTHER_SCENE: Final = 5_000
_RETREAT_M = np.array([0.0, -0.10, 0.12])
_RETREAT_STEPS: Final = 24
Actions = Float64[np.ndarray, "80 67"]


def script_name(level_mm: float) -> str:
    """Name of the script whose object positions are wrong by this much."""
    return f"script {level_mm:g} mm"


def mistake_name(mistake: Mistake) -> str:
    """Name of the exact script with a mistake of one kind: `tilt 0.5`."""
    return f"{mistake.kind} {mistake.strength:g}"


def mistake_of(policy: str) -> Mistake | None:
    """The mistake that a policy is named by; None for other names.

    Raises UnknownNameError: no such kind of mistake; InvalidInputError: a strength outside 0 … 1.
    """
    match = _MISTAKE.fullmatch(policy)
    return None if match is None else Mistake(match[1], float(match[2]))


def scripted_actions(stage: Stage, seed: int, policy: str) -> Actions:
    """Open-loop commands of a policy, steps 1 … 80, relative to the start's poses.

    Raises UnknownNameError: no such policy, or no such kind of mistake; InvalidInputError: a
    strength of a mistake outside 0 … 1.
    """
    level, mistake = _SCRIPT.fullmatch(policy), mistake_of(policy)
    if level is None and mistake is None and policy not in FAILING:
        raise UnknownNameError("script", policy, [script_name(10.0), "tilt 0.5", *FAILING])
    noise_m = float(level[1]) / 1000 if level else 0.0
    plan = stage.plan(seed + OTHER_SCENE * (policy == ELSEWHERE), noise_m=noise_m)
    anchor, commands = stage.start(plan), plan.commands
    if mistake is not None:
        scene = MotionScene(stage.domain, plan.object_poses)
        commands = with_mistakes(commands, [mistake], scene, seed)
    actions = actions_from_poses(commands, anchor)
    if policy == HOLD:
        actions[1:] = actions[0]
    if policy == RETREAT:
        actions = _retreat(actions[0], anchor)
    return actions[1:]


def _retreat(row: np.ndarray, anchor: AnchorPoses) -> Float64[np.ndarray, "81 67"]:
    """Both hands back and up, and still from then on."""
    still = poses_from_actions(np.repeat(row[None], NUM_GRID_STEPS, axis=0), anchor)
    way = np.minimum(np.arange(NUM_GRID_STEPS) / _RETREAT_STEPS, 1.0)
    offset = transform(np.eye(3), (way * way * (3 - 2 * way))[:, None] * _RETREAT_M)
    left, right = offset @ still.Ts_world_wrist_left, offset @ still.Ts_world_wrist_right
    moved = replace(still, Ts_world_wrist_left=left, Ts_world_wrist_right=right)
    return actions_from_poses(moved, anchor)
