"""Flags in; frozen settings of training and of an evaluation run out."""

import re
import shlex
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, CliApp

from dextouch.errors import InvalidInputError
from dextouch.schemas.problems import first_problems
from dextouch.serving.settings import service_config
from services.evaluation.policies.cloning_training import CloningSettings
from services.evaluation.success_probe_training import ProbeSettings

PRETRAINED = Path(__file__).parent / "pretrained"
DEFAULT_POLICY = PRETRAINED / "behaviour_cloning.safetensors"
DEFAULT_PROBE = PRETRAINED / "success_probe.safetensors"
_SEEDS = re.compile(r"(\d+):(\d+)")
SettingsT = TypeVar("SettingsT", bound=BaseSettings)


class TrainPolicySettings(BaseSettings):
    """Imitate the robot episodes of some stores."""

    model_config = service_config("evaluation_train_policy")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    output: Path = Path("runs/evaluation/behaviour_cloning.safetensors")
    tasks: tuple[str, ...] = ()
    training: CloningSettings = CloningSettings()
    json_path: Path | None = Field(default=None, alias="json", description="write figures here")


class TrainProbeSettings(BaseSettings):
    """Learn to tell success on the robot episodes of some stores."""

    model_config = service_config("evaluation_train_probe")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    output: Path = Path("runs/evaluation/success_probe.safetensors")
    tasks: tuple[str, ...] = ()
    training: ProbeSettings = ProbeSettings()
    json_path: Path | None = Field(default=None, alias="json", description="write figures here")


class ServedWorld(BaseModel):
    """A world behind a URL."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    url: str
    world: str
    api_key: str | None = None


class RunSettings(BaseSettings):
    """Roll policies out in a real and in imagined worlds.

    `scripts` maps a policy name to a store whose robot episodes it replays; the cloned policy and
    the policy that holds still are always there.
    """

    model_config = service_config("evaluation_run")

    real: ServedWorld
    imagined: dict[str, ServedWorld] = Field(min_length=1)
    seeds: str = Field(description="FIRST:LAST+1, such as 10000:10010")
    tasks: tuple[str, ...] = ()
    scripts: dict[str, str] = {}
    policy: Path = DEFAULT_POLICY
    probe: Path = DEFAULT_PROBE
    num_chunks: int = Field(default=5, ge=1)
    json_path: Path | None = Field(default=None, alias="json", description="write figures here")
    html: Path | None = Field(default=None, description="write a page here")

    @field_validator("seeds")
    @classmethod
    def _is_range(cls, text: str) -> str:
        match = _SEEDS.fullmatch(text)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(f"got {text!r}, expected FIRST:LAST+1 such as 10000:10010")
        return text

    def seed_range(self) -> range:
        """The seeds."""
        first, stop = self.seeds.split(":")
        return range(int(first), int(stop))


def parse(cls: type[SettingsT], arguments: list[str]) -> SettingsT:
    """Settings from flags, then the environment, then defaults.

    Raises:
        InvalidInputError: values that do not fit; every one is named.
        SystemExit: an unknown flag, or --help.
    """
    try:
        return CliApp.run(cls, cli_args=arguments)
    except ValidationError as error:
        raise InvalidInputError(f"{cls.__name__}: {first_problems(error)}") from error


def command_line(word: str, arguments: list[str]) -> str:
    """A command of this service as it would be typed; kept in checkpoints."""
    return shlex.join(["python", "-m", "services.evaluation", word, *arguments])
