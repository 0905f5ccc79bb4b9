"""Stages: tasks set up with hands, whose takes and open-loop policies follow from a seed."""

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import transform, transform_from_pose
from dextouch.hands.actions import (
    AnchorPoses,
    HandTrajectory,
    actions_from_poses,
    poses_from_actions,
)
from services.twin.cameras import CameraRig
from services.twin.demonstrators import (
    NUM_GRID_STEPS,
    MotionScene,
    WaypointNoise,
    at_another_home,
    at_own_tempo,
    follow,
    head_sway,
)
from services.twin.mistakes import Mistake, with_mistakes
from services.twin.names import Domain
from services.twin.scene import USUAL, Geometry, Sizes, compile_scene, object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.simulation import Command, Simulation
from services.twin.tasks import get_task

MAX_NOISE_M: Final = 0.2  # chosen: a demonstrator that far off grasps nothing
# Positions of the objects in a miss episode: aside, or out of view behind the viewer.
_ASIDE_M: Final = 0.13
_SHELF_Y_M: Final = -3.0
# Independent random streams for each purpose, so that noise does not affect the placement.
_PLACEMENT, _NOISE, _SWAY, _MISS, _HABIT, _TEMPO, _HOME, _LOOK = range(8)
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


@dataclass(frozen=True)
class Plan:
    """Plan of a take: true object poses, and the commands of every grid step."""

    object_poses: Float64[np.ndarray, "objects 7"]
    commands: HandTrajectory


def command_row(commands: HandTrajectory, row: int) -> Command:
    """Command of one grid step of a trajectory."""
    return Command(
        np.stack(commands.anchor(row).as_tuple()),
        np.stack([commands.joints_left_rad[row], commands.joints_right_rad[row]]),
    )


class Stage:
    """A task with the hands of a domain: compiled scene, simulation and cameras."""

    def __init__(self, task: str, domain: Domain, settings: TwinSettings) -> None:
        self.task = get_task(task)
        self.domain: Domain = domain
        self._settings = settings
        scene = compile_scene(
            domain, objects=self.task.objects_mjcf(), object_names=self.task.object_names
        )
        self.simulation = Simulation(scene)
        self._geometry, self._boxes_m = Geometry(scene), object_boxes_m(scene)
        self.rig = CameraRig(
            scene, height_px=settings.image_height_px, width_px=settings.image_width_px
        )

    def plan(
        self,
        seed: int,
        *,
        noise_m: float = 0.0,
        miss: bool = False,
        varied: bool = False,
        sizes: Sizes = USUAL,
    ) -> Plan:
        """Plan the take of a seed, 0 or more: placement, variations of the motion, and noise.

        `noise_m`, 0 … 0.2 m, is the standard deviation of the demonstrator's error at each
        location. Unknown to the demonstrator objects are moved away (`miss`) or of other `sizes`
        (see `dress`); the head camera's home may be `varied`.
        """
        if seed < 0 or not 0.0 <= noise_m <= MAX_NOISE_M:
            raise InvalidInputError(
                f"twin: got seed {seed} and noise {noise_m} m, expected seed ≥ 0 and noise "
                f"0 … {MAX_NOISE_M} m"
            )
        placed = self.task.place(np.random.default_rng([seed, _PLACEMENT]))
        errors = np.random.default_rng([seed, _NOISE])
        noise = (WaypointNoise.draw(errors, noise_m), WaypointNoise.draw(errors, noise_m))
        habits = np.random.default_rng([seed, _HABIT])
        waypoints = self.task.script(placed, self.domain, habits, noise)
        waypoints = at_own_tempo(waypoints, np.random.default_rng([seed, _TEMPO]))
        head = head_sway(np.random.default_rng([seed, _SWAY]))
        if varied:
            head = at_another_home(head, np.random.default_rng([seed, _HOME]))
        commands = follow(waypoints, head)
        if miss:
            placed = _displaced(placed, np.random.default_rng([seed, _MISS]))
        if sizes != USUAL:
            placed = self._geometry.on_the_same_level(placed, sizes, self._boxes_m)
        return Plan(placed, commands)

    def start(self, plan: Plan) -> AnchorPoses:
        """Set up a take and return the anchor, measured at step 0."""
        self.simulation.place(
            command_row(plan.commands, 0), plan.object_poses, settle_s=self._settings.settle_s
        )
        return self.anchor()

    def dress(self, seed: int, *, varied: bool, sizes: Sizes = USUAL) -> None:
        """Give a take the task's appearance or one of the seed, and its objects their sizes."""
        self._geometry.resize(sizes)
        look, scene = self.rig.own_appearance, self.simulation.scene
        if varied:
            draw = np.random.default_rng([seed, _LOOK])
            look = look.varied(draw, scene.geom_object, scene.table_geom)
        self.rig.appearance = look

    def anchor(self) -> AnchorPoses:
        """Measured poses of wrists and head camera now."""
        left, right = transform_from_pose(self.simulation.wrist_poses())
        return AnchorPoses(left, right, transform_from_pose(self.simulation.head_pose()))


def _displaced(
    poses: Float64[np.ndarray, "objects 7"], generator: np.random.Generator
) -> Float64[np.ndarray, "objects 7"]:
    moved = poses.copy()
    direction = generator.uniform(0.0, 2 * np.pi)
    if generator.random() < 0.5:
        moved[:, 1] += _SHELF_Y_M
    else:
        moved[:, :2] += _ASIDE_M * np.array([np.cos(direction), np.sin(direction)])
    return moved


def script_name(level_mm: float) -> str:
    """Name of the script whose object positions are wrong by this much."""
    return f"script {level_mm:g} mm"


def mistake_name(mistake: Mistake) -> str:
    """Name of the exact script with a mistake of one kind: `tilt 0.5`."""
    return f"{mistake.kind} {mistake.strength:g}"


def mistake_of(policy: str) -> Mistake | None:
    """The mistake that a policy is named by, None for other names; raises as `Mistake`."""
    match = _MISTAKE.fullmatch(policy)
    return None if match is None else Mistake(match[1], float(match[2]))


def scripted_actions(stage: Stage, seed: int, policy: str) -> Actions:
    """Open-loop commands of a policy, steps 1 … 80, relative to the start's poses.

    Raises UnknownNameError: no such policy; others as `Mistake`.
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
    at_rest = poses_from_actions(np.repeat(row[None], NUM_GRID_STEPS, axis=0), anchor)
    way = np.minimum(np.arange(NUM_GRID_STEPS) / _RETREAT_STEPS, 1.0)
    offset = transform(np.eye(3), (way * way * (3 - 2 * way))[:, None] * _RETREAT_M)
    left, right = offset @ at_rest.Ts_world_wrist_left, offset @ at_rest.Ts_world_wrist_right
    moved = replace(at_rest, Ts_world_wrist_left=left, Ts_world_wrist_right=right)
    return actions_from_poses(moved, anchor)
