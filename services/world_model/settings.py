"""Settings of world model training and serving, from flags and environment variables."""

from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import (
    BaseSettings,
    CliImplicitFlag,
    PydanticBaseSettingsSource,
)

from dextouch.command_line import JSON_HELP
from dextouch.frozen_model import FrozenModel
from dextouch.serving import CommandSettings, file_source, service_config
from dextouch.worlds import WorldServiceSettings
from services.networks.training_settings import (
    USUAL_IMAGE_PX,
    AverageDecay,
    Batch,
    CpuBudget,
    Device,
    ImagePx,
    LearningRate,
    MaxGradientNorm,
    MaxSteps,
    NumSteps,
    Splits,
    Stores,
    Tasks,
    WarmupSteps,
    WeightDecay,
)
from services.world_model.network.configuration import NetworkConfig, Precision, Sampler
from services.world_model.placement import Placement
from services.world_model.presets import PRESETS, PresetSource
from services.world_model.rendering.configuration import RendererConfig, RendererTraining
from services.world_model.shipped_checkpoints import PRETRAINED, default_checkpoint
from services.world_model.wan.configuration import WanFiles


class OptimizerSettings(FrozenModel):
    """Settings of the optimizer."""

    batch: Batch = 8
    learning_rate: LearningRate = 2e-3
    warmup_steps: WarmupSteps = 100
    weight_decay: WeightDecay = 0.02
    max_gradient_norm: MaxGradientNorm = 1.0
    ema_decay: AverageDecay = 0.995
    tactile_weight: float = Field(default=1.0, ge=0, description="lambda_tac (equation 5)")
    precision: Precision = Field(
        default="float32", description="of matrix products in training; weights keep theirs"
    )
    touch_loss: Literal["all", "contact_or_changing"] = Field(
        default="all",
        description="tactile tokens that count in the loss: all, or those in contact or changing",
    )


class AdaptOptimizerSettings(OptimizerSettings):
    """Settings of the optimizer with a tenth of the learning rate from random weights."""

    learning_rate: LearningRate = 2e-4
    warmup_steps: WarmupSteps = 20


class WindowSettings(FrozenModel):
    """Sampling of training windows."""

    commanded_fraction: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="share of windows with commanded actions, where available",
    )
    chained_fraction: float = Field(
        default=0.3, ge=0, le=1, description="share of commanded windows anchored like later chunks"
    )
    short_fraction: float = Field(default=0.25, ge=0, le=1, description="share of short windows")
    context_noise: float = Field(default=0.05, ge=0, le=1, description="noise on the first latents")
    fit_windows: int = Field(default=256, ge=4, description="windows the codecs are fitted on")


class DataSettings(FrozenModel):
    """Which episodes of people and robots a world model of either form is trained on.

    With `human` stores, only robot episodes are taken from `episodes` and `heldout`, and only human
    ones from `human`.
    """

    human: tuple[str, ...] = Field(
        default=(), description="stores (folder or file:// URL) with human episodes to mix in"
    )
    human_share: float = Field(
        default=0.5, ge=0, le=1, description="share of training examples from human episodes"
    )
    robot_episodes: int | None = Field(
        default=None,
        ge=1,
        description="number of episodes of `episodes` to train on, by hash; more contain fewer",
    )
    human_episodes: int | None = Field(
        default=None, ge=0, description="number of human episodes, in the same way"
    )
    disjoint_tasks: CliImplicitFlag[bool] = Field(
        default=True, description="refuse human episodes of tasks that robots have, too"
    )
    new_tasks: CliImplicitFlag[bool] = Field(
        default=False, description="refuse tasks that the initial checkpoint was trained on"
    )
    splits: Splits = ()
    heldout: str | None = Field(
        default=None, description="store to evaluate on; default: a share of `episodes`, by hash"
    )

    @property
    def share_of_human(self) -> float | None:
        """Share of examples from human episodes; None where domains are not told apart."""
        return self.human_share if self.human else None


class RunSettings(DataSettings):
    """One training run; `cpu_budget_s` or `max_steps` ends it, whichever comes first."""

    episodes: str = Field(description="URL or folder of the episode store to train on")
    output: Path = Field(
        default=Path("runs/world_model/tiny.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="tiny", description="model name in the checkpoint")
    preset: str = Field(
        default="tiny",
        description=f"named settings that other flags override: {', '.join(PRESETS)}",
    )
    seed: int = Field(default=0, ge=0, description="seed of weights and sampling")
    cpu_budget_s: CpuBudget = 1000.0
    max_steps: MaxSteps = None
    num_threads: int = Field(default=1, ge=1, description="threads of torch")
    device: Device = "cpu"
    wan: WanFiles = Field(default=WanFiles(), description="files of the pretrained networks")
    heldout_percent: int = Field(
        default=10,
        ge=1,
        le=50,
        description="percentage of episodes to evaluate on if no --heldout is given",
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
        default=False,
        description="resume an interrupted run of this output, if there is one",
    )
    state_every_cpu_s: float = Field(
        default=60.0, ge=0, description="CPU seconds between states saved for --resume"
    )
    optimizer: OptimizerSettings = Field(
        default=OptimizerSettings(), description="settings of the optimizer"
    )
    windows: WindowSettings = Field(
        default=WindowSettings(), description="sampling of training windows"
    )


class TrainSettings(RunSettings):
    """Training of a network, from random weights or from those of a checkpoint."""

    init: Path | None = Field(
        default=None,
        description="checkpoint to initialize from; its network settings must be equal, except "
        "those of sampling",
    )
    tokenizer: Path | None = Field(
        default=None, description="tactile tokenizer of `dextouch train tokenizer`, kept frozen"
    )
    self_forcing: CliImplicitFlag[bool] = Field(
        default=False, description="train on own contexts and samples (see dextouch train distill)"
    )
    network: NetworkConfig = Field(default=NetworkConfig(), description="shape of the network")


class AdaptSettings(RunSettings):
    """Adaptation of a trained model to new tasks.

    The network, its codecs and its normalizers are those of the checkpoint; human and robot
    episodes may be of the same tasks, but not of those that the checkpoint was trained on.
    """

    init: Path = Field(description="checkpoint to adapt")
    output: Path = Field(
        default=Path("runs/world_model/adapted.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="adapted", description="model name in the checkpoint")
    cpu_budget_s: CpuBudget = 300.0
    disjoint_tasks: CliImplicitFlag[bool] = Field(
        default=False, description="refuse human episodes of tasks that robots have, too"
    )
    new_tasks: CliImplicitFlag[bool] = Field(
        default=True, description="refuse tasks that the initial checkpoint was trained on"
    )
    optimizer: AdaptOptimizerSettings = Field(
        default=AdaptOptimizerSettings(), description="settings of the optimizer"
    )

    def training(self, network: NetworkConfig) -> TrainSettings:
        """The same run as training of a network from its checkpoint."""
        given = {name: getattr(self, name) for name in RunSettings.model_fields}
        given |= {"optimizer": OptimizerSettings(**self.optimizer.model_dump())}
        return TrainSettings(**given, init=self.init, network=network)


class ReaderSettings(FrozenModel):
    """Training of start readers."""

    num_steps: NumSteps = 5000
    batch: Batch = 32
    learning_rate: LearningRate = 2e-3
    ema_decay: AverageDecay = 0.995
    first_fraction: float = Field(default=0.6, ge=0, le=1, description="share of first steps")
    bfloat16: bool | None = Field(
        default=None, description="convolve in bfloat16; default: if that is faster here"
    )


class CoreLossWeights(FrozenModel):
    """Weights of a core's training targets; 0 disables one."""

    objects: float = Field(default=1.0, ge=0, description="weight of object positions and axes")
    touch: float = Field(default=6.0, ge=0, description="weight of touch latents")
    contact: float = Field(default=0.5, ge=0, description="weight of pad contact")
    taxels: float = Field(default=2.0, ge=0, description="weight of taxel contact")
    success: float = Field(default=1.0, ge=0, description="weight of final task success")


class CoreSettings(FrozenModel):
    """Training of recurrent cores."""

    num_steps: NumSteps = 3500
    batch: Batch = 64
    learning_rate: LearningRate = 2e-3
    weight_decay: WeightDecay = 0.05
    ema_decay: AverageDecay = 0.99
    first_fraction: float = Field(default=0.6, ge=0, le=1, description="share of whole episodes")
    measured_fraction: float = Field(
        default=0.15, ge=0, le=1, description="share of examples with measured actions"
    )
    held_fraction: float = Field(
        default=0.04, ge=0, le=1, description="share of examples with the hands held still"
    )
    pose_noise_m: float = Field(
        default=0.012, ge=0, description="largest noise on ground-truth start poses"
    )
    weights: CoreLossWeights = Field(
        default=CoreLossWeights(), description="weights of the training targets"
    )


# What is trained of a state model that a training starts from.
Learned = Literal["all", "readers", "success"]


class StateTrainSettings(DataSettings):
    """Training of a state model: an ensemble of start readers and recurrent cores."""

    episodes: Stores
    tasks: Tasks = ()
    clicks: Path | None = Field(
        default=None,
        description="JSON file of the tasks' objects, with clicks on them or without: clicks that "
        "the dashboard stored are used, too (docs/objects.md)",
    )
    output: Path = Field(
        default=Path("runs/world_model/state.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="state", description="model name in the checkpoint")
    init: Path | None = Field(
        default=None, description="state model to start from; --learn says what is trained of it"
    )
    learn: Learned = Field(
        default="all",
        description="of --init: all but its touch codec; readers, that is start readers and the "
        "estimate of success, for new tasks from few takes; or the estimate of success alone",
    )
    seed: int = Field(default=0, ge=0, description="seed of weights and sampling")
    num_members: int = Field(default=3, ge=1, le=16, description="members of the ensemble")
    heldout_share: float = Field(
        default=0.08, gt=0, lt=1, description="share of held-out scenes, if no --heldout is given"
    )
    jobs: int = Field(default=2, ge=1, le=64, description="members trained in parallel")
    image_px: ImagePx = USUAL_IMAGE_PX
    labelled_share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of scenes that train object poses; touch and success use all",
    )
    width: int = Field(default=192, ge=8, le=1024, description="width of the recurrent cores")
    reader: ReaderSettings = Field(
        default=ReaderSettings(), description="training of start readers"
    )
    core: CoreSettings = Field(default=CoreSettings(), description="training of recurrent cores")
    renderer: RendererConfig = Field(default=RendererConfig(), description="shape of the renderer")
    drawing: RendererTraining = Field(
        default=RendererTraining(), description="training of the renderer"
    )


class AdaptReaderSettings(ReaderSettings):
    """Training of start readers from those of another model."""

    num_steps: NumSteps = 2000


class AdaptCoreSettings(CoreSettings):
    """Training of recurrent cores from those of another model."""

    num_steps: NumSteps = 1500
    learning_rate: LearningRate = 1e-3


class StateAdaptSettings(StateTrainSettings):
    """Adaptation of a state model to new tasks, from robot and human episodes.

    Its touch codec is kept, all else is trained on; human and robot episodes may be of the same
    tasks, but not of those that the model was trained on.
    """

    init: Path = Field(description="checkpoint to adapt")
    output: Path = Field(
        default=Path("runs/world_model/adapted.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="adapted", description="model name in the checkpoint")
    disjoint_tasks: CliImplicitFlag[bool] = Field(
        default=False, description="refuse human episodes of tasks that robots have, too"
    )
    new_tasks: CliImplicitFlag[bool] = Field(
        default=True, description="refuse tasks that the initial checkpoint was trained on"
    )
    reader: AdaptReaderSettings = Field(
        default=AdaptReaderSettings(), description="training of start readers"
    )
    core: AdaptCoreSettings = Field(
        default=AdaptCoreSettings(), description="training of recurrent cores"
    )


class TrainStateCommand(CommandSettings, StateTrainSettings):
    """Train a world model on whole episodes of robots and people: the state model, by default.

    Example:
      dextouch train world-model --episodes runs/episodes --output runs/state.safetensors

    With people of other tasks, half of what is drawn:
      dextouch train world-model --episodes runs/robot --human runs/human

    The paper's form has presets, and settings of its own:
      dextouch train world-model --preset tiny --help
    """

    model_config = service_config("world_model_train_state", "dextouch train world-model")

    preset: Literal["state"] = Field(
        default="state",
        description=f"form of the model: state, or of the paper's form {', '.join(PRESETS)}",
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class AdaptStateCommand(CommandSettings, StateAdaptSettings):
    """Adapt a world model of either form to new tasks, from robot and human episodes.

    A checkpoint of the paper's form has other settings: --init PATH --help shows them.

    Example:
      dextouch train adapt --init runs/mixed.safetensors --episodes runs/new --robot-episodes 200
    """

    model_config = service_config("world_model_adapt_state", "dextouch train adapt")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


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
        default=False, description="print memory and FLOPs of the network, and do not train"
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


class AdaptCommand(CommandSettings, AdaptSettings):
    """Adapt a world model of the paper's form to new tasks, from robot and human episodes.

    Example:
      dextouch train adapt --init runs/paper.safetensors --episodes runs/new --robot-episodes 200
    """

    model_config = service_config("world_model_adapt", "dextouch train adapt")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class ShowCommand(CommandSettings):
    """Show the provenance and accuracy of a checkpoint, or of every checkpoint in a folder.

    Example:
      dextouch checkpoint --checkpoint runs/state.safetensors
      dextouch checkpoint --checkpoint runs/paper.safetensors --plan
    """

    model_config = service_config("world_model_show", "dextouch checkpoint")

    checkpoint: Path = Field(default=PRETRAINED, description="checkpoint, or folder of checkpoints")
    plan: CliImplicitFlag[bool] = Field(
        default=False,
        description="print memory and FLOPs per action chunk instead, for the paper's form",
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class WorldModelSettings(WorldServiceSettings):
    """Serve the rollouts of a world model over HTTP.

    Example:
      dextouch serve --checkpoint runs/state.safetensors --port 8085
    """

    model_config = service_config("world_model", "dextouch serve")

    checkpoint: Path = Field(
        default_factory=default_checkpoint, description="checkpoint (default: the package's)"
    )
    world_name: str = Field(
        default="world_model", min_length=1, max_length=64, description="name of the served world"
    )
    sampling_steps: int | None = Field(
        default=None, ge=1, le=64, description="network calls per chunk of a flow-matching model"
    )
    sampler: Sampler | None = Field(
        default=None, description="solver of a flow-matching model (default: the checkpoint's)"
    )
    objects: Path | None = Field(
        default=None,
        description="state model that finds the objects for a flow-matching model with contact "
        "geometry (default: the package's)",
    )
    placement: Placement = Field(
        default=Placement(), description="device and precision of a flow-matching model"
    )
    num_threads: int = Field(default=1, ge=1, description="threads of torch")
