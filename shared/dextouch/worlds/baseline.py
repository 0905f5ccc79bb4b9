"""Baseline world that repeats the first image and touch; every world model must beat it."""

import hashlib
from dataclasses import replace

import numpy as np

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import check_actions
from dextouch.schemas import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
    decode_observation,
    encode_observation,
)
from dextouch.tactile import LayoutDescription
from dextouch.worlds.world import StartedRollout, SteppedRollout

MAX_SNAPSHOT_BYTES = 2**28  # images of three cameras of any size
MAX_QUICK_BYTES = 2**20  # copied in well below a millisecond


class CopyFirstWorld:
    """Starts from an observation and repeats it; commanded actions count as reached.

    Its state is the last observation, of one step.
    """

    def __init__(
        self,
        *,
        tasks: tuple[str, ...],
        cameras: tuple[str, ...] = ("camera_head",),
        image_height_px: int = 64,
        image_width_px: int = 64,
        model_rate_hz: float = 15.0,
        tactile_layout: LayoutDescription | None = None,
    ) -> None:
        shape: tuple[object, ...] = (tasks, cameras, image_height_px, image_width_px, model_rate_hz)
        if tactile_layout is not None:
            shape += (tactile_layout.fingerprint,)
        self._description = WorldDescription(
            name="copy-first",
            kind="baseline",
            digest=hashlib.sha256(f"copy-first/1 {shape}".encode()).hexdigest(),
            tasks=tasks,
            cameras=cameras,
            image_height_px=image_height_px,
            image_width_px=image_width_px,
            model_rate_hz=model_rate_hz,
            action_kinds=("measured", "commanded"),
            starts_from=("observation",),
            tactile_layout=tactile_layout,
        )

    @staticmethod
    def beside(other: WorldDescription) -> "CopyFirstWorld":
        """Create the baseline for the tasks, cameras and gloves of another world."""
        return CopyFirstWorld(
            tasks=other.tasks,
            cameras=other.cameras,
            image_height_px=other.image_height_px,
            image_width_px=other.image_width_px,
            model_rate_hz=other.model_rate_hz,
            tactile_layout=other.tactile_layout,
        )

    @property
    def description(self) -> WorldDescription:
        """See World."""
        return self._description

    @property
    def is_quick(self) -> bool:
        """See World; a longest chunk of small images is copied in a tenth of a millisecond."""
        shape = self.description
        num_px = len(shape.cameras) * shape.image_height_px * shape.image_width_px
        return shape.max_chunk_steps * num_px * 3 <= MAX_QUICK_BYTES

    def reset(self, start: RolloutStart) -> StartedRollout[Observation]:
        """See World; the observation is the start's own."""
        if start.observation is None or start.anchor is None or start.K_head is None:
            raise InvalidInputError(
                "world copy-first: got a start without observation, anchor and K_head; it begins "
                "only from an observation made in another world or episode"
            )
        state = replace(
            start.observation.last(),
            first_step=0,
            reached_is_measured=False,
            success=None,
            uncertainty=None,
        )
        return StartedRollout(state, state, start.anchor, start.K_head)

    def step(
        self,
        state: Observation,
        actions: np.ndarray,
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[Observation]:
        """See World; there is no noise, so `seed` changes nothing."""
        del seed
        poses = state.object_poses
        reached = np.array(check_actions(actions, where="world copy-first: actions"))
        seen = replace(
            state,
            first_step=state.first_step + 1,
            images={
                camera: np.repeat(images, len(reached), axis=0)
                for camera, images in state.images.items()
            },
            tactile_kpa=np.repeat(state.tactile_kpa, len(reached), axis=0),
            action_reached=reached,
            object_poses=poses if poses is None else np.repeat(poses, len(reached), axis=0),
        )
        return SteppedRollout(seen.last(), seen.selected(selector))

    def snapshot(self, state: Observation) -> bytes:
        """See World."""
        return encode_observation(state)

    def restore(self, data: bytes) -> Observation:
        """See World."""
        return decode_observation(data, max_bytes=MAX_SNAPSHOT_BYTES)
