"""Loading pretrained weights from local folders."""

import json

import pytest
import torch
from safetensors.torch import save_file

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
)
from services.networks.weight_files import memory_of
from services.world_model import pretrained_video
from services.world_model.network.codecs import empty_autoencoder
from services.world_model.network.configuration import NetworkConfig, WanConfig
from services.world_model.network.video import empty_transformer
from services.world_model.pretrained_video import load_weights

STEM = "diffusion_pytorch_model"


TINY = {"num_layers": 2, "num_heads": 2, "head_width": 12}


@pytest.fixture
def empty(wan_config):
    return empty_transformer(NetworkConfig(**TINY), wan_config)


def _store(folder, network):
    folder.mkdir(exist_ok=True)
    save_file(network.state_dict(), folder / f"{STEM}.safetensors")
    return folder


def _load(network, folder, **options):
    load_weights(network, folder, where="video expert", **options)


def test_weights_load_strictly_without_a_random_start(tmp_path, transformer, empty):
    _load(empty, _store(tmp_path, transformer))
    loaded = empty.state_dict()
    assert all(torch.equal(loaded[n], t) for n, t in transformer.state_dict().items())


def test_shards_written_by_diffusers_load(tmp_path, transformer, empty):
    transformer.save_pretrained(tmp_path, max_shard_size="50KB")
    assert len(list(tmp_path.glob("*.safetensors"))) > 2
    _load(empty, tmp_path)
    assert torch.equal(empty.proj_out.weight, transformer.proj_out.weight)
    next(iter(tmp_path.glob("*-00002-*"))).unlink()
    with pytest.raises(NotFoundError, match=r"1 of .* files are missing"):
        _load(empty, tmp_path)


def test_weights_take_the_precision_of_the_network_but_norms_and_times_stay_float32(
    tmp_path, transformer, wan_config
):
    empty = empty_transformer(
        NetworkConfig(**TINY), wan_config.model_copy(update={"precision": "bfloat16"})
    )
    _load(empty, _store(tmp_path, transformer))
    # Checked in the published checkpoint as loaded by diffusers with torch_dtype=bfloat16.
    kept = {name for name, tensor in empty.state_dict().items() if tensor.dtype == torch.float32}
    time = "condition_embedder.time_embedder.linear_"
    assert kept == {
        "scale_shift_table",
        *(f"{time}{n}.{part}" for n in (1, 2) for part in ("weight", "bias")),
        *(f"blocks.{n}.scale_shift_table" for n in (0, 1)),
        *(f"blocks.{n}.norm2.{part}" for n in (0, 1) for part in ("weight", "bias")),
    }
    assert empty.blocks[0].attn1.to_q.weight.dtype == torch.bfloat16


def test_what_does_not_belong_to_the_network_is_named(tmp_path, transformer, wan_config):
    _store(tmp_path, transformer)
    deeper = empty_transformer(NetworkConfig(**TINY | {"num_layers": 3}), wan_config)
    wider = empty_transformer(
        NetworkConfig(**TINY), wan_config.model_copy(update={"ffn_width": 48})
    )
    with pytest.raises(InvalidInputError, match=r"27 tensors missing \['blocks\.2"):
        _load(deeper, tmp_path)
    with pytest.raises(InvalidInputError, match=r"ffn\.net\.\S+ has shape \(.*expected \("):
        _load(wider, tmp_path)


def test_weights_that_do_not_fit_are_refused_before_they_are_read(
    tmp_path, transformer, empty, monkeypatch
):
    _store(tmp_path, transformer)
    needed = sum(4 * tensor.numel() for tensor in transformer.state_dict().values())
    with pytest.raises(LimitExceededError, match="GB of memory"):
        _load(empty, tmp_path, max_bytes=needed - 1)
    assert empty.proj_out.weight.is_meta
    monkeypatch.setattr(pretrained_video.weight_files, "available_memory", lambda: needed - 1)
    with pytest.raises(LimitExceededError, match="GB of memory"):
        _load(empty, tmp_path)
    monkeypatch.setattr(pretrained_video.weight_files, "available_memory", lambda: 2 * needed - 1)
    # Of several processes on this machine each has its part.
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(LimitExceededError, match="GB of memory"):
        _load(empty, tmp_path)
    _load(empty, tmp_path, max_bytes=needed)
    assert not empty.proj_out.weight.is_meta


def test_the_full_size_needs_ten_gigabytes():
    sizes = NetworkConfig(num_layers=30, num_heads=24, head_width=128)
    network = empty_transformer(sizes, WanConfig())
    # Two bytes each, and two more for time embedding (256 + 3072 + 2) x 3072, thirty affine norms
    # 2 x 3072, thirty tables 6 x 3072 and the last 2 x 3072.
    kept = (256 + 3072 + 2 + 30 * 2 + 30 * 6 + 2) * 3072
    assert memory_of(network.state_dict()) == 2 * 4_999_787_712 + 2 * kept


def test_the_published_size_has_its_tensors_and_weights():
    sizes = NetworkConfig(num_layers=30, num_heads=24, head_width=128)
    network = empty_transformer(sizes, WanConfig())
    tensors = network.state_dict()
    assert len(tensors) == 825
    assert sum(tensor.numel() for tensor in tensors.values()) == 4_999_787_712
    coder = empty_autoencoder(WanConfig()).state_dict()
    assert len(coder) == 196
    assert sum(tensor.numel() for tensor in coder.values()) == 704_688_668


def test_damaged_pickled_and_absent_files_are_told_apart(tmp_path, transformer, empty):
    with pytest.raises(NotFoundError, match="no folder"):
        _load(empty, tmp_path / "none")
    with pytest.raises(NotFoundError, match=r"no diffusion_pytorch_model\*\.safetensors"):
        _load(empty, tmp_path)
    (tmp_path / "Wan2.2_VAE.pth").write_bytes(b"pickle")
    with pytest.raises(InvalidInputError, match="can run code"):
        _load(empty, tmp_path)
    (tmp_path / f"{STEM}.safetensors").write_bytes(b"\x00" * 64)
    with pytest.raises(CorruptDataError, match="not a safetensors file"):
        _load(empty, tmp_path)
    index = tmp_path / f"{STEM}.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "../elsewhere.safetensors"}}))
    with pytest.raises(CorruptDataError, match="outside its folder"):
        _load(empty, tmp_path)
    index.write_text("[]")
    with pytest.raises(CorruptDataError, match="unreadable"):
        _load(empty, tmp_path)
    index.unlink()
    broken = {name: tensor.clone() for name, tensor in transformer.state_dict().items()}
    broken["proj_out.bias"][3] = float("nan")
    save_file(broken, tmp_path / f"{STEM}.safetensors")
    with pytest.raises(NonFiniteError, match=r"proj_out\.bias"):
        _load(empty, tmp_path)
