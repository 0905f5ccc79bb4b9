"""Worlds of an evaluation, and the first observations of the real one from which rollouts start."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from dextouch.clients import RolloutClient
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ActionKind, Observation, WorldDescription
from dextouch.streams import HEAD_CAMERA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout, described
from services.evaluation.scores import REAL, RolloutFailure


@dataclass(frozen=True)
class WorldAddress:
    """Service of a world, and the world's name there."""

    client: RolloutClient
    world: str


@dataclass(frozen=True)
class StudyWorlds:
    """The real world, as `real`, and the imagined worlds by their names in the report."""

    addresses: Mapping[str, WorldAddress]
    descriptions: Mapping[str, WorldDescription]

    @classmethod
    def ask(cls, real: WorldAddress, imagined: Mapping[str, WorldAddress]) -> "StudyWorlds":
        """Request the description of every world from its service.

        Raises UnavailableError if one does not answer, UnknownNameError if it has no world of this
        name, and InvalidInputError if an imagined world has the name of the real one.
        """
        if REAL in imagined:
            raise InvalidInputError(
                f"imagined world {REAL!r}: this names the real world; choose another name"
            )
        addresses = {REAL: real, **imagined}
        described = {name: _description(address) for name, address in addresses.items()}
        return cls(addresses, described)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that all worlds have and policies can see."""
        first, *others = self.descriptions.values()
        return tuple(
            camera for camera in first.cameras if all(camera in one.cameras for one in others)
        )

    @property
    def digests(self) -> dict[str, str]:
        """Digest of every world, by name."""
        return {f"world {name}": one.digest for name, one in self.descriptions.items()}

    def check(self, tasks: Sequence[str], num_steps: int, image_size_px: int) -> None:
        """Reject incompatible worlds before the first rollout.

        Raises UnknownNameError for a task that a world does not have, and InvalidInputError for
        worlds that cannot report or start what is needed, or for images, touch or a length of
        rollouts that do not fit success classifiers or a world's chunk.
        """
        real = self.descriptions[REAL]
        if not real.knows_success or "task_seed" not in real.starts_from:
            raise InvalidInputError(
                f"real world {real.name!r}: does not report success or does not start from a "
                "task and seed; expected a world that does both, such as the twin"
            )
        if HEAD_CAMERA not in real.cameras:
            raise UnknownNameError("camera of the real world", HEAD_CAMERA, list(real.cameras))
        for name, world in self.descriptions.items():
            for task in tasks:
                if task not in world.tasks:
                    raise UnknownNameError(f"task of world {name!r}", task, list(world.tasks))
            if num_steps < 1 or num_steps % world.chunk_multiple:
                raise InvalidInputError(
                    f"num_steps: got {num_steps}, expected a multiple of {world.chunk_multiple}, "
                    f"the chunk of world {name!r}"
                )
            size = (world.image_height_px, world.image_width_px)
            if size != (image_size_px, image_size_px):
                raise InvalidInputError(
                    f"world {name!r}: got images of {size[0]}x{size[1]} px, expected "
                    f"{image_size_px}x{image_size_px} px as the success classifier was trained on"
                )
            if name != REAL:
                _check_imagined(name, world, real)
        check_judged_touch(self.descriptions)


def check_judged_touch(worlds: Mapping[str, WorldDescription]) -> None:
    """Refuse worlds, by name, whose touch success classifiers cannot judge.

    Raises InvalidInputError if the glove of a world is another one than `dextouch_v1`.
    """
    found = {
        name: TactileLayout.of(one.tactile_layout) or DEXTOUCH_V1 for name, one in worlds.items()
    }
    if any(layout.fingerprint != DEXTOUCH_V1.fingerprint for layout in found.values()):
        gloves = "; ".join(f"world {name!r} {described([one])}" for name, one in found.items())
        raise InvalidInputError(
            f"tactile layouts: got {gloves}; expected {DEXTOUCH_V1.name!r} of every world, the "
            "only one that success classifiers support"
        )


def _check_imagined(name: str, world: WorldDescription, real: WorldDescription) -> None:
    if "observation" not in world.starts_from:
        raise InvalidInputError(
            f"imagined world {name!r}: starts from {', '.join(world.starts_from)}; expected one "
            "that starts from an observation of the real world"
        )
    missing = [camera for camera in world.cameras if camera not in real.cameras]
    if missing or HEAD_CAMERA not in world.cameras:
        raise InvalidInputError(
            f"imagined world {name!r}: got cameras {', '.join(world.cameras)}, expected "
            f"{HEAD_CAMERA} and only cameras of the real world ({', '.join(real.cameras)}), which "
            "provides its first images"
        )
    if world.model_rate_hz != real.model_rate_hz:
        raise InvalidInputError(
            f"imagined world {name!r}: got steps at {world.model_rate_hz:g} Hz, expected "
            f"{real.model_rate_hz:g} Hz as in the real world"
        )


def _description(address: WorldAddress) -> WorldDescription:
    described = {world.name: world for world in address.client.worlds()}
    if address.world not in described:
        raise UnknownNameError("world", address.world, list(described))
    return described[address.world]


def start_digest(head_image: np.ndarray, tactile_kpa: np.ndarray) -> str:
    """SHA-256 of a first observation: head camera image [h, w, 3] and taxels [2, 320] in kPa.

    The same task and seed give the same first observation, so equal digests mean the same start.
    """
    image = np.ascontiguousarray(head_image, dtype=np.uint8)
    tactile = np.ascontiguousarray(tactile_kpa, dtype="<f4")
    digest = hashlib.sha256(repr((image.shape, tactile.shape)).encode())
    digest.update(image.tobytes())
    digest.update(tactile.tobytes())
    return digest.hexdigest()


def refuse_training_starts(
    marks: Iterable[str],
    *,
    trained_on: Iterable[str],
    what: str,
    noun: Literal["starts", "scenes"] = "starts",
) -> None:
    """Refuse an evaluation on starts, or scenes, that a network was trained on.

    Raises ConflictError if there are any; `marks` and `trained_on` are digests of starts or names
    of scenes, `what` is the network.
    """
    shared = sorted(set(marks) & set(trained_on))
    if shared:
        first = shared[0] if noun == "scenes" else f"{shared[0][:12]}…"
        raise ConflictError(
            f"evaluation: {len(shared)} {noun} were trained on by {what}, first {first}; choose "
            "others, outside its training data",
            **{noun: shared},
        )


@dataclass(frozen=True)
class MatchedStart:
    """A first observation of the real world from which every rollout starts.

    `action_kind` is that of the actions that imagined worlds are sent.
    """

    task: str
    seed: int
    instruction: str
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    action_kind: ActionKind = "commanded"

    @property
    def digest(self) -> str:
        """Digest of image and touch."""
        return first_digest(self.observation)


@dataclass(frozen=True)
class FailedStart:
    """A task and seed that the real world failed to start."""

    task: str
    seed: int
    error: DexTouchError


def first_digest(observation: Observation) -> str:
    """Digest of the head camera's image and the touch of a first observation."""
    return start_digest(observation.images[HEAD_CAMERA][0], observation.tactile_kpa[0])


def matched_start(
    real: WorldAddress, task: str, seed: int, instruction: str
) -> MatchedStart | FailedStart:
    """First observation of the real world, with all its cameras, or why the world refused it."""
    try:
        with real.client.start(
            world=real.world, task=task, seed=seed, instruction=instruction
        ) as rollout:
            return MatchedStart(
                task, seed, instruction, rollout.observation, rollout.anchor, rollout.K_head
            )
    except DexTouchError as error:
        return FailedStart(task, seed, error)


def rollout_failure(
    error: DexTouchError,
    start: MatchedStart | FailedStart,
    policy: str,
    world: str,
    repeat: int = 0,
) -> RolloutFailure:
    """A failed rollout with its reason."""
    trace = error.details.get("traceback")
    return RolloutFailure(
        world=world,
        policy=policy,
        task=start.task,
        seed=start.seed,
        error=type(error).__name__,
        message=_printable(error.message),
        traceback=_printable(trace) if isinstance(trace, str) else None,
        repeat=repeat,
    )


def _printable(text: str) -> str:
    """Text of a policy's error without lone surrogates, which JSON readers refuse."""
    return text.encode("utf-8", "replace").decode()
