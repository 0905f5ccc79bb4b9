"""Training settings: the bounds and the command-line help that all networks share."""

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from dextouch.episodes import Split
from dextouch.frozen_model import FrozenModel

if TYPE_CHECKING:
    from services.networks.optimizer import OptimizerOptions

Seed = Annotated[int, Field(description="seed of weights and sampling")]
NumSteps = Annotated[int, Field(ge=1, description="training steps")]
MaxSteps = Annotated[
    int | None,
    Field(ge=1, description="steps after which training ends, unless the CPU budget ends it"),
]
CpuBudget = Annotated[float, Field(gt=0, description="CPU seconds after which training ends")]
Batch = Annotated[int, Field(ge=1, description="examples per training step")]
Share = Annotated[float, Field(ge=0, le=1)]
NonNegative = Annotated[float, Field(ge=0)]
LearningRate = Annotated[float, Field(gt=0, description="peak of the cosine schedule")]
WarmupSteps = Annotated[int, Field(ge=1, description="warm-up steps of the learning rate")]
WeightDecay = Annotated[float, Field(ge=0, description="AdamW weight decay")]
MaxGradientNorm = Annotated[float, Field(gt=0, description="norm that gradients are clipped to")]
AverageDecay = Annotated[float, Field(ge=0, lt=1, description="decay of the averaged weights")]
# Side of the images that networks see, unless it is chosen otherwise.
USUAL_IMAGE_PX = 64
ImagePx = Annotated[
    int,
    Field(
        ge=16,
        le=256,
        multiple_of=8,
        description="side that the middle square of larger images is scaled to; the same for world "
        "model, judge and policies",
    ),
]
Device = Annotated[str, Field(description="device of the weights, such as cpu or cuda")]
Stores = Annotated[
    tuple[str, ...], Field(min_length=1, description="stores (folder or file:// URL)")
]
Tasks = Annotated[tuple[str, ...], Field(description="tasks to train on; default: all")]
Splits = Annotated[
    tuple[Split, ...],
    Field(description="A, B or C: thirds of all scenes to train on; default: all scenes"),
]


class BudgetSettings(FrozenModel):
    """Limits of a training run; whichever comes first ends it."""

    cpu_budget_s: CpuBudget
    max_steps: MaxSteps = None


class AdamWSettings(FrozenModel):
    """Settings of AdamW, of its cosine schedule, and of the average of the weights."""

    batch: Batch = 8
    learning_rate: LearningRate = 2e-3
    warmup_steps: WarmupSteps = 100
    weight_decay: WeightDecay = 0.02
    max_gradient_norm: MaxGradientNorm = 1.0
    ema_decay: AverageDecay = 0.995

    def options(self) -> "OptimizerOptions":
        """Options of the optimizer loop."""
        # Settings can be read and shown without torch.
        from services.networks.optimizer import OptimizerOptions, floored_cosine

        return OptimizerOptions(
            learning_rate=self.learning_rate,
            weight_decay=self.weight_decay,
            max_gradient_norm=self.max_gradient_norm,
            warmup_steps=self.warmup_steps,
            schedule=floored_cosine,
            betas=(0.9, 0.95),
        )


class TrainingSettings(FrozenModel):
    """What the training of a small network is given."""

    seed: Seed = 0
    num_training_steps: NumSteps
    max_cpu_s: CpuBudget
    batch_size: Batch
    learning_rate: LearningRate
    weight_decay: WeightDecay
