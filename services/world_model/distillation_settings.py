"""Settings of few-step distillation, from flags and environment variables."""

from pathlib import Path

from pydantic import Field

from dextouch.command_line import JSON_HELP
from dextouch.serving import CommandSettings, service_config
from services.networks.training_settings import CpuBudget
from services.world_model.network.configuration import NetworkConfig
from services.world_model.settings import (
    AdaptOptimizerSettings,
    OptimizerSettings,
    RunSettings,
    TrainSettings,
)


class DistillSettings(RunSettings):
    """Training of a checkpoint to sample in few steps, on its own contexts and samples.

    The network, its codecs and its normalizers are those of the checkpoint.
    """

    init: Path = Field(description="checkpoint to start from")
    steps: int = Field(default=1, ge=1, le=64, description="network calls per chunk")
    output: Path = Field(
        default=Path("runs/world_model/distilled.safetensors"), description="checkpoint to write"
    )
    name: str = Field(default="distilled", description="model name in the checkpoint")
    cpu_budget_s: CpuBudget = 300.0
    optimizer: AdaptOptimizerSettings = Field(
        default=AdaptOptimizerSettings(), description="settings of the optimizer"
    )

    def training(self, network: NetworkConfig) -> TrainSettings:
        """The same run as training of a network from its checkpoint."""
        given = {name: getattr(self, name) for name in RunSettings.model_fields}
        given |= {"optimizer": OptimizerSettings(**self.optimizer.model_dump())}
        few = network.model_copy(update={"sampling_steps": self.steps, "sampler": "euler"})
        return TrainSettings(**given, init=self.init, network=few, self_forcing=True)


class DistillCommand(CommandSettings, DistillSettings):
    """Train a world model in the paper's form to sample in few steps, by self-forcing.

    Example:
      dextouch train distill --init runs/paper.safetensors --steps 1 --episodes runs/episodes
    """

    model_config = service_config("world_model_distill", "dextouch train distill")

    json_path: Path | None = Field(default=None, alias="json", description=JSON_HELP)
