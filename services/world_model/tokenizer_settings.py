"""Settings of tactile tokenizer training, from flags and environment variables."""

from pathlib import Path

from pydantic import Field

from dextouch.command_line import JSON_HELP
from dextouch.frozen_model import FrozenModel
from dextouch.serving import CommandSettings, service_config
from services.networks.training_settings import (
    AverageDecay,
    Batch,
    CpuBudget,
    LearningRate,
    MaxGradientNorm,
    MaxSteps,
    Seed,
    Splits,
    Stores,
    WarmupSteps,
    WeightDecay,
)
from services.world_model.network.configuration import NetworkConfig, TokenizerName
from services.world_model.recorded_commands import flags_of, last_name


class TokenizerOptimizer(FrozenModel):
    """Settings of the optimizer."""

    batch: Batch = 128
    learning_rate: LearningRate = 6e-3
    warmup_steps: WarmupSteps = 50
    weight_decay: WeightDecay = 0.0
    max_gradient_norm: MaxGradientNorm = 1.0
    ema_decay: AverageDecay = 0.99


class TrainTokenizerSettings(FrozenModel):
    """One training run; `cpu_budget_s` or `max_steps` ends it, whichever comes first."""

    episodes: Stores
    splits: Splits = ()
    tokenizer: TokenizerName = Field(
        default="split_hands",
        description="split_hands (the paper's), grid (its baseline), or principal_axes, which is "
        "fitted without steps",
    )
    output: Path = Field(
        default=Path("runs/world_model/tokenizer.safetensors"), description="file to write"
    )
    seed: Seed = 0
    cpu_budget_s: CpuBudget = 60.0
    max_steps: MaxSteps = None
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
        default=192,
        ge=6,
        le=1920,
        multiple_of=6,
        description="latents per hand of split_hands and grid",
    )
    optimizer: TokenizerOptimizer = Field(
        default=TokenizerOptimizer(), description="settings of the optimizer"
    )

    def network(self) -> NetworkConfig:
        """Network configuration with this tokenizer and one token per hand."""
        return NetworkConfig(
            tokenizer=self.tokenizer,
            palm_channels=self.palm_channels,
            tactile_channels=self.tactile_channels,
        )

    def command(self) -> str:
        """Command that repeats the run: every setting that differs from its default."""
        given = self.model_dump(
            mode="json", exclude_defaults=True, include=set(TrainTokenizerSettings.model_fields)
        )
        stores = [f"--episodes={last_name(url)}" for url in given.pop("episodes")]
        given.pop("output", None)
        return " ".join(["dextouch train tokenizer", *stores, *flags_of(given)])


class TrainTokenizerCommand(CommandSettings, TrainTokenizerSettings):
    """Train a tactile tokenizer on the touch of people and robots, for `--tokenizer`.

    Example:
      dextouch train tokenizer --episodes runs/episodes --output runs/split_hands.safetensors
    """

    model_config = service_config("world_model_train_tokenizer", "dextouch train tokenizer")

    picture: Path | None = Field(
        default=None, description="SVG to draw: held-out error and Contact-IoU over training steps"
    )
    beside: tuple[Path, ...] = Field(
        default=(), description="files of other tokenizers to draw in the picture, too"
    )
    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
