"""Device and precision in which a flow-matching model is served."""

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.networks.training_settings import Device
from services.world_model.network.configuration import Precision
from services.world_model.wan.configuration import WanFiles


class Placement(FrozenModel):
    """Where a flow-matching model computes, and in which precision."""

    device: Device = "cpu"
    precision: Precision = Field(
        default="float32", description="of the experts' weights; codecs and norms keep theirs"
    )
    text: WanFiles = Field(
        default=WanFiles(),
        description="files of the text encoder, for instructions that a checkpoint does not know",
    )
    max_file_gb: float | None = Field(
        default=None,
        gt=0,
        description="largest checkpoint; default: 64 MiB, for the full size the available memory",
    )
