"""Settings of training, evaluation, studies and ratings; imports no torch, to be quick to show."""

import re
import shlex
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator, model_validator

from dextouch.command_line import JSON_HELP
from dextouch.data_folder import data_folder, default_store
from dextouch.frozen_model import FrozenModel
from dextouch.serving import CommandSettings, ServiceSettings, service_config
from services.evaluation.bundled_policies import DEFAULT_POLICY, PRETRAINED, BundledName
from services.networks import training_settings

EARLY_POLICY = PRETRAINED / "behaviour_cloning_early.safetensors"
# Word of `--base` for the next.
PACKAGE = Path("package")
DEFAULT_PROBE = PRETRAINED / "success_probe.safetensors"
# Allowed share of wrong answers among the decided endings; a smaller one leaves more undecided from
# the next calibration on. Kinds of mistakes that nothing was calibrated on are judged wrongly about
# twice as often.
RISK_OF_DECIDED = 0.05
_SEEDS = re.compile(r"(\d+):(\d+)")
# Of each path of a list, all but its last component.
_FOLDERS = re.compile(r"""[^,"=\[\]]*/(?=[^/,"\]])""")
DEFAULT_MARKS = Path("runs/ratings.sqlite")
_MARKS = "append-only SQLite file of the marks"
_STUDY = "name of the study whose rollouts are rated; default: all rollouts of the store"
_RUBRICS = "TOML file of rubrics by task; default: the package's"


class CloningSettings(training_settings.TrainingSettings):
    """Training settings of behaviour cloning."""

    num_training_steps: training_settings.NumSteps = 3000
    max_cpu_s: training_settings.CpuBudget = 240.0
    batch_size: training_settings.Batch = 72
    learning_rate: training_settings.LearningRate = 1.5e-3
    weight_decay: training_settings.WeightDecay = 1e-3
    held_out_share: float = Field(default=0.12, gt=0, lt=1, description="share of held-out seeds")


class ClassifierSettings(training_settings.TrainingSettings):
    """Training settings of a success classifier."""

    # For each task.
    num_training_steps: training_settings.NumSteps = 2000
    max_cpu_s: training_settings.CpuBudget = 200.0
    batch_size: training_settings.Batch = Field(default=48, ge=2)
    learning_rate: training_settings.LearningRate = 1.5e-3
    weight_decay: training_settings.WeightDecay = 5e-2
    development_share: float = Field(
        default=0.15, gt=0, lt=1, description="share of seeds to calibrate on"
    )
    held_out_share: float = Field(default=0.2, gt=0, lt=1, description="share of held-out seeds")
    risk: float = Field(
        default=RISK_OF_DECIDED,
        gt=0,
        lt=1,
        description="allowed share of errors among decided endings",
    )
    imagined_risk: float = Field(
        default=RISK_OF_DECIDED,
        gt=0,
        lt=1,
        description="the same for imagined endings of worlds that estimate success",
    )
    contradiction_margin: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="distance from 0.5 beyond which probe and world contradict each other",
    )


class TrainPolicySettings(CommandSettings):
    """Train a policy on the successful robot episodes of some stores.

    By default a closed-loop network on images, touch and poses. With `--places`, the start readers
    of a state model find the objects in the first image, and whole motions are a regression on
    these places: it is fitted in seconds and needs far fewer demonstrations, which have to go
    alike, but it does not react to what happens later.

    Example:
      dextouch train policy --episodes runs/episodes --output runs/cloned.safetensors
      dextouch train policy --episodes runs/episodes --places runs/lab.safetensors
    """

    model_config = service_config("evaluation_train_policy", "dextouch train policy")

    episodes: training_settings.Stores
    output: Path = Field(
        default=Path("runs/evaluation/behaviour_cloning.safetensors"),
        description="checkpoint to write",
    )
    tasks: training_settings.Tasks = ()
    splits: training_settings.Splits = ()
    image_px: training_settings.ImagePx = training_settings.USUAL_IMAGE_PX
    places: Path | None = Field(
        default=None, description="state model whose start readers find the objects"
    )
    imagined: tuple[str, ...] = Field(
        default=(), description="additional stores of imagined episodes; --splits does not apply"
    )
    early_at: float | None = Field(
        default=None,
        gt=0,
        lt=1,
        description="fraction of training after which an early policy is also saved, "
        "next to the output as …_early.safetensors",
    )
    training: CloningSettings = Field(default=CloningSettings(), description="training settings")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class TrainJudgeSettings(CommandSettings):
    r"""Train the success classifier on true and imagined robot episodes of some stores.

    Example:
      dextouch train judge --episodes runs/true,runs/imagined --output runs/probe.safetensors

    To calibrate a trained probe to another world model, on what that imagined:
      dextouch train judge --base package --episodes runs/true,runs/imagined_anew \
        --output runs/calibrated.safetensors
    """

    model_config = service_config("evaluation_train_probe", "dextouch train judge")

    episodes: training_settings.Stores
    base: Path | None = Field(
        default=None,
        description="success classifier whose weights are kept, `package` for the package's: only "
        "its probabilities and bands are fitted, to all of --episodes and --development",
    )
    development: tuple[str, ...] = Field(
        default=(), description="stores to calibrate on (default: a share of the scenes)"
    )
    held_out: tuple[str, ...] = Field(
        default=(),
        description="stores to evaluate on (default: a fifth of the scenes); --splits does not "
        "apply",
    )
    output: Path = Field(
        default=Path("runs/evaluation/success_probe.safetensors"), description="checkpoint to write"
    )
    tasks: training_settings.Tasks = ()
    splits: training_settings.Splits = ()
    image_px: training_settings.ImagePx = training_settings.USUAL_IMAGE_PX
    jobs: int = Field(default=2, ge=1, le=64, description="tasks trained in parallel")
    training: ClassifierSettings = Field(
        default=ClassifierSettings(), description="training settings"
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


def command_line(word: str, arguments: list[str]) -> str:
    """Command line of this service as typed; stored in checkpoints.

    Files and folders are given by their last path component, since folders differ.
    """
    named = [_FOLDERS.sub("", one.rstrip("/")) for one in arguments]
    return shlex.join(["dextouch", "train", word, *named])


class ServedWorld(FrozenModel):
    """A world served at a URL."""

    url: str = Field(description="URL of the service")
    world: str = Field(description="name of the world")
    api_key: str | None = Field(default=None, description="API key, if required")


class RunSettings(CommandSettings):
    r"""Roll out policies in a real and in imagined worlds and score them.

    docs/policies.md shows how to write and score a policy. The exit status is 1 if a rollout
    failed; the other rollouts still count.

    Example:
      dextouch evaluate --seeds 10000:10010 --tasks stand_bottle --json report.json \
        --real.url http://127.0.0.1:8084 --real.world twin \
        --imagined '{"model": {"url": "http://127.0.0.1:8085", "world": "world_model"}}'
    """

    model_config = service_config("evaluation_run", "dextouch evaluate")

    real: ServedWorld = Field(description="world that reports success, such as the twin")
    imagined: dict[str, ServedWorld] = Field(
        default={},
        description="worlds to compare with the real one, by name in the report; optional",
    )
    seeds: str = Field(description="FIRST:LAST+1, such as 10000:10010")
    tasks: tuple[str, ...] = Field(default=(), description="default: all tasks of the probe")
    policy: tuple[str, ...] = Field(
        default=(), description="custom policy, [NAME=]MODULE:FACTORY; repeatable"
    )
    policy_arguments: dict[str, dict[str, Any]] = Field(
        default={}, description="factory arguments, by policy name"
    )
    scripts: dict[str, str] = Field(
        default={}, description="stores of episodes to replay, by policy name"
    )
    builtin: tuple[BundledName, ...] = Field(
        default=("behaviour-cloning", "hold"),
        description="bundled policies; [] for none; colour-servo knows only stand_bottle and "
        "open_drawer",
    )
    cloned_policy: Path = Field(
        default=DEFAULT_POLICY, description="checkpoint of `dextouch train policy`"
    )
    probe: Path = Field(default=DEFAULT_PROBE, description="checkpoint of `dextouch train judge`")
    num_steps: int = Field(default=80, ge=4, description="steps of a rollout, at 15 per second")
    results: Path | None = Field(
        default=None,
        description="JSON Lines file to which rollouts are appended as they end; default: next to "
        "the report, as .jsonl; not the file of --json or --html",
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
    html: Path | None = Field(default=None, description="HTML page to write")

    @field_validator("seeds")
    @classmethod
    def _is_range(cls, text: str) -> str:
        match = _SEEDS.fullmatch(text)
        if not match or int(match[1]) >= int(match[2]):
            raise ValueError(f"got {text!r}, expected FIRST:LAST+1 such as 10000:10010")
        return text

    @model_validator(mode="after")
    def _writes_each_file_once(self) -> "RunSettings":
        results = "--results" if self.results else "--results (by default next to the report)"
        taken: dict[Path, str] = {}
        files = ((results, self.results_path()), ("--json", self.json_path), ("--html", self.html))
        for flag, path in files:
            if path and (other := taken.setdefault(path.resolve(), flag)) != flag:
                raise ValueError(
                    f"{other} and {flag} are the same file, {path}; choose different files"
                )
        return self

    def results_path(self) -> Path:
        """Path of the results: as requested, beside the report, or in the working folder."""
        report = self.json_path or self.html or Path("evaluation")
        return self.results or report.with_suffix(".jsonl")

    def seed_range(self) -> range:
        """The seeds."""
        first, stop = self.seeds.split(":")
        return range(int(first), int(stop))


class StudyServiceSettings(ServiceSettings):
    """Serve the results of studies over HTTP, for the dashboard.

    Reads only: studies are run by `dextouch study run`, and may run meanwhile.

    Example:
      dextouch study serve --studies data/studies --port 8086
    """

    model_config = service_config("studies", "dextouch study serve")

    studies: Path = Field(
        default_factory=lambda: data_folder() / "studies",
        description="folder that holds the folder of each study",
    )


class RatingSettings(ServiceSettings):
    """Serve a page on which people rate the rollouts of a store, without knowing their origin.

    Every rater sees the rollouts in a different order, without policy, world or the marks of
    others, and some of them twice. With API keys, a rater is the name of a key with the scope
    `rate`, or is invited by a link: `/lead`, for a key with the scope `rate_lead`, makes links and
    shows how far raters agree.

    Example:
      dextouch rate serve --store-url runs/rollouts --marks runs/ratings.sqlite --port 8087
    """

    model_config = service_config("rating", "dextouch rate serve")

    store_url: str = Field(
        default_factory=default_store, min_length=1, description="folder or file:// URL"
    )
    marks: Path = Field(default=DEFAULT_MARKS, description=_MARKS)
    rubrics: Path | None = Field(default=None, description=_RUBRICS)
    tasks: tuple[str, ...] = Field(
        default=(), description="tasks to rate; default: all that have a rubric"
    )
    study: str | None = Field(default=None, min_length=1, description=_STUDY)
    raters_per_rollout: int = Field(
        default=5, ge=1, le=100, description="people who rate each rollout, and one more if tied"
    )
    repeat_share: float = Field(
        default=0.08, ge=0, le=0.5, description="share of rollouts that a rater sees twice"
    )


class RatingReportSettings(CommandSettings):
    """Print the scores of the rated rollouts of a store, and the agreement of raters.

    Example:
      dextouch rate report --store-url runs/rollouts --marks runs/ratings.sqlite --json ratings.json
    """

    model_config = service_config("rating_report", "dextouch rate report")

    store_url: str = Field(
        default_factory=default_store, min_length=1, description="folder or file:// URL"
    )
    marks: Path = Field(default=DEFAULT_MARKS, description=_MARKS)
    rubrics: Path | None = Field(default=None, description=_RUBRICS)
    study: str | None = Field(default=None, min_length=1, description=_STUDY)
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
