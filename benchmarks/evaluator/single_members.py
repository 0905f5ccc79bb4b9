"""Members of a world model's ensemble as models of their own, each of one training seed."""

from pathlib import Path

from services.world_model.checkpoints import read_state_checkpoint, write_state_checkpoint
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.shipped_checkpoints import default_checkpoint


def write_single_members(world: Path | None, folder: Path) -> list[Path]:
    """Write a checkpoint of every member of a state model's ensemble (None: the package's own).

    Raises:
        CorruptDataError: not a state model.
    """
    whole = read_state_checkpoint(world or default_checkpoint())
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for member in range(whole.metadata.num_members):
        name = f"{whole.metadata.name}, member {member} alone"
        metadata = whole.metadata.model_copy(update={"num_members": 1, "name": name})
        paths.append(folder / f"{whole.digest[:12]}_member_{member}.safetensors")
        alone = single_member(whole.dynamics, member)
        write_state_checkpoint(paths[-1], alone, whole.renderer, metadata)
    return paths


def single_member(ensemble: DynamicsModel, member: int) -> DynamicsModel:
    """A dynamics model of one member's start reader and core, and the shared touch codec."""
    alone = DynamicsModel(ensemble.config).eval()
    alone.codec.load_state_dict(ensemble.codec.state_dict())
    alone.readers()[0].load_state_dict(ensemble.readers()[member].state_dict())
    weights = {
        name: tensor[member : member + 1].clone()
        for name, tensor in ensemble.core.named_parameters()
    }
    alone.core.load_state_dict(weights | dict(ensemble.core.named_buffers()))
    return alone
