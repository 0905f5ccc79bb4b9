"""Settings of the state model and of serving, from flags and environment variables."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from pydantic_settings import CliImplicitFlag

from dextouch.command_line import JSON_HELP
from dextouch.frozen_model import FrozenModel
from dextouch.serving import CommandSettings, service_config
from dextouch.worlds import WorldServiceSettings
from services.networks.training_settings import (
    USUAL_IMAGE_PX,
    AdamWSettings,
    AverageDecay,
    Batch,
    BudgetSettings,
    CpuBudget,
    ImagePx,
    LearningRate,
    NonNegative,
    NumSteps,
    Share,
    Splits,
    Stores,
    Tasks,
    WarmupSteps,
    WeightDecay,
)
from services.world_model.network.configuration import (
    SPATIAL_FACTOR,
    Precision,
    RendererConfig,
    Sampler,
    WanFiles,
)
from services.world_model.presets import PRESETS
from services.world_model.shipped_checkpoints import PRETRAINED, default_checkpoint

Output = Annotated[Path, Field(description="checkpoint to write")]
DisjointTasks = Annotated[
    CliImplicitFlag[bool], Field(description="refuse human episodes of tasks that robots have, too")
]
NewTasks = Annotated[
    CliImplicitFlag[bool],
    Field(description="refuse tasks that the initial checkpoint was trained on"),
]


class DataSettings(FrozenModel):
    """Episodes of people and robots that a world model of either form is trained on.

    With `human` stores, `episodes` and `heldout` give robot episodes alone.
    """

    human: tuple[str, ...] = Field(
        default=(), description="stores (folder or file:// URL) with human episodes to mix in"
    )
    human_share: Share = Field(default=0.5, description="share of examples from human episodes")
    robot_episodes: int | None = Field(
        default=None, ge=1, description="number of `episodes` to train on; more contain fewer"
    )
    human_episodes: int | None = Field(
        default=None, ge=0, description="number of human episodes, in the same way"
    )
    disjoint_tasks: DisjointTasks = True
    new_tasks: NewTasks = False
    splits: Splits = ()
    heldout: str | None = Field(
        default=None, description="store to evaluate on; default: a share of `episodes`, by hash"
    )

    @property
    def share_of_human(self) -> float | None:
        """Share of examples from human episodes; None where domains are not told apart."""
        return self.human_share if self.human else None


class AdaptationSettings(FrozenModel):
    """What adaptations of either form to new tasks have in common."""

    output: Output = Path("runs/world_model/adapted.safetensors")
    name: str = Field(default="adapted", description="model name in the checkpoint")
    disjoint_tasks: DisjointTasks = False
    new_tasks: NewTasks = True


class ReaderSettings(FrozenModel):
    """Training of start readers."""

    num_steps: NumSteps = 5000
    batch: Batch = 32
    learning_rate: LearningRate = 2e-3
    ema_decay: AverageDecay = 0.995
    first_fraction: Share = Field(default=0.6, description="share of first steps")
    bfloat16: bool | None = Field(
        default=None, description="convolve in bfloat16; default: if that is faster here"
    )


class CoreLossWeights(FrozenModel):
    """Weights of a core's training targets; 0 disables one."""

    objects: NonNegative = Field(default=1.0, description="weight of object positions and axes")
    touch: NonNegative = Field(default=6.0, description="weight of touch latents")
    contact: NonNegative = Field(default=0.5, description="weight of pad contact")
    taxels: NonNegative = Field(default=2.0, description="weight of taxel contact")
    success: NonNegative = Field(default=1.0, description="weight of final task success")


class CoreSettings(FrozenModel):
    """Training of recurrent cores."""

    num_steps: NumSteps = 3500
    batch: Batch = 64
    learning_rate: LearningRate = 2e-3
    weight_decay: WeightDecay = 0.05
    ema_decay: AverageDecay = 0.99
    first_fraction: Share = Field(default=0.6, description="share of whole episodes")
    held_fraction: Share = Field(
        default=0.04, description="share of examples with hands held still"
    )
    pose_noise_m: NonNegative = Field(
        default=0.012, description="largest noise on true start poses"
    )
    weights: CoreLossWeights = Field(default=CoreLossWeights(), description="weights of targets")


class RendererTraining(AdamWSettings, BudgetSettings):
    """One training run of the renderer."""

    cpu_budget_s: CpuBudget = 400.0
    batch: Batch = 24
    warmup_steps: WarmupSteps = 50
    weight_decay: WeightDecay = 0.01
    gradient_weight: NonNegative = Field(default=0.5, description="image gradient loss")
    sharpness_weight: NonNegative = Field(
        default=0.3, description="edge strength loss (7 px windows)"
    )
    shaken_fraction: Share = Field(default=0.5, description="share of pairs with pose noise")
    shake_m: NonNegative = Field(default=0.003, description="position noise per axis")
    uses_bfloat16: bool = Field(default=True, description="convolve in bfloat16 if that is faster")


# What is trained of an initial state model: all but its codec; readers and the estimate of success;
# or that estimate alone.
Learned = Literal["all", "readers", "success"]


class StateTrainSettings(DataSettings):
    """Training of a state model: an ensemble of start readers and recurrent cores."""

    episodes: Stores
    tasks: Tasks = ()
    clicks: Path | None = Field(
        default=None,
        description="JSON file of objects: how hands touch them, and clicks (docs/objects.md)",
    )
    output: Output = Path("runs/world_model/state.safetensors")
    name: str = Field(default="state", description="model name in the checkpoint")
    init: Path | None = Field(
        default=None, description="state model to start from; --learn says what is trained of it"
    )
    learn: Learned = Field(
        default="all",
        description="of --init: all but its touch codec; start readers and the estimate of "
        "success, for new tasks from few takes; or that estimate alone",
    )
    seed: int = Field(default=0, ge=0, description="seed of weights and sampling")
    num_members: int = Field(
        default=3,
        ge=1,
        le=16,
        description="members of the ensemble; with --init, by default as many as that has",
    )
    heldout_share: float = Field(
        default=0.08, gt=0, lt=1, description="share of held-out scenes, if no --heldout is given"
    )
    jobs: int = Field(default=2, ge=1, le=64, description="members trained in parallel")
    image_px: ImagePx = USUAL_IMAGE_PX
    labelled_share: float = Field(
        default=1.0, gt=0, le=1, description="share of scenes that train object poses"
    )
    width: int = Field(default=192, ge=8, le=1024, description="width of the recurrent cores")
    reader: ReaderSettings = Field(default=ReaderSettings(), description="training of readers")
    core: CoreSettings = Field(default=CoreSettings(), description="training of recurrent cores")
    renderer: RendererConfig = Field(default=RendererConfig(), description="shape of the renderer")
    drawing: RendererTraining = Field(default=RendererTraining(), description="its training")


class AdaptReaderSettings(ReaderSettings):
    """Training of start readers from those of another model."""

    num_steps: NumSteps = 2000


class AdaptCoreSettings(CoreSettings):
    """Training of recurrent cores from those of another model."""

    num_steps: NumSteps = 1500
    learning_rate: LearningRate = 1e-3


class StateAdaptSettings(AdaptationSettings, StateTrainSettings):
    """Adaptation of a state model to new tasks, from robot and human episodes.

    Its touch codec is kept, all else is trained on; human and robot episodes may be of the same
    tasks, but not of those that the model was trained on.
    """

    init: Path = Field(description="checkpoint to adapt")
    reader: AdaptReaderSettings = Field(default=AdaptReaderSettings(), description="of readers")
    core: AdaptCoreSettings = Field(default=AdaptCoreSettings(), description="of recurrent cores")


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


class Placement(FrozenModel):
    """Where a flow-matching model computes, and in which precision."""

    device: str = Field(
        default="cpu",
        description="device of the weights, such as cpu or cuda; several, as in cuda:0,cuda:1, are "
        "shared out to --workers",
    )
    precision: Precision = Field(
        default="float32", description="of the experts' weights; codecs and norms keep theirs"
    )
    text: WanFiles = Field(
        default=WanFiles(),
        description="text encoder, for instructions that are not in a checkpoint",
    )
    max_file_gb: float | None = Field(
        default=None,
        gt=0,
        description="largest checkpoint; default: 64 MiB beyond its network, or memory",
    )
    decode_window: int | None = Field(
        default=None,
        ge=2,
        description="at full size, latents that an image is decoded from; default: all, exactly",
    )
    decode_tile_px: int | None = Field(
        default=None,
        ge=64,
        multiple_of=SPATIAL_FACTOR,
        description="at full size, side of the tiles that images are decoded in; default: whole",
    )
    kept_contexts: int = Field(
        default=4,
        ge=0,
        le=1024,
        description="instructions and observed steps whose keys and values later chunks use, too",
    )


class ShowCommand(CommandSettings):
    """Show the provenance and accuracy of a checkpoint, or of every checkpoint in a folder.

    Example:
      dextouch checkpoint --checkpoint runs/state.safetensors
      dextouch checkpoint --checkpoint runs/paper.safetensors --plan
    """

    model_config = service_config("world_model_show", "dextouch checkpoint")

    checkpoint: Path = Field(default=PRETRAINED, description="checkpoint, or folder of checkpoints")
    plan: CliImplicitFlag[bool] = Field(
        default=False, description="print memory and FLOPs instead, for the paper's form"
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
    guidance: float = Field(
        default=1.0,
        ge=0,
        le=100,
        description="scale of classifier-free guidance of a flow-matching model trained with "
        "--windows.text-dropout and --windows.action-dropout; 1: none",
    )
    objects: Path | None = Field(
        default=None,
        description="state model whose readers find objects for contact geometry (default: ours)",
    )
    placement: Placement = Field(
        default=Placement(), description="device and precision of a flow-matching model"
    )
    num_threads: int = Field(default=1, ge=1, description="threads of torch")


def recorded_command(
    settings: FrozenModel, command: str, places: Sequence[str], left_out: set[str]
) -> str:
    """Command that repeats a run, with `places` by their last path components alone."""

    def last_name(url: str) -> str:
        return url.rstrip("/").rsplit("/", 1)[-1]

    given = settings.model_dump(mode="json", exclude_defaults=True, exclude=left_out)
    known = {name: given.pop(name) for name in places if name in given}
    return f"{command} {shlex.join([*flags_of(known, last_name), *flags_of(given)])}".rstrip()


def flags_of(
    given: Mapping[str, object], shown: Callable[[str], str] = str, prefix: str = ""
) -> list[str]:
    """Flags of a command for these settings; names of nested ones are joined by dots."""
    flags: list[str] = []
    for name, value in given.items():
        flag = prefix + name.replace("_", "-")
        if isinstance(value, Mapping):
            flags += flags_of(value, shown, f"{flag}.")
        elif isinstance(value, bool):
            flags.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            values = value if isinstance(value, list) else [value]
            flags += [f"--{flag}={shown(str(one))}" for one in values]
    return flags
