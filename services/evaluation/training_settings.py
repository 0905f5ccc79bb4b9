"""Settings of the trainings of policies and judges; imports no torch, so that they can be shown."""

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.networks.training_settings import (
    Batch,
    Brightness,
    CpuBudget,
    ImageNoise,
    LearningRate,
    NumSteps,
    Seed,
    WeightDecay,
)


class CloningSettings(FrozenModel):
    """Training settings of behaviour cloning."""

    seed: Seed = 0
    num_training_steps: NumSteps = 3000
    max_cpu_s: CpuBudget = 240.0
    batch_size: Batch = 72
    learning_rate: LearningRate = 1.5e-3
    weight_decay: WeightDecay = 1e-3
    image_noise: ImageNoise = 0.02
    brightness: Brightness = 0.06
    pose_noise: float = Field(default=0.2, ge=0, description="pose noise, relative to the spread")
    held_out_share: float = Field(default=0.12, gt=0, lt=1, description="share of held-out seeds")


class ClassifierSettings(FrozenModel):
    """Training settings of a success classifier."""

    seed: Seed = 0
    # For each task.
    num_training_steps: NumSteps = 2000
    max_cpu_s: CpuBudget = 200.0
    batch_size: Batch = Field(default=48, ge=2)
    learning_rate: LearningRate = 1.5e-3
    weight_decay: WeightDecay = 5e-2
    image_noise: ImageNoise = 0.02
    brightness: Brightness = 0.05
    # At 64 pixels, one pixel is about 10 mm on the table, the scale that decides success.
    shift_px: int = Field(default=1, ge=0, description="largest shift of training images")
    # Shares of true endings with both inputs that lose their poses, or their image: real endings
    # come without poses, and with poses the network would ignore the image.
    true_without_poses: float = Field(
        default=0.85,
        ge=0,
        le=1,
        description="share of true endings with object poses dropped",
    )
    true_without_images: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="share of true endings with images dropped",
    )
    # The same for imagined endings: worlds always predict poses, but render images on request.
    imagined_without_poses: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of imagined endings with object poses dropped",
    )
    imagined_without_images: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of imagined endings with images dropped",
    )
    pose_noise: float = Field(
        default=0.03,
        ge=0,
        description="noise on object poses, in standard deviations of each feature",
    )
    imagined_share: float = Field(
        default=0.4, gt=0, lt=1, description="weight of imagined endings relative to true ones"
    )
    milestone_weight: float = Field(
        default=0.3, ge=0, description="weight of the milestones in the loss"
    )
    development_share: float = Field(
        default=0.15, gt=0, lt=1, description="share of seeds to calibrate on"
    )
    held_out_share: float = Field(default=0.2, gt=0, lt=1, description="share of held-out seeds")
    risk: float = Field(
        default=0.05, gt=0, lt=1, description="allowed share of errors among decided endings"
    )
    imagined_risk: float = Field(
        default=0.05,
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
