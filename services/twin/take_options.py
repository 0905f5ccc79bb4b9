"""Options of a take: demonstrator error, commanded motion, and recorded streams."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.hands.actions import ACTION_DIM, check_actions
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.mistakes import Mistake
from services.twin.motions import Motion
from services.twin.names import CAMERAS, Domain, StreamChoice
from services.twin.sizes import USUAL, Sizes


@dataclass(frozen=True)
class TakeOptions:
    """Options of a demonstration and its recording.

    `noise_m` is the demonstrator's error (0 … 0.2 m), `miss` moves or removes the objects while the
    motion stays, `images` are the cameras to record. At most one of three modifies the commands:
    `frozen_from_step` (0 … 80) freezes them from that step on (0: from the start), `motion`
    replaces the script, and `actions_of_seed` plays the demonstration of another seed, relative to
    this take's start. `mistakes` change the commands of the script, in their order.

    With `varied`, colours, light and the home of the head camera differ from take to take; `sizes`
    are those of the objects, unknown to the demonstrator. Cameras record at 30 Hz, or at grid steps
    that are multiples of `image_every` and the last three. With `training`, only touch, images,
    actions, and object poses at grid steps are recorded.
    """

    noise_m: float = 0.0
    miss: bool = False
    images: tuple[str, ...] = CAMERAS
    frozen_from_step: int | None = None
    motion: Motion | None = None
    actions_of_seed: int | None = None
    image_every: int | None = None
    streams: StreamChoice = "all"
    mistakes: tuple[Mistake, ...] = ()
    varied: bool = False
    sizes: Sizes = USUAL

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
        if self.mistakes and any(change is not None for change in changes):
            raise InvalidInputError(
                f"twin: got mistakes {', '.join(map(str, self.mistakes))} of a script that is "
                f"replaced ({changes}), expected one or the other"
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
        """Equivalent flags of `dextouch twin record`."""
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
        for mistake in self.mistakes:
            words += ["--mistake", str(mistake)]
        if self.varied:
            words.append("--varied")
        if self.sizes != USUAL:
            words += ["--width", repr(self.sizes.width), "--height", repr(self.sizes.height)]
        return words

    def figures(self) -> dict[str, float]:
        """Entries of an episode's `quality` about its options."""
        figures = {"noise_m": self.noise_m, "miss": float(self.miss)}
        if self.frozen_from_step is not None:
            figures["frozen_from_step"] = float(self.frozen_from_step)
        if self.motion is not None:
            figures[f"{self.motion.kind}_from_step"] = float(self.motion.from_step)
        if self.actions_of_seed is not None:
            figures["actions_of_seed"] = float(self.actions_of_seed)
        figures |= {f"mistake_{one.kind}": one.strength for one in self.mistakes}
        if self.sizes != USUAL:
            figures |= {"width": self.sizes.width, "height": self.sizes.height}
        return figures


@dataclass(frozen=True)
class PlayedActions:
    """Commands of a take from another source, such as a policy.

    `actions` are relative to the take's start, row 0 being its pose; `name` becomes part of the
    episode's id, and `command` is the command that reproduces the episode.
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
    """Descriptive id of an episode, unique for each combination of options.

    Args:
        task: name of the task.
        domain: robot or human hands.
        seed: seed of the scene.
        options: options of the take.
        played: name of the `PlayedActions`, if there are any.
    """
    parts = ["twin", task, domain, f"{seed:06d}"]
    parts += [f"n{round(options.noise_m * 1e6)}um"] * (options.noise_m > 0)
    parts += ["miss"] * options.miss
    if options.frozen_from_step is not None:
        parts.append(f"f{options.frozen_from_step}")
    if options.motion is not None:
        parts.append(f"{options.motion.kind}{options.motion.from_step}")
    if options.actions_of_seed is not None:
        parts.append(f"of{options.actions_of_seed:06d}")
    parts += [f"{one.kind}{round(1000 * one.strength)}" for one in options.mistakes]
    parts += ["varied"] * options.varied
    parts += options.sizes.labels
    if played is not None:
        parts.append(f"by_{played}")
    if options.image_every is not None:
        parts.append(f"i{options.image_every}")
    if options.streams != "all":
        parts.append(options.streams)
    return "-".join(parts)
