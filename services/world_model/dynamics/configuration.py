"""Configuration of start readers and recurrent cores; stored in every checkpoint of them."""

from typing import Final

from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import MAX_OBJECTS, Domain

# Largest number of objects of a task; unused slots are masked.
# What models of older releases know.
_ROBOT_ALONE: Final[tuple[Domain, ...]] = ("robot",)
# The core runs once every four steps of the model grid, the rate of video latents.
STEPS_PER_LATENT: Final = 4


class DynamicsConfig(FrozenModel):
    """Architecture of a dynamics model.

    `tasks` and `num_objects` form its vocabulary: a task's index selects its embedding, and its
    objects fill the first slots in the order of the episode's `object_names`. With the domain
    `human`, cores are given whose hands act, and predict the touch of either by heads of its own.
    """

    tasks: tuple[str, ...] = Field(min_length=1)
    num_objects: tuple[int, ...]
    image_px: int = Field(default=64, ge=16, le=256)
    reader_channels: int = Field(default=32, ge=8, le=256)
    reader_keypoints: int = Field(default=40, ge=4, le=256)
    width: int = Field(default=192, ge=8, le=1024)
    touch_channels: int = Field(default=96, ge=4, le=320)
    domains: tuple[Domain, ...] = Field(
        default=_ROBOT_ALONE, exclude_if=lambda domains: domains == _ROBOT_ALONE
    )

    @property
    def has_humans(self) -> bool:
        """Whether cores tell people from robots."""
        return "human" in self.domains

    @model_validator(mode="after")
    def _objects_fit(self) -> "DynamicsConfig":
        if len(self.num_objects) != len(self.tasks) or len(set(self.tasks)) != len(self.tasks):
            raise ValueError(
                f"got {len(self.tasks)} tasks and {len(self.num_objects)} numbers of objects, "
                "expected one number for every task and no task twice"
            )
        if any(not 1 <= count <= MAX_OBJECTS for count in self.num_objects):
            raise ValueError(
                f"num_objects: got {self.num_objects}, expected 1 … {MAX_OBJECTS} for every task"
            )
        return self
