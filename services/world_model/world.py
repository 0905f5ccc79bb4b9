"""Opens the world of a checkpoint, of the joint model or of a state model."""

from pathlib import Path

import torch

from dextouch.errors import InvalidInputError
from services.networks.weight_files import on_device
from services.world_model import checkpoints
from services.world_model.devices import claimed_device
from services.world_model.joint_world import JointWorld
from services.world_model.network.codecs import WanVideoCodec
from services.world_model.network.model import Sampling
from services.world_model.predicted_world import SceneReader
from services.world_model.settings import Placement
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld


def open_world(
    path: Path | None = None,
    *,
    sampling: Sampling = Sampling(),  # noqa: B008 - immutable
    needs_touch: bool = True,
    objects: Path | None = None,
    placement: Placement = Placement(),  # noqa: B008 - immutable
) -> JointWorld | StateWorld:
    """Open the world of a checkpoint file of either kind; default: the package's own.

    `objects` is the state model that reads objects for contact geometry; `sampling` and `placement`
    are of flow-matching models. With `needs_touch`, models that do not predict touch are refused.

    Raises:
        InvalidInputError: options of sampling for a state model, guidance for a model that was
            trained without dropout, or no touch where it is needed.
    """
    file = path if path is not None else default_checkpoint()
    if not checkpoints.is_state_checkpoint(file):
        checkpoint = _placed(file, placement)
        if needs_touch and not checkpoint.metadata.network.use_touch:
            raise InvalidInputError(
                f"world model {file.name}: got one that predicts images alone, expected touch, "
                "too; only `dextouch evaluate prediction` accepts it"
            )
        reader = None
        if checkpoint.metadata.network.use_contact_geometry:
            reader = SceneReader(checkpoints.read_state_checkpoint(objects or default_checkpoint()))
        if sampling.guidance != 1.0:
            _check_guidance(checkpoint, sampling.guidance, file)
        return JointWorld(checkpoint, sampling=sampling, reader=reader)
    if sampling != Sampling():
        raise InvalidInputError(
            f"state model {file.name}: got {sampling}, expected none: it predicts without sampling"
        )
    return StateWorld(checkpoints.read_state_checkpoint(file))


def _check_guidance(checkpoint: checkpoints.Checkpoint, guidance: float, file: Path) -> None:
    """Raise unless the model can predict without instruction and actions."""
    metadata, texts = checkpoint.metadata, checkpoint.model.text_features
    if not metadata.is_guidable:
        raise InvalidInputError(
            f"world model {file.name}: got a guidance of {guidance:g}, expected 1: it was trained "
            f"without instruction in {metadata.text_dropout:.0%} of windows and without actions in "
            f"{metadata.action_dropout:.0%}; train with both --windows.text-dropout and "
            "--windows.action-dropout"
        )
    if texts is not None:
        # Predictions without instruction need its features.
        texts.of("")


def _placed(file: Path, placement: Placement) -> checkpoints.Checkpoint:
    """The checkpoint on its device and in its precision."""
    limit = placement.max_file_gb
    checkpoint = checkpoints.read_checkpoint(
        file, max_bytes=None if limit is None else int(limit * 1e9)
    )
    model = checkpoint.model
    if placement.precision == "bfloat16":
        model.to(torch.bfloat16)
    on_device(model, claimed_device(placement.device))
    if isinstance(model.codec, WanVideoCodec):
        model.codec.window, model.codec.tile_px = placement.decode_window, placement.decode_tile_px
    elif placement.decode_window or placement.decode_tile_px:
        raise InvalidInputError(
            f"world model {file.name}: got options of decoding (--placement.decode-window, "
            "--placement.decode-tile-px), expected none: only the full size has them"
        )
    if model.text_features is not None:
        model.text_features.use(placement.text.folder, placement.text.text_cache)
    if placement.kept_contexts:
        model.keep_contexts(placement.kept_contexts)
    return checkpoint
