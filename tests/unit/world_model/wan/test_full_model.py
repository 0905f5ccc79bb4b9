"""The joint model with the pretrained video side: built, loaded, stored and read."""

from dataclasses import replace

import pytest
import torch

from dextouch.errors import InvalidInputError, LimitExceededError
from services.networks.weight_files import write_weights
from services.world_model import checkpoints
from services.world_model.checkpoints import METADATA_KEY, read_checkpoint, write_checkpoint
from services.world_model.network.configuration import NetworkConfig, WanConfig
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import JointWorldModel
from services.world_model.pretrained_video import load_pretrained
from services.world_model.training.joint_dataset import WindowPosition
from tests.unit.world_model.test_clean_tokens import assert_kept_tokens_change_nothing


@pytest.fixture
def model(full_config, pretrained_folder):
    torch.manual_seed(0)
    model = JointWorldModel(full_config).eval()
    load_pretrained(model, pretrained_folder)
    return model


def _pretrained(model):
    """Pretrained tensors of the model under the names of the libraries."""
    parts = {
        "video.": "",
        "video_condition.embedder.": "condition_embedder.",
        "codec.autoencoder.": "vae.",
        **{f"layers.{n}.video.block.": f"blocks.{n}." for n in range(len(model.layers))},
    }
    return {
        new + name.removeprefix(old): tensor
        for name, tensor in model.state_dict().items()
        for old, new in parts.items()
        if name.startswith(old)
    }


@pytest.mark.long
def test_every_pretrained_tensor_reaches_the_model(model, transformer, autoencoder):
    loaded = _pretrained(model)
    expected = transformer.state_dict()
    expected |= {f"vae.{name}": tensor for name, tensor in autoencoder.state_dict().items()}
    assert loaded.keys() == expected.keys()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in expected.items())
    assert not any(tensor.is_meta for tensor in model.state_dict().values())


def test_the_autoencoder_is_frozen_and_the_transformer_is_not(model):
    assert not any(p.requires_grad for p in model.codec.parameters())
    assert all(p.requires_grad for p in model.video.parameters())
    assert all(p.requires_grad for p in model.layers.parameters())


def test_a_file_of_the_full_size_is_refused_without_memory(
    tmp_path, full_config, metadata, monkeypatch
):
    path = tmp_path / "full.safetensors"
    full = metadata.model_copy(update={"network": full_config})
    write_weights(path, {"one": torch.ones(1)}, full, METADATA_KEY)
    monkeypatch.setattr(checkpoints, "available_memory", lambda: 0)
    with pytest.raises(LimitExceededError):
        read_checkpoint(path)


@pytest.mark.long
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_checkpoint_holds_every_bit_and_the_text_features(
    tmp_path, full_config, pretrained_folder, precision, metadata
):
    wan = full_config.wan.model_copy(update={"precision": precision})
    config = full_config.model_copy(update={"wan": wan})
    model = JointWorldModel(config).eval()
    load_pretrained(model, pretrained_folder)
    features = model.text_features.of("push the box")
    path = tmp_path / "full.safetensors"
    digest = write_checkpoint(path, model, metadata.model_copy(update={"network": config}))
    read = read_checkpoint(path)
    assert read.digest == digest
    there = read.model.state_dict()
    assert {n: t.dtype for n, t in there.items()} == {
        n: t.dtype for n, t in model.state_dict().items()
    }
    assert all(torch.equal(there[n], t) for n, t in model.state_dict().items())
    assert torch.equal(read.model.text_features.of("push the box"), features)
    with pytest.raises(LimitExceededError):
        read_checkpoint(path, max_bytes=1000)


def test_the_small_model_has_no_pretrained_parts(tmp_path, tiny_model):
    assert tiny_model.text_features is None
    with pytest.raises(InvalidInputError, match="expected wan"):
        load_pretrained(tiny_model, tmp_path)


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"wan": None}, "wan: got none"),
        ({"video_expert": "tiny"}, "wan: got sizes"),
        ({"patch_px": 8}, "patch_px.*16"),
        ({"video_width": 96}, "video_width.*24"),
        ({"use_pose_raster": True}, "use_pose_raster"),
    ],
)
def test_sizes_that_contradict_each_other_are_refused(full_config, other, named):
    with pytest.raises(ValueError, match=named):
        NetworkConfig.model_validate(full_config.model_dump() | other)


def test_the_full_size_has_its_weights_and_a_light_tactile_expert():
    model = _full_size()
    pretrained = {n: t for n, t in _pretrained(model).items() if not n.startswith("vae.")}
    assert len(pretrained) == 825
    assert sum(tensor.numel() for tensor in pretrained.values()) == 4_999_787_712
    # Per layer 512 to 3 x 3072 and back, 512 to 2048 and back, with biases, norms and modulation.
    layer = 513 * 9216 + 3073 * 512 + 513 * 2048 + 2049 * 512 + 2 * 128 + 6 * 512
    tactile = sum(p.numel() for block in model.layers for p in block.tactile.parameters())
    assert tactile == 30 * layer == 252_126_720


def _full_size():
    config = NetworkConfig(
        video_expert="wan", wan=WanConfig(), image_px=256, patch_px=16, codec_channels=48,
        video_width=3072, num_heads=24, head_width=128, num_layers=30, tactile_width=512,
        ffn_ratio=4, use_pose_raster=False, prediction="velocity", video_target="plain",
    )  # fmt: skip
    with torch.device("meta"):
        return JointWorldModel(config)


@pytest.mark.long
def test_kept_clean_tokens_change_nothing(model, toy_episodes):
    with torch.no_grad():
        for weight in model.parameters():
            if weight.abs().max() == 0:
                weight.normal_(0.0, 0.1)
    larger = [replace(e, images=e.images.repeat(2, 1).repeat(2, 2)) for e in toy_episodes[:2]]
    requests = [episode.cut(WindowPosition(0, 0, 17)).request for episode in larger]
    assert_kept_tokens_change_nothing(
        model.requires_grad_(requires_grad=False), build_inputs(requests, model.config)
    )
