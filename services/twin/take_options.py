"""How a take of the twin is made and what of it is recorded, apart from task, domain and seed."""

import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, check_actions
from services.twin.cameras import CAMERAS
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.hands import Domain
from services.twin.motions import Motion

StreamChoice = Literal["all", "training"]
STREAM_CHOICES: Final[tuple[StreamChoice, ...]] = get_args(StreamChoice)


@dataclass(frozen=True)
class TakeOptions:
    """How a demonstration is made, and what is recorded of it.

    `noise_m` is the demonstrator's error (0 … 0.2 m), `miss` moves or removes the objects while
    the motion stays, `images` are the cameras to record. At most one of three changes what is
    commanded: from `frozen_from_step` (0 … 80) on nothing moves (0 holds still from the start),
    `motion` leaves the script, and `actions_of_seed` plays what the demonstrator of another seed
    of the task does, relative to this take's start.

    Cameras run at 30 Hz, or show the grid steps that are multiples of `image_every` and the last
    three. The streams for `training` are touch, images, actions, and object poses at grid steps.
    """

    noise_m: float = 0.0
    miss: bool = False
    images: tuple[str, ...] = CAMERAS
    frozen_from_step: int | None = None
    motion: Motion | None = None
    actions_of_seed: int | None = None
    image_every: int | None = None
    streams: StreamChoice = "all"

    def __post_init__(self) -> None:
        frozen = self.frozen_from_step
        if frozen is not None and not 0 <= frozen < NUM_GRID_STEPS:
            raise InvalidInputError(
                f"twin: got commands frozen from step {frozen}, expected a step "
                f"0 … {NUM_GRID_STEPS - 1}"
            )
        changes = (frozen, self.motion, self.actions_of_seed)
        if sum(change is not None for change in changes) > 1:
            raise InvalidInputError(
                f"twin: got frozen_from_step {frozen}, motion {self.motion} and actions_of_seed "
                f"{self.actions_of_seed}, expected at most one of them"
            )
        every = self.image_every
        if every is not None and not 1 <= every < NUM_GRID_STEPS:
            raise InvalidInputError(
                f"twin: got images every {every} steps, expected 1 … {NUM_GRID_STEPS - 1}"
            )
        for camera in self.images:
            if camera not in CAMERAS:
                raise UnknownNameError("camera", camera, list(CAMERAS))

    def words(self) -> list[str]:
        """Flags of `dextouch twin record` that say the same."""
        words = ["--noise", repr(self.noise_m), "--miss-fraction", repr(float(self.miss))]
        if self.images != CAMERAS:
            words += ["--cameras", *self.images]
        if self.frozen_from_step is not None:
            words += ["--freeze-from", str(self.frozen_from_step)]
        if self.motion is not None:
            words += ["--motion", self.motion.kind, "--motion-from", str(self.motion.from_step)]
        if self.actions_of_seed is not None:
            words += ["--actions-of", str(self.actions_of_seed)]
        if self.image_every is not None:
            words += ["--image-every", str(self.image_every)]
        if self.streams != "all":
            words += ["--streams", self.streams]
        return words

    def figures(self) -> dict[str, float]:
        """What an episode's `quality` says about how it was made."""
        figures = {"noise_m": self.noise_m, "miss": float(self.miss)}
        if self.frozen_from_step is not None:
            figures["frozen_from_step"] = float(self.frozen_from_step)
        if self.motion is not None:
            figures[f"{self.motion.kind}_from_step"] = float(self.motion.from_step)
        if self.actions_of_seed is not None:
            figures["actions_of_seed"] = float(self.actions_of_seed)
        return figures


@dataclass(frozen=True)
class PlayedActions:
    """Commands of a take that come from elsewhere, such as a policy.

    `actions` are relative to the take's start, row 0 being its pose; `name` becomes a part of the
    episode's id, and `command` says how the episode is made again.
    """

    name: str
    actions: Float64[np.ndarray, "steps 67"]
    command: str

    def __post_init__(self) -> None:
        if re.fullmatch(r"[a-z0-9_]{1,48}", self.name) is None:
            raise InvalidInputError(
                f"twin: got played actions named {self.name!r}, expected 1 … 48 of a-z, 0-9 and _"
            )
        checked = check_actions(self.actions, where="twin: played actions")
        if len(checked) != NUM_GRID_STEPS:
            raise ShapeError(
                f"twin: got {len(checked)} played actions, expected {NUM_GRID_STEPS} rows of "
                f"{ACTION_DIM}"
            )


def episode_id(
    task: str, domain: Domain, seed: int, options: TakeOptions, *, played: str | None = None
) -> str:
    """A name that tells what is in the episode and differs for every way to make one.

    Args:
        task: name of the task.
        domain: whose hands.
        seed: of the scene.
        options: how the take is made.
        played: name of the `PlayedActions`, if there are any.
    """
    parts = ["twin", task, domain, f"{seed:06d}"]
    if options.noise_m > 0:
        parts.append(f"n{round(options.noise_m * 1e6)}um")
    if options.miss:
        parts.append("miss")
    if options.frozen_from_step is not None:
        parts.append(f"f{options.frozen_from_step}")
    if options.motion is not None:
        parts.append(f"{options.motion.kind}{options.motion.from_step}")
    if options.actions_of_seed is not None:
        parts.append(f"of{options.actions_of_seed:06d}")
    if played is not None:
        parts.append(f"by_{played}")
    if options.image_every is not None:
        parts.append(f"i{options.image_every}")
    if options.streams != "all":
        parts.append(options.streams)
    return "-".join(parts)
