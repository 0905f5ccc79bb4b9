"""Settings of the paper's form, and which form of the world model a command line is about."""

import os
from pathlib import Path
from typing import ClassVar, Final, Literal

from pydantic import Field
from pydantic_settings import BaseSettings, CliImplicitFlag, PydanticBaseSettingsSource

from dextouch.command_line import JSON_HELP, CommandParser
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.serving import (
    CommandSettings,
    configuration_path,
    file_source,
    read_configuration,
    section_of,
    service_config,
)
from services.networks import training_settings
from services.world_model.network.configuration import (
    NetworkConfig,
    Precision,
    TokenizerName,
    WanFiles,
)
from services.world_model.presets import PRESETS, PresetSource
from services.world_model.settings import (
    AdaptationSettings,
    AdaptStateCommand,
    DataSettings,
    Output,
    TrainStateCommand,
    recorded_command,
)

STATE: Final = "state"


class OptimizerSettings(training_settings.AdamWSettings):
    """Settings of the optimizer and of the loss."""

    tactile_weight: float = Field(default=1.0, ge=0, description="lambda_tac (equation 5)")
    precision: Precision = Field(default="float32", description="of matrix products in training")
    touch_loss: Literal["all", "contact_or_changing"] = Field(
        default="all", description="tactile tokens in the loss: all, or in contact or changing"
    )


class AdaptOptimizerSettings(OptimizerSettings):
    """Settings of the optimizer with a tenth of the learning rate from random weights."""

    learning_rate: training_settings.LearningRate = 2e-4
    warmup_steps: training_settings.WarmupSteps = 20


class WindowSettings(FrozenModel):
    """Sampling of training windows."""

    short_fraction: training_settings.Share = Field(
        default=0.25, description="share of short windows"
    )
    context_noise: training_settings.Share = Field(
        default=0.05, description="noise on the first latents"
    )
    text_dropout: training_settings.Share = Field(
        default=0.0, description="share of windows without instruction, for --guidance of serving"
    )
    action_dropout: training_settings.Share = Field(
        default=0.0, description="share of windows without actions, for --guidance of serving"
    )
    view_dropout: training_settings.Share = Field(
        default=0.1,
        description="share of windows without a further view, so that starts and episodes may lack "
        "it; 0: they are refused",
    )
    past_dropout: training_settings.Share = Field(
        default=0.1, description="share of windows without past images"
    )
    fit_windows: int = Field(default=256, ge=4, description="windows the codecs are fitted on")


class LoraSettings(FrozenModel):
    """Low-rank adapters of the pretrained video expert, whose own weights are frozen."""

    rank: int = Field(default=0, ge=0, le=1024, description="rank of the adapters; 0: none")
    alpha: float | None = Field(
        default=None, gt=0, description="adapters count alpha / rank times; default: once"
    )
    keep: CliImplicitFlag[bool] = Field(
        default=False, description="store adapters beside the weights instead of merged into them"
    )


class RunSettings(DataSettings):
    """One training run; the first limit that is reached ends it.

    The learning rate follows `max_steps`, or the time where only that is limited. Without a limit,
    there are `USUAL_STEPS`.
    """

    USUAL_STEPS: ClassVar[int] = 10_000

    episodes: str = Field(description="URL or folder of the episode store to train on")
    output: Output = Path("runs/world_model/tiny.safetensors")
    name: str = Field(default="tiny", description="model name in the checkpoint")
    preset: str = Field(
        default="tiny", description=f"named settings, flags override: {', '.join(PRESETS)}"
    )
    seed: int = Field(default=0, ge=0, description="seed of weights and sampling")
    max_steps: int | None = Field(
        default=None, ge=1, description="training steps; a usual number unless time is limited"
    )
    wall_budget_s: float | None = Field(
        default=None,
        gt=0,
        description="seconds after which training ends, in all: also before --resume",
    )
    cpu_budget_s: float | None = Field(
        default=None, gt=0, description="CPU seconds of a process after which it ends, in all"
    )
    num_threads: int = Field(default=1, ge=1, description="threads of torch")
    device: training_settings.Device = "cpu"
    wan: WanFiles = Field(default=WanFiles(), description="files of the pretrained networks")
    heldout_percent: int = Field(
        default=10, ge=1, le=50, description="percentage of episodes held out without --heldout"
    )
    evaluation_stride: int = Field(
        default=8, ge=1, description="evaluate on every n-th window of held-out episodes"
    )
    streaming: CliImplicitFlag[bool] = Field(
        default=False, description="stream episodes from disk, for data larger than memory"
    )
    loader_workers: int = Field(
        default=0, ge=0, le=64, description="reader processes of --streaming; 0: this process"
    )
    resume: CliImplicitFlag[bool] = Field(
        default=False, description="resume an interrupted run of this output, if there is one"
    )
    state_every_s: float = Field(
        default=60.0, ge=0, description="seconds between states saved for --resume"
    )
    freeze_video: CliImplicitFlag[bool] = Field(
        default=False, description="train touch and the effect of actions alone, not Wan2.2"
    )
    lora: LoraSettings = Field(default=LoraSettings(), description="adapters of Wan2.2")
    recompute: CliImplicitFlag[bool] = Field(
        default=False, description="compute activations twice instead of keeping them, by layer"
    )
    accumulate: int = Field(
        default=1, ge=1, description="parts that a process computes its batch in, one by one"
    )
    replicas: int = Field(
        default=1, ge=1, description="copies of the sharded model, such as one a machine"
    )
    optimizer: OptimizerSettings = Field(default=OptimizerSettings(), description="of training")
    windows: WindowSettings = Field(default=WindowSettings(), description="sampling of windows")

    @property
    def step_limit(self) -> int | None:
        """Steps after which training ends, if it ends by steps."""
        is_timed = self.wall_budget_s is not None or self.cpu_budget_s is not None
        return self.USUAL_STEPS if self.max_steps is None and not is_timed else self.max_steps


class TrainSettings(RunSettings):
    """Training of a network, from random weights or from those of a checkpoint."""

    init: Path | None = Field(
        default=None, description="checkpoint to start from; of an equal network, but for sampling"
    )
    tokenizer: Path | None = Field(
        default=None, description="tactile tokenizer of `dextouch train tokenizer`, kept frozen"
    )
    self_forcing: CliImplicitFlag[bool] = Field(
        default=False, description="train on own contexts and samples (see dextouch train distill)"
    )
    consistency: CliImplicitFlag[bool] = Field(
        default=False, description="train on own ends of paths (see dextouch train distill)"
    )
    network: NetworkConfig = Field(default=NetworkConfig(), description="shape of the network")

    def with_adapters(self) -> "TrainSettings":
        """The settings with the adapters of `lora`.

        Raises:
            InvalidInputError: a network without a pretrained video expert to adapt or to freeze.
        """
        network, rank = self.network, self.lora.rank
        if network.wan is None and (rank or self.freeze_video):
            raise InvalidInputError(
                f"training: got {f'--lora.rank {rank}' if rank else '--freeze-video'} with "
                f"video_expert {network.video_expert}, which has no pretrained weights; leave "
                "it out, or use --preset wan22-5b"
            )
        if not rank:
            return self
        scale = 1.0 if self.lora.alpha is None else self.lora.alpha / rank
        return self.model_copy(update={"network": network.adapted(rank, scale)})


def command_line(settings: TrainSettings) -> str:
    """Command that repeats a run, as its checkpoint records it."""
    places = ("episodes", "human", "heldout", "init", "tokenizer")
    local = {"output", "json_path", "resume", "state_every_s", "device", "wan", "plan"}
    local |= {"plan_processes"}
    command = f"dextouch train world-model --preset={settings.preset}"
    return recorded_command(settings, command, places, {*local, "preset"})


class FromCheckpointSettings(RunSettings):
    """Training of a checkpoint, whose network, codecs and normalizers are kept."""

    USUAL_STEPS: ClassVar[int] = 3_000

    init: Path = Field(description="checkpoint to start from")
    optimizer: AdaptOptimizerSettings = Field(
        default=AdaptOptimizerSettings(), description="of training"
    )

    def training(self, network: NetworkConfig) -> TrainSettings:
        """The same run as training of a network from its checkpoint."""
        given = {name: getattr(self, name) for name in RunSettings.model_fields}
        given |= {"optimizer": OptimizerSettings(**self.optimizer.model_dump())}
        given |= {"max_steps": self.step_limit}
        return TrainSettings(**given, init=self.init, network=network)


class TokenizerOptimizer(FrozenModel):
    """Settings of the optimizer."""

    batch: training_settings.Batch = 128
    learning_rate: training_settings.LearningRate = 6e-3
    warmup_steps: training_settings.WarmupSteps = 50


class TrainTokenizerSettings(FrozenModel):
    """One training run; `cpu_budget_s` or `max_steps` ends it, whichever comes first."""

    episodes: training_settings.Stores
    splits: training_settings.Splits = ()
    tokenizer: TokenizerName = Field(
        default="split_hands",
        description="split_hands (the paper's), grid (its baseline), or principal_axes",
    )
    output: Path = Field(
        default=Path("runs/world_model/tokenizer.safetensors"), description="file to write"
    )
    seed: training_settings.Seed = 0
    cpu_budget_s: training_settings.CpuBudget = 60.0
    max_steps: training_settings.MaxSteps = None
    num_threads: int = Field(default=1, ge=1, description="threads of torch")
    heldout_share: float = Field(default=0.1, gt=0, lt=1, description="share of held-out scenes")
    contact_weight: float = Field(
        default=10.0, ge=1, description="weight in the loss of a taxel in contact; others have 1"
    )
    num_evaluations: int = Field(
        default=12, ge=1, le=1000, description="evaluations during training, for the curve"
    )
    palm_channels: int = Field(
        default=112, ge=1, le=240, description="latents per palm pad of principal_axes"
    )
    tactile_channels: int = Field(
        default=192, ge=6, le=1920, multiple_of=6, description="latents per hand of the others"
    )
    optimizer: TokenizerOptimizer = Field(default=TokenizerOptimizer(), description="of training")

    def network(self) -> NetworkConfig:
        """Network configuration with this tokenizer and one token per hand."""
        return NetworkConfig(
            tokenizer=self.tokenizer,
            palm_channels=self.palm_channels,
            tactile_channels=self.tactile_channels,
        )

    def command(self) -> str:
        """Command that repeats the run, as the tokenizer's file records it."""
        left_out = {"output", "picture", "beside", "json_path"}
        return recorded_command(self, "dextouch train tokenizer", ("episodes",), left_out)


class TrainCommand(CommandSettings, TrainSettings):
    r"""Train the paper's form: a joint visuo-tactile flow-matching model of windows of episodes.

    Example:
      dextouch train world-model --preset tiny --episodes runs/data --output runs/tiny.safetensors

    In the paper's design, whose tokenizer is trained first:
      dextouch train tokenizer --episodes runs/episodes --output runs/tokenizer.safetensors
      dextouch train world-model --preset paper --tokenizer runs/tokenizer.safetensors \
        --episodes runs/episodes --output runs/paper.safetensors

    At full size, from a local copy of Wan2.2-TI2V-5B; with --plan to see what it needs:
      dextouch train world-model --preset wan22-5b --wan.folder models/Wan2.2-TI2V-5B-Diffusers \
        --tokenizer runs/tokenizer.safetensors --episodes runs/episodes --plan
    """

    model_config = service_config("world_model_train", "dextouch train world-model")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
    plan: CliImplicitFlag[bool] = Field(
        default=False,
        description="print memory and FLOPs of a chunk and of this training, and what fits a card, "
        "in some ten CPU seconds",
    )
    plan_processes: int = Field(
        default=8, ge=1, description="processes that --plan shards the training over, too"
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags, the environment, the file, then the preset that one of them names."""
        given = init_settings, env_settings, *file_source(settings_cls)
        return (*given, PresetSource(settings_cls))


class CacheCommand(TrainCommand):
    r"""Encode the images of a training once, before it, so that it never runs the video encoder.

    Give it the flags of that training, which then reads the same file. What is there already is
    not computed again, so that it can be interrupted, and new episodes can be added. A training
    keeps what it does not find there, too.

    Example:
      dextouch train cache --preset wan22-5b --wan.folder models/Wan2.2-TI2V-5B-Diffusers \
        --episodes runs/episodes --wan.latent-cache runs/latents.sqlite3 --wan.text-cache runs/texts
    """

    model_config = service_config("world_model_cache", "dextouch train cache")


class AdaptCommand(CommandSettings, AdaptationSettings, FromCheckpointSettings):
    """Adapt a world model of the paper's form to new tasks, from robot and human episodes.

    The network, its codecs and its normalizers are those of the checkpoint; human and robot
    episodes may be of the same tasks, but not of those that the checkpoint was trained on.

    Example:
      dextouch train adapt --init runs/paper.safetensors --episodes runs/new --robot-episodes 200
    """

    model_config = service_config("world_model_adapt", "dextouch train adapt")

    init: Path = Field(description="checkpoint to adapt")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class DistillCommand(CommandSettings, FromCheckpointSettings):
    """Train a world model in the paper's form to sample in few steps.

    By self-forcing it predicts the mean of what may follow: right where commands decide it. By
    consistency it predicts one of them, and another one from other noise. The network, its codecs
    and its normalizers are those of the checkpoint.

    Example:
      dextouch train distill --init runs/paper.safetensors --steps 1 --episodes runs/episodes
    """

    model_config = service_config("world_model_distill", "dextouch train distill")

    steps: int = Field(default=1, ge=1, le=64, description="network calls per chunk")
    objective: Literal["self_forcing", "consistency"] = Field(
        default="self_forcing", description="what is learned: the mean future, or one"
    )
    output: Output = Path("runs/world_model/distilled.safetensors")
    name: str = Field(default="distilled", description="model name in the checkpoint")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)

    def training(self, network: NetworkConfig) -> TrainSettings:
        """The same run as training of a network from its checkpoint."""
        few = network.model_copy(update={"sampling_steps": self.steps, "sampler": "euler"})
        flags = {"self_forcing": True, "consistency": self.objective == "consistency"}
        return super().training(few).model_copy(update=flags)


class TrainTokenizerCommand(CommandSettings, TrainTokenizerSettings):
    """Train a tactile tokenizer on the touch of people and robots, for `--tokenizer`.

    Example:
      dextouch train tokenizer --episodes runs/episodes --output runs/split_hands.safetensors
    """

    model_config = service_config("world_model_train_tokenizer", "dextouch train tokenizer")

    picture: Path | None = Field(
        default=None, description="SVG to draw: held-out error and Contact-IoU over training steps"
    )
    beside: tuple[Path, ...] = Field(default=(), description="other tokenizers to draw, too")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


def train_settings(arguments: list[str]) -> type[TrainStateCommand] | type[TrainCommand]:
    """Settings of `dextouch train world-model`: of the form that --preset names.

    Raises:
        UnknownNameError: no such preset.
        InvalidInputError: the configuration file has settings of a form that is not trained.
    """
    preset = _value(arguments, "preset", TrainCommand) or STATE
    if preset not in (STATE, *PRESETS):
        raise UnknownNameError("preset", preset, [STATE, *PRESETS])
    if preset != STATE:
        return TrainCommand
    path, section = configuration_path(), section_of(TrainCommand)
    # Nothing would read them.
    if path is not None and read_configuration(path).get(section, {"preset": STATE}) != {
        "preset": STATE
    }:
        raise InvalidInputError(
            f"{path}: [{section}] has settings of the paper's form, and no preset of it is named; "
            f'add preset = "tiny" there, or move them to [{section_of(TrainStateCommand)}]'
        )
    return TrainStateCommand


def adapt_settings(arguments: list[str]) -> type[AdaptStateCommand] | type[AdaptCommand]:
    """Settings of `dextouch train adapt`: of the form of the checkpoint --init."""
    init = _value(arguments, "init", AdaptStateCommand, AdaptCommand)
    if init is None:
        return AdaptStateCommand
    from services.world_model.checkpoints import is_state_checkpoint

    return AdaptStateCommand if is_state_checkpoint(Path(init)) else AdaptCommand


def _value(arguments: list[str], name: str, *classes: type[CommandSettings]) -> str | None:
    """One setting, before it is known which class it is of: a flag, or configured."""
    parser = CommandParser(add_help=False, allow_abbrev=False)
    parser.add_argument(f"--{name}", dest="value")
    value: str | None = parser.parse_known_args(arguments)[0].value
    path = configuration_path()
    for section in map(section_of, classes):
        kept = {} if path is None else read_configuration(path).get(section, {})
        value = value or os.environ.get(f"DEXTOUCH_{section}_{name}".upper()) or kept.get(name)
    return value
