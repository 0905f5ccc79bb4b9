"""Settings of training and of an evaluation, from flags and environment."""

import re
import shlex
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from pydantic_settings import BaseSettings

from dextouch.command_line import JSON_HELP
from dextouch.serving.settings import service_config
from services.evaluation.direct_training import DirectSettings
from services.evaluation.policies.cloning_training import CloningSettings
from services.evaluation.success_probe_training import ProbeSettings

PRETRAINED = Path(__file__).parent / "pretrained"
DEFAULT_POLICY = PRETRAINED / "behaviour_cloning.safetensors"
EARLY_POLICY = PRETRAINED / "behaviour_cloning_early.safetensors"
DEFAULT_PROBE = PRETRAINED / "success_probe.safetensors"
_SEEDS = re.compile(r"(\d+):(\d+)")


class TrainPolicySettings(BaseSettings):
    """Train a closed-loop policy that imitates the successful robot episodes of some stores.

    Example:
      dextouch train policy --episodes runs/episodes --output runs/cloned.safetensors
    """

    model_config = service_config("evaluation_train_policy", "dextouch train policy")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    output: Path = Field(
        default=Path("runs/evaluation/behaviour_cloning.safetensors"),
        description="checkpoint to write",
    )
    tasks: tuple[str, ...] = Field(default=(), description="only these; default: all there are")
    early_at: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="share of training after which a policy that is not finished is kept too, "
        "beside the output as …_early.safetensors",
    )
    training: CloningSettings = Field(default=CloningSettings(), description="how it is trained")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)

    def early_output(self) -> Path:
        """Where the early policy goes."""
        return self.output.with_stem(f"{self.output.stem}_early")


class TrainProbeSettings(BaseSettings):
    """Train the judge of success on the robot episodes of some stores, true and imagined ones.

    Example:
      dextouch train probe --episodes runs/true,runs/imagined --output runs/probe.safetensors
    """

    model_config = service_config("evaluation_train_probe", "dextouch train probe")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    development: tuple[str, ...] = Field(
        default=(), description="stores to calibrate on (a share of the seeds of `episodes`)"
    )
    held_out: tuple[str, ...] = Field(
        default=(), description="stores to measure on (a fifth of the seeds of `episodes`)"
    )
    output: Path = Field(
        default=Path("runs/evaluation/success_probe.safetensors"), description="checkpoint to write"
    )
    tasks: tuple[str, ...] = Field(default=(), description="only these; default: all there are")
    training: ProbeSettings = Field(default=ProbeSettings(), description="how it is trained")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class TrainDirectSettings(BaseSettings):
    """Train a judge that tells success from first observations and commands, imagining nothing.

    Example:
      dextouch train direct-judge --episodes runs/episodes --output runs/direct.safetensors
    """

    model_config = service_config("evaluation_train_direct_judge", "dextouch train direct-judge")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    output: Path = Field(
        default=Path("runs/evaluation/direct_judge.safetensors"), description="checkpoint to write"
    )
    tasks: tuple[str, ...] = Field(default=(), description="only these; default: all there are")
    training: DirectSettings = Field(default=DirectSettings(), description="how it is trained")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class ServedWorld(BaseModel):
    """A world behind a URL."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    url: str = Field(description="of the service")
    world: str = Field(description="its name there")
    api_key: str | None = Field(default=None, description="for it, if it asks for one")


class RunSettings(BaseSettings):
    r"""Roll policies out in a real and in imagined worlds, and score both.

    How to write a policy of your own and score it: docs/policies.md. The exit status is 1 when a
    rollout failed; the others count.

    Example:
      dextouch evaluate --seeds 10000:10010 --tasks stand_bottle --json report.json \
        --real.url http://127.0.0.1:8084 --real.world twin \
        --imagined '{"model": {"url": "http://127.0.0.1:8085", "world": "world_model"}}'
    """

    model_config = service_config("evaluation_run", "dextouch evaluate")

    real: ServedWorld = Field(description="the world that judges success itself, such as the twin")
    imagined: dict[str, ServedWorld] = Field(
        default={},
        description="worlds to compare with it, by their names in the report; may be left out",
    )
    seeds: str = Field(description="FIRST:LAST+1, such as 10000:10010")
    tasks: tuple[str, ...] = Field(default=(), description="default: all the success probe knows")
    policy: tuple[str, ...] = Field(
        default=(), description="policy of your own, [NAME=]MODULE:FACTORY; may be repeated"
    )
    policy_arguments: dict[str, dict[str, Any]] = Field(
        default={}, description="keyword arguments of factories, by the policy's name"
    )
    scripts: dict[str, str] = Field(
        default={}, description="stores whose robot episodes are replayed, by the policy's name"
    )
    builtin: tuple[Literal["behaviour-cloning", "hold"], ...] = Field(
        default=("behaviour-cloning", "hold"),
        description="policies of ours beside them; [] for none",
    )
    cloned_policy: Path = Field(default=DEFAULT_POLICY, description="checkpoint of train-policy")
    probe: Path = Field(default=DEFAULT_PROBE, description="checkpoint of train-probe")
    num_steps: int = Field(default=80, ge=4, description="length of a rollout; 15 steps a second")
    results: Path | None = Field(
        default=None,
        description="every rollout is added here as a line of JSON when it ends; default: beside "
        "the report, as .jsonl; not the file of --json or --html",
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
    html: Path | None = Field(default=None, description="write a page here")

    @field_validator("seeds")
    @classmethod
    def _is_range(cls, text: str) -> str:
        match = _SEEDS.fullmatch(text)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(f"got {text!r}, expected FIRST:LAST+1 such as 10000:10010")
        return text

    @model_validator(mode="after")
    def _writes_each_file_once(self) -> "RunSettings":
        results = "--results" if self.results else "--results (by default beside the report)"
        taken: dict[Path, str] = {}
        files = ((results, self.results_path()), ("--json", self.json_path), ("--html", self.html))
        for flag, path in files:
            if path and (other := taken.setdefault(path.resolve(), flag)) != flag:
                raise ValueError(
                    f"{other} and {flag} are the same file, {path}; one would overwrite the other: "
                    "give each its own"
                )
        return self

    def results_path(self) -> Path:
        """Where rollouts are kept: as asked, beside the report, or in the working folder."""
        report = self.json_path or self.html or Path("evaluation")
        return self.results or report.with_suffix(".jsonl")

    def seed_range(self) -> range:
        """The seeds."""
        first, stop = self.seeds.split(":")
        return range(int(first), int(stop))


def command_line(word: str, arguments: list[str]) -> str:
    """A command of this service as it would be typed; kept in checkpoints.

    Files and folders go by their last name, since others have other folders.
    """
    named = [
        f"{flag}{separator}{value.rstrip('/').rsplit('/', 1)[-1]}"
        for flag, separator, value in (one.rpartition("=") for one in arguments)
    ]
    return shlex.join(["python", "-m", "services.evaluation", word, *named])
