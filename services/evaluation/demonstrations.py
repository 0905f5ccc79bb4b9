"""Robot episodes of stores as arrays on the model grid."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import InvalidInputError
from services.evaluation.robot_episodes import robot_episodes
from services.evaluation.starts import start_digest

CAMERA = "camera_head"


@dataclass(frozen=True)
class Demonstration:
    """Images, touch, measured and commanded actions of one robot episode at every step.

    Both actions are relative to the measured poses of step 0.
    """

    episode_id: str
    task: str
    instruction: str
    seed: int
    success: bool
    images: UInt8[np.ndarray, "steps h w 3"]
    tactile_kpa: Float32[np.ndarray, "steps 2 320"]
    measured: Float64[np.ndarray, "steps 67"]
    commanded: Float64[np.ndarray, "steps 67"]

    @property
    def num_steps(self) -> int:
        """Steps of the model grid, including the first one."""
        return len(self.measured)

    @property
    def start_digest(self) -> str:
        """Digest of the first observation."""
        return start_digest(self.images[0], self.tactile_kpa[0])


def read_demonstration(reader: EpisodeReader) -> Demonstration:
    """Read one robot episode with a known outcome.

    Raises:
        InvalidInputError: the episode has no outcome, no seed, or not an image for every
            step.
    """
    attributes = reader.attributes
    if attributes.success is None or attributes.seed is None:
        raise InvalidInputError(
            f"episode {attributes.episode_id!r}: success {attributes.success}, seed "
            f"{attributes.seed}; expected both known, as in episodes of the twin"
        )
    reader.require_images(CAMERA)
    measured = reader.window(0, num_steps=reader.num_steps, cameras=(CAMERA,))
    return Demonstration(
        attributes.episode_id,
        attributes.task,
        attributes.instruction,
        attributes.seed,
        attributes.success,
        measured.images[CAMERA],
        measured.tactile_kpa,
        measured.actions,
        reader.read("action_commanded").values,
    )


def read_demonstrations(*stores: EpisodeStore, tasks: Sequence[str] = ()) -> list[Demonstration]:
    """Read all robot episodes of some stores, store by store in the order of their ids.

    Args:
        stores: stores to read.
        tasks: tasks to read; empty for all.

    Raises:
        NotFoundError: no such episode, or an empty store.
        ConflictError: two stores hold an episode of the same id.
    """
    return [read_demonstration(reader) for reader in robot_episodes(stores, tasks=tasks)]


@runtime_checkable
class Seeded(Protocol):
    """Anything with a task and a seed of the twin."""

    @property
    def task(self) -> str:
        """Name of the task."""

    @property
    def instruction(self) -> str:
        """Instruction of the task."""

    @property
    def seed(self) -> int:
        """Seed of the scene."""


SeededT = TypeVar("SeededT", bound=Seeded)


def split_by_seed(
    demonstrations: Sequence[SeededT], *, held_out_share: float, salt: str = ""
) -> tuple[list[SeededT], list[SeededT]]:
    """Training and held-out episodes; all episodes of a task and seed are on the same side.

    The side depends on a hash of task, seed and `salt` alone, so that adding episodes does not
    change it.
    """
    training: list[SeededT] = []
    held_out: list[SeededT] = []
    for item in demonstrations:
        digest = hashlib.sha256(f"{salt}{item.task}/{item.seed}".encode()).digest()
        share = int.from_bytes(digest[:4], "big") / 2**32
        (held_out if share < held_out_share else training).append(item)
    if not training or not held_out:
        raise InvalidInputError(
            f"split: {len(training)} training and {len(held_out)} held-out episodes of "
            f"{len(demonstrations)}; expected both sides, record more seeds"
        )
    return training, held_out


def instructions_of(demonstrations: Iterable[Seeded]) -> dict[str, str]:
    """Instruction of every task, from its first episode."""
    found: dict[str, str] = {}
    for item in demonstrations:
        found.setdefault(item.task, item.instruction)
    return found
