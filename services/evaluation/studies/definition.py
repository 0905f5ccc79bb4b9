"""Definition of a study: the content of study.toml."""

import hashlib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError, model_validator

from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems
from services.evaluation.bundled_policies import BUNDLED, BundledName, checkpoint_of
from services.evaluation.scores import REAL

NAME_PATTERN: Final = r"^[A-Za-z0-9][A-Za-z0-9 ._+-]{0,63}$"
MAX_ROLLOUTS: Final = 100_000
# Starts are kept in memory, with one image per camera.
MAX_STARTS: Final = 2_000
Name = Annotated[str, Field(pattern=NAME_PATTERN)]


def _expect_one(choice: FrozenModel, *names: str) -> None:
    given = [name for name in names if getattr(choice, name)]
    if len(given) != 1:
        expected = f"{', '.join(names[:-1])} and {names[-1]}"
        raise ValueError(f"got {', '.join(given) or 'none'}, expected exactly one of {expected}")


class WorldChoice(FrozenModel):
    """A world: one served at a URL, or one that the study serves while it runs.

    Exactly one of `url` (with `world`, its name at the service), `checkpoint` (a world model's
    file) and `builtin` is given. The API key is read from the environment variable
    `api_key_variable`, so that no study file holds a secret. `probe` is the success classifier that
    was calibrated for this imagined world; by default the study's.
    """

    url: str | None = None
    world: str | None = None
    api_key_variable: str | None = None
    checkpoint: Path | None = None
    builtin: Literal["twin", "world-model"] | None = None
    probe: Path | None = None

    @model_validator(mode="after")
    def _is_one(self) -> "WorldChoice":
        _expect_one(self, "url", "checkpoint", "builtin")
        if (self.url is None) == (self.world is not None):
            raise ValueError("`world` names a world of the service at `url`; give both or neither")
        return self


class PolicyChoice(FrozenModel):
    """A policy, in exactly one of four ways.

    `factory` is MODULE:FACTORY with `arguments`; `builtin` a bundled policy; `replay` an episode
    store whose commanded actions are sent; `script` one of the twin's own demonstrators: `script 10
    mm` has object positions wrong by 10 mm, `retreat` and `another scene's actions` should fail.
    """

    factory: str | None = None
    arguments: dict[str, Any] = Field(default={})
    builtin: BundledName | None = None
    checkpoint: Path | None = None
    replay: str | None = None
    script: str | None = None

    @model_validator(mode="after")
    def _is_one(self) -> "PolicyChoice":
        _expect_one(self, "factory", "builtin", "replay", "script")
        if self.arguments and not self.factory:
            raise ValueError("`arguments` belong to `factory`")
        if self.checkpoint and (self.builtin is None or checkpoint_of(self.builtin) is None):
            having = [name for name in BUNDLED if checkpoint_of(name) is not None]
            raise ValueError(f"`checkpoint` belongs to builtin = {' or '.join(having)}")
        return self


class StudyDefinition(FrozenModel):
    """What a study compares.

    Every policy is rolled out from every start (task and seed) in the real world once and in every
    imagined world `repeats` times, `in_flight` rollouts of each world at a time.
    """

    name: Name
    tasks: tuple[str, ...] = Field(min_length=1, max_length=100)
    first_seed: int = Field(ge=0, lt=2**40)
    num_starts: int = Field(ge=1, le=10_000)
    num_steps: int = Field(default=80, ge=4, le=10_000)
    repeats: int = Field(default=1, ge=1, le=100)
    in_flight: int = Field(default=4, ge=1, le=64)
    keep_rollouts: bool = True
    probe: Path | None = None
    real: WorldChoice = WorldChoice(builtin="twin")
    imagined: dict[Name, WorldChoice] = Field(default={}, max_length=20)
    policies: dict[Name, PolicyChoice] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _is_possible(self) -> "StudyDefinition":
        if len(set(self.tasks)) != len(self.tasks):
            raise ValueError(f"tasks: got {', '.join(self.tasks)}, expected no task twice")
        if REAL in self.imagined:
            raise ValueError(f"imagined: {REAL!r} names the real world; choose another name")
        if self.real.probe is not None:
            raise ValueError("real.probe: the success classifier of the real world is `probe`")
        if len(self.tasks) * self.num_starts > MAX_STARTS:
            raise ValueError(
                f"got {len(self.tasks) * self.num_starts} starts, expected at most {MAX_STARTS}"
            )
        if self.num_rollouts > MAX_ROLLOUTS:
            raise ValueError(f"got {self.num_rollouts} rollouts, expected at most {MAX_ROLLOUTS}")
        return self

    @property
    def seeds(self) -> range:
        """Seeds of the starts of every task."""
        return range(self.first_seed, self.first_seed + self.num_starts)

    @property
    def num_rollouts(self) -> int:
        """Number of rollouts in all worlds."""
        starts = len(self.tasks) * self.num_starts
        return starts * len(self.policies) * (1 + self.repeats * len(self.imagined))

    @property
    def digest(self) -> str:
        """SHA-256 of everything that can change a result, if only by rounding."""
        # Policies without images get their last chunk in two parts unless rollouts are kept.
        text = self.model_dump_json(exclude={"name"})
        return hashlib.sha256(text.encode()).hexdigest()


def read_definition(path: Path) -> StudyDefinition:
    """Read a study file.

    Raises:
        InvalidInputError: it cannot be read, or does not define a study; all problems are listed.
    """
    try:
        fields = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"study {path}: cannot be read ({error})") from error
    try:
        return StudyDefinition.model_validate(fields)
    except ValidationError as error:
        raise InvalidInputError(f"study {path}: {first_problems(error)}") from error
