"""The twin as a `World`, and its service: rollouts of commanded actions in the simulation."""

import hashlib
import json
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses, actions_from_poses, poses_from_actions
from dextouch.schemas import (
    EVERYTHING,
    MILESTONE_PREFIX,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
)
from dextouch.serving import load_settings
from dextouch.streams import pack, unpack
from dextouch.worlds import CopyFirstWorld, StartedRollout, SteppedRollout, World, serve_worlds
from services.twin.episodes import GridLog
from services.twin.names import CAMERAS
from services.twin.scene import Sizes
from services.twin.settings import TwinServiceSettings, TwinSettings
from services.twin.simulation import MODEL_RATE_HZ, STEPS_PER_GRID, STEPS_PER_TACTILE
from services.twin.stage import Stage, command_row
from services.twin.tasks import TASK_NAMES, get_task

MAX_SNAPSHOT_BYTES: Final = 1 << 20  # chosen: refuses what is no state


@dataclass(frozen=True)
class TwinState:
    """State of a rollout: task, grid step and physics state."""

    task: str
    seed: int
    step: int
    physics: Float64[np.ndarray, " numbers"]
    anchor: AnchorPoses


class TwinWorld:
    """Reference world of the platform, in place of a real robot.

    A rollout starts at the first observation of the demonstration of a task and seed; replaying its
    `action_commanded` reproduces it exactly. Measured actions are treated as commands. The physics
    has
    no noise, so the seed of a step has no effect. Raises UnknownNameError for an unknown camera.
    """

    def __init__(self, settings: TwinSettings) -> None:
        for camera in settings.cameras:
            if camera not in CAMERAS:
                raise UnknownNameError("camera", camera, list(CAMERAS))
        self._settings = settings
        self._sizes = Sizes(settings.object_width, settings.object_height)
        self._stages: dict[str, Stage] = {}
        self._description = self._describe()

    def stage(self, task: str) -> Stage:
        """Stage of a task with robot hands, shared by all rollouts (in the last call's state)."""
        if task not in self._stages:
            stage = Stage(task, "robot", self._settings)
            stage.dress(0, varied=False, sizes=self._sizes)
            self._stages[get_task(task).name] = stage
        return self._stages[task]

    def _describe(self) -> WorldDescription:
        scenes = [self.stage(task).simulation.scene.xml for task in TASK_NAMES]
        facts = [version("mujoco-core"), self._settings.model_dump(mode="json"), scenes]
        return WorldDescription(
            name="twin",
            kind="twin",
            digest=hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest(),
            tasks=TASK_NAMES,
            cameras=self._settings.cameras,
            image_height_px=self._settings.image_height_px,
            image_width_px=self._settings.image_width_px,
            model_rate_hz=MODEL_RATE_HZ,
            action_kinds=("measured", "commanded"),
            starts_from=("task_seed",),
            knows_success=True,
        )

    @property
    def description(self) -> WorldDescription:
        """See `World`."""
        return self._description

    def reset(self, start: RolloutStart) -> StartedRollout[TwinState]:
        """See `World`; the seed determines the poses of hands and objects."""
        if start.observation is not None:
            raise InvalidInputError(
                "world twin: got a start with an observation, expected only a task and seed"
            )
        stage = self.stage(start.task)
        anchor = stage.start(stage.plan(start.seed, sizes=self._sizes))
        log = _StepLog(stage, self._settings.cameras)
        log.step()
        log.draw()
        state = TwinState(start.task, start.seed, 0, stage.simulation.state(), anchor)
        return StartedRollout(
            state, log.observation(0, anchor), anchor, stage.rig.K["camera_head"].copy()
        )

    def step(
        self,
        state: TwinState,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[TwinState]:
        """See `World`; hands and head follow the actions. Reports milestones reached."""
        del seed
        commands = poses_from_actions(actions, state.anchor, where="world twin: actions")
        stage = self.stage(state.task)
        stage.simulation.set_state(state.physics, step_index=state.step * STEPS_PER_GRID)
        log = _StepLog(stage, tuple(filter(selector.wants, self._settings.cameras)))
        reached = dict.fromkeys(stage.task.milestones, 0.0)
        for row in range(len(actions)):
            for step_index in stage.simulation.advance(command_row(commands, row)):
                if step_index % STEPS_PER_TACTILE == 0:
                    log.touch()
            log.step()
            held = zip(reached, stage.task.reached(stage.simulation), strict=True)
            reached.update((name, 1.0) for name, holds in held if holds)
            if selector.steps == "all" or row == len(actions) - 1:
                log.draw()
        physics = stage.simulation.state()
        after = replace(state, step=state.step + len(actions), physics=physics)
        seen = log.observation(state.step + 1, state.anchor, steps=selector.steps)
        info = {MILESTONE_PREFIX + name: value for name, value in reached.items()}
        return SteppedRollout(after, seen, info)

    def snapshot(self, state: TwinState) -> bytes:
        """See `World`."""
        fields = {
            "world": self._description.digest,
            "task": state.task,
            "seed": state.seed,
            "step": state.step,
        }
        return pack(fields, {"physics": state.physics, "anchor": np.stack(state.anchor.as_tuple())})

    def restore(self, data: bytes) -> TwinState:
        """See `World`."""
        fields, arrays = unpack(data, max_bytes=MAX_SNAPSHOT_BYTES)
        if set(fields) != {"world", "task", "seed", "step"} or set(arrays) != {"physics", "anchor"}:
            raise InvalidInputError(
                f"world twin: got a snapshot with {sorted(fields)} and {sorted(arrays)}, "
                "expected a snapshot made by this world"
            )
        if fields["world"] != self._description.digest:
            raise InvalidInputError(
                f"world twin: got a snapshot of world {fields['world']!r}, expected "
                f"{self._description.digest!r}; restore it with the version that made it"
            )
        task, seed, step = fields["task"], fields["seed"], fields["step"]
        if not (isinstance(task, str) and isinstance(seed, int) and isinstance(step, int)):
            raise InvalidInputError("world twin: the snapshot's task, seed or step is damaged")
        physics, anchor = arrays["physics"], arrays["anchor"]
        size = self.stage(task).simulation.state_size
        if physics.shape != (size,) or anchor.shape != (3, 4, 4) or step < 0:
            raise InvalidInputError(
                f"world twin: got a snapshot of shapes {physics.shape} and {anchor.shape} at step "
                f"{step}, expected ({size},), (3, 4, 4) and a step ≥ 0"
            )
        return TwinState(
            task,
            seed,
            step,
            np.array(physics, dtype=np.float64),
            AnchorPoses(*np.array(anchor, dtype=np.float64)),
        )


class _StepLog:
    def __init__(self, stage: Stage, cameras: tuple[str, ...]) -> None:
        self._stage = stage
        self._grid = GridLog(stage)
        self._images: dict[str, list[np.ndarray]] = {camera: [] for camera in cameras}
        self._tactile: list[np.ndarray] = []
        self._since_step: list[np.ndarray] = []

    def touch(self) -> None:
        self._since_step.append(self._stage.simulation.tactile_kpa)

    def step(self) -> None:
        """Complete a grid step, whose tactile reading is the mean since the last one."""
        if not self._since_step:
            self.touch()
        mean = np.stack(self._since_step).mean(axis=0, dtype=np.float64)
        self._tactile.append(mean.astype(np.float32))
        self._since_step = []
        self._grid.sample()

    def draw(self) -> None:
        for camera, images in self._images.items():
            images.append(self._stage.rig.image(self._stage.simulation, camera))

    def observation(
        self, first_step: int, anchor: AnchorPoses, *, steps: Literal["all", "last"] = "all"
    ) -> Observation:
        """Observation of all completed steps or the last one; success is judged at the last one."""
        first = 0 if steps == "all" else len(self._tactile) - 1
        reached = actions_from_poses(self._grid.trajectory(), anchor)
        return Observation(
            first_step=first_step + first,
            images={camera: np.stack(images) for camera, images in self._images.items()},
            tactile_kpa=np.stack(self._tactile[first:]),
            action_reached=reached[first:],
            reached_is_measured=True,
            success=self._stage.task.succeeded(self._stage.simulation),
        )


def twin_worlds(scene: TwinSettings) -> dict[str, World[Any]]:
    """The twin, and the baseline that every imagined world must beat."""
    twin = TwinWorld(scene)
    baseline = CopyFirstWorld.beside(twin.description)
    return {"twin": twin, baseline.description.name: baseline}


def serve(arguments: list[str]) -> None:
    """Serve both over HTTP until SIGINT or SIGTERM; raises InvalidInputError for bad settings."""
    load = partial(load_settings, TwinServiceSettings, arguments)
    settings = load()
    serve_worlds(partial(twin_worlds, settings.scene), settings, name="twin", load=load)
