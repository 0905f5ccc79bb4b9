"""Settings of training and serving, from flags and environment variables."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field
from pydantic_settings import BaseSettings, CliImplicitFlag

from dextouch.command_line import JSON_HELP
from dextouch.serving.settings import service_config
from dextouch.worlds.serve import WorldServiceSettings
from services.world_model.checkpoints import PRETRAINED, default_checkpoint
from services.world_model.network.configuration import NetworkConfig
from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.precision import has_fast_bfloat16
from services.world_model.rendering.training import RendererTraining


class OptimizerSettings(BaseModel):
    """How weights are moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    batch: int = Field(default=8, ge=1, description="examples per training step")
    learning_rate: float = Field(default=2e-3, gt=0, description="largest; it falls along a cosine")
    warmup_steps: int = Field(
        default=100, ge=1, description="steps until the learning rate is reached"
    )
    weight_decay: float = Field(default=0.02, ge=0, description="of AdamW")
    max_gradient_norm: float = Field(
        default=1.0, gt=0, description="longer gradients are shortened to this"
    )
    ema_decay: float = Field(
        default=0.995, ge=0, lt=1, description="of the running average of the weights that is kept"
    )
    tactile_weight: float = Field(default=1.0, ge=0, description="lambda_tac of equation 5")


class WindowSettings(BaseModel):
    """Which windows are trained on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    commanded_fraction: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="of windows with commanded actions, where there are some",
    )
    chained_fraction: float = Field(
        default=0.3, ge=0, le=1, description="of windows that begin with the model's own prediction"
    )
    short_fraction: float = Field(default=0.25, ge=0, le=1, description="of 5, 9, 13 … steps")
    context_noise: float = Field(default=0.05, ge=0, le=1, description="on the first latents")
    fit_windows: int = Field(default=256, ge=4, description="windows the codecs are fitted on")


class TrainSettings(BaseModel):
    """One training run; `cpu_budget_s` or `max_steps` ends it, whichever comes first."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    episodes: str = Field(description="URL or folder of the episode store to train on")
    heldout: str | None = Field(
        default=None, description="store to be judged on; without it a tenth of `episodes`, by hash"
    )
    output: Path = Field(
        default=Path("runs/world_model/tiny.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="tiny", description="of the model, in the checkpoint")
    seed: int = Field(default=0, ge=0, description="of weights and of everything that is drawn")
    cpu_budget_s: float = Field(
        default=1000.0, gt=0, description="CPU seconds after which training ends"
    )
    max_steps: int | None = Field(
        default=None,
        ge=1,
        description="steps after which training ends, if it is not out of time before",
    )
    num_threads: int = Field(default=1, ge=1, description="threads of torch")
    heldout_percent: int = Field(
        default=10,
        ge=1,
        le=50,
        description="of episodes, to measure on, where no --heldout is given",
    )
    evaluation_stride: int = Field(
        default=8, ge=1, description="measure on every n-th window of the held-out episodes"
    )
    streaming: CliImplicitFlag[bool] = Field(
        default=False, description="leave episodes on the disk: for more of them than memory holds"
    )
    loader_workers: int = Field(
        default=0, ge=0, le=64, description="processes that read for --streaming; 0: none besides"
    )
    init: Path | None = Field(
        default=None,
        description="checkpoint whose weights and codecs to start from; same network settings",
    )
    resume: CliImplicitFlag[bool] = Field(
        default=False,
        description="go on with what a run of this output left when it was killed, if anything",
    )
    state_every_cpu_s: float = Field(
        default=60.0, ge=0, description="CPU seconds between states kept for --resume"
    )
    network: NetworkConfig = Field(default=NetworkConfig(), description="shape of the network")
    optimizer: OptimizerSettings = Field(
        default=OptimizerSettings(), description="how weights are moved"
    )
    windows: WindowSettings = Field(
        default=WindowSettings(), description="which windows are trained on"
    )


class ReaderSettings(BaseModel):
    """How start readers are trained."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    num_steps: int = Field(default=4000, ge=1, description="training steps")
    batch: int = Field(default=32, ge=1, description="examples per training step")
    learning_rate: float = Field(default=2e-3, gt=0, description="largest; it falls along a cosine")
    ema_decay: float = Field(
        default=0.995, ge=0, lt=1, description="of the running average of the weights that is kept"
    )
    first_fraction: float = Field(default=0.6, ge=0, le=1, description="of first steps")
    bfloat16: bool = Field(default_factory=has_fast_bfloat16, description="convolve in bfloat16")


class CoreLossWeights(BaseModel):
    """Weights of a core's training targets; 0 leaves one out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    objects: float = Field(default=1.0, ge=0, description="of the positions and axes of objects")
    touch: float = Field(default=6.0, ge=0, description="of the latents of all pressures")
    contact: float = Field(default=0.5, ge=0, description="of which pads touch something")
    taxels: float = Field(default=2.0, ge=0, description="of which taxels touch something")
    success: float = Field(default=1.0, ge=0, description="of whether the task is done at the end")


class CoreSettings(BaseModel):
    """How recurrent cores are trained."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    num_steps: int = Field(default=6500, ge=1, description="training steps")
    batch: int = Field(default=64, ge=1, description="examples per training step")
    learning_rate: float = Field(default=2e-3, gt=0, description="largest; it falls along a cosine")
    weight_decay: float = Field(default=0.05, ge=0, description="of AdamW")
    ema_decay: float = Field(
        default=0.99, ge=0, lt=1, description="of the running average of the weights that is kept"
    )
    first_fraction: float = Field(default=0.6, ge=0, le=1, description="of whole episodes")
    measured_fraction: float = Field(default=0.15, ge=0, le=1, description="of measured actions")
    held_fraction: float = Field(default=0.04, ge=0, le=1, description="of hands held still")
    pose_noise_m: float = Field(default=0.0025, ge=0, description="of the true start poses")
    weights: CoreLossWeights = Field(
        default=CoreLossWeights(), description="weights of the targets"
    )
    bfloat16: bool = Field(default_factory=has_fast_bfloat16, description="train in bfloat16")


class StateTrainSettings(BaseModel):
    """Training of a state model: an ensemble of start readers and recurrent cores."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    episodes: tuple[str, ...] = Field(min_length=1, description="stores: folders or file:// URLs")
    tasks: tuple[str, ...] = Field(default=(), description="only these; default: all there are")
    output: Path = Field(
        default=Path("runs/world_model/state.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="state", description="of the model, in the checkpoint")
    seed: int = Field(default=0, ge=0, description="of weights and of everything that is drawn")
    num_members: int = Field(default=2, ge=1, le=16, description="of the ensemble")
    heldout_share: float = Field(default=0.08, gt=0, lt=1, description="of scenes, to measure on")
    jobs: int = Field(default=2, ge=1, le=64, description="members trained at the same time")
    labelled_share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="of scenes whose object poses are learned from; touch and success: from all",
    )
    width: int = Field(default=192, ge=8, le=1024, description="of the recurrent cores")
    reader: ReaderSettings = Field(
        default=ReaderSettings(), description="how start readers are trained"
    )
    core: CoreSettings = Field(
        default=CoreSettings(), description="how recurrent cores are trained"
    )
    renderer: RendererConfig = Field(default=RendererConfig(), description="shape of the renderer")
    drawing: RendererTraining = Field(
        default=RendererTraining(cpu_budget_s=1400.0), description="how the renderer is trained"
    )


class TrainStateCommand(BaseSettings, StateTrainSettings):
    """Train a state model, start readers and recurrent cores, on whole episodes.

    Example:
      dextouch train state --episodes runs/episodes --output runs/state.safetensors
    """

    model_config = service_config("world_model_train_state", "dextouch train state")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class TrainCommand(BaseSettings, TrainSettings):
    """Train the joint visuo-tactile flow-matching model on windows of episodes.

    Example:
      dextouch train world-model --episodes runs/episodes --output runs/tiny.safetensors
    """

    model_config = service_config("world_model_train", "dextouch train world-model")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class ShowCommand(BaseSettings):
    """Show where a world model's checkpoint, or every one in a folder, comes from.

    Example:
      dextouch checkpoint --checkpoint runs/state.safetensors
    """

    model_config = service_config("world_model_show", "dextouch checkpoint")

    checkpoint: Path = Field(default=PRETRAINED, description="file, or folder of files")
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)


class WorldModelSettings(WorldServiceSettings):
    """Serve the rollouts of a world model over HTTP.

    Example:
      dextouch serve --checkpoint runs/state.safetensors --port 8085
    """

    model_config = service_config("world_model", "dextouch serve")

    checkpoint: Path = Field(
        default_factory=default_checkpoint, description="of either form (default: the package's)"
    )
    world_name: str = Field(
        default="world_model", min_length=1, max_length=64, description="what clients call it"
    )
    sampling_steps: int | None = Field(
        default=None, ge=1, le=64, description="Euler steps of the paper's form"
    )
    num_threads: int = Field(default=1, ge=1, description="threads of torch")


def command_line(settings: TrainSettings) -> str:
    """The command that repeats a run: every setting that is not the default.

    Stores go by their last name: checkpoints travel, folders do not.
    """
    given = settings.model_dump(
        mode="json",
        exclude_defaults=True,
        exclude={
            "output",
            "json_path",
            "episodes",
            "heldout",
            "init",
            "resume",
            "state_every_cpu_s",
        },
    )
    flags = [f"--episodes={_last_name(settings.episodes)}"]
    if settings.heldout is not None:
        flags.append(f"--heldout={_last_name(settings.heldout)}")
    if settings.init is not None:
        flags.append(f"--init={settings.init.name}")
    for name, value in given.items():
        if isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--no-{name}")
            continue
        fields = value.items() if isinstance(value, dict) else [("", value)]
        flags += [f"--{name}{'.' if field else ''}{field}={number}" for field, number in fields]
    return " ".join(["python -m services.world_model train", *flags])


def _last_name(url: str) -> str:
    return url.rstrip("/").rsplit("/", 1)[-1]
