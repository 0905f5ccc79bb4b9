"""Video latents that are kept on disk: equal to those computed, found again, and never wrong."""

import shutil
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    StorageError,
    StorageFullError,
)
from services.world_model.checkpoints import read_checkpoint
from services.world_model.network.configuration import WanFiles
from services.world_model.network.instruction import key_of
from services.world_model.paper_settings import OptimizerSettings, TrainSettings, WindowSettings
from services.world_model.pretrained_video import initial_codec
from services.world_model.training import latent_cache
from services.world_model.training.joint_trainer import train_on
from services.world_model.training.latent_cache import LatentCache


@pytest.fixture
def settings(full_config, pretrained_folder, tmp_path):
    files = WanFiles(folder=pretrained_folder, text_cache=tmp_path / "texts")
    return TrainSettings(
        episodes="unused", output=tmp_path / "plain.safetensors", network=full_config, wan=files,
        optimizer=OptimizerSettings(batch=2, warmup_steps=1),
        windows=WindowSettings(fit_windows=4), evaluation_stride=24, max_steps=4,
    )  # fmt: skip


@pytest.fixture
def cached(settings, tmp_path):
    files = settings.wan.model_copy(update={"latent_cache": tmp_path / "latents.sqlite3"})
    output = tmp_path / "cached.safetensors"
    return settings.model_copy(update={"wan": files, "output": output})


@pytest.fixture
def episodes(large_episode, monkeypatch):
    made = [large_episode(seed) for seed in range(3)]
    monkeypatch.setattr(latent_cache, "load_split", lambda _: (made[:2], made[2:]))
    return made


@pytest.fixture
def counted(monkeypatch):
    """How many windows the autoencoder encodes."""
    from diffusers import AutoencoderKLWan

    calls, encode = [], AutoencoderKLWan.encode

    def count(self, pixels):
        calls.append(len(pixels))
        return encode(self, pixels)

    monkeypatch.setattr(AutoencoderKLWan, "encode", count)
    return calls


def test_training_from_a_filled_cache_is_bit_identical_and_never_encodes(
    settings, cached, episodes, counted
):
    filled = latent_cache.fill_latent_cache(cached)
    # From every step but the last four, which begin no window.
    expected = sum(len(one) - 4 for one in episodes[:2])
    assert (filled.num_windows, filled.num_episodes, filled.num_instructions) == (expected, 2, 1)
    assert sum(counted) == expected
    assert len(list(settings.wan.text_cache.iterdir())) == 1
    counted.clear()
    assert latent_cache.fill_latent_cache(cached) == filled
    assert not counted

    alike = []
    for given in (settings, cached):
        counted.clear()
        # The checkpoint's evaluation encodes held-out windows in both.
        report = train_on(episodes[:2], episodes[2:], given)
        alike.append((report.log, read_checkpoint(given.output).model.state_dict(), list(counted)))
    (log, weights, plain), (cached_log, cached_weights, kept) = alike
    assert log == cached_log
    assert all(torch.equal(weights[name], cached_weights[name]) for name in weights)
    # The first images and windows of four batches of two.
    assert len(plain) - len(kept) == 4 * 2 * 2


def test_a_training_keeps_what_it_computed_for_the_next(cached, episodes, counted):
    train_on(episodes[:2], episodes[2:], cached)
    first = sum(counted)
    counted.clear()
    again = cached.model_copy(update={"output": cached.output.with_name("again.safetensors")})
    train_on(episodes[:2], episodes[2:], again)
    assert 0 < sum(counted) < first


def _cache(settings, **flags):
    model = initial_codec(settings.network, settings.wan)
    latent_cache.use_latent_cache(model, settings.wan, **flags)
    return model


def test_latents_are_found_by_their_images_and_weights_alone(cached, episodes, counted):
    images = torch.from_numpy(episodes[0].images[:17])
    model, other = _cache(cached), _cache(cached, adds=False)
    latents = model.encode_images(torch.stack([images, images.flip(2)]))
    assert counted == [1, 1]
    # Another process, shorter windows, the first image, and another order.
    assert torch.equal(other.encode_images(images[None])[0], latents[0])
    assert torch.equal(other.encode_images(images[None, :9])[0], latents[0, :3])
    assert torch.equal(other.encode_images(images[None, :1])[0], latents[0, :1])
    assert counted == [1, 1]
    changed = images.clone()
    changed[16, 63, 63, 2] ^= 1
    new = other.encode_images(changed[None])[0]
    assert counted == [1, 1, 1]
    assert torch.equal(new[:4], latents[0, :4])
    assert not torch.equal(new[4], latents[0, 4])
    # `adds=False` has not kept it, and another encoder finds nothing.
    other.encode_images(changed[None])
    model.codec.autoencoder.quant_conv.bias.data[0] += 1
    latent_cache.use_latent_cache(model, cached.wan)
    moved = model.encode_images(images[None])
    assert counted == [1] * 5
    assert not torch.equal(moved[0], latents[0])


def test_damage_and_foreign_files_are_refused_and_a_full_disk_is_named(
    cached, episodes, monkeypatch
):
    path, images = cached.wan.latent_cache, torch.from_numpy(episodes[0].images[None, :17])
    model = _cache(cached)
    model.encode_images(images)
    with sqlite3.connect(path) as connection:
        (latent,) = connection.execute("SELECT latent FROM latents LIMIT 1").fetchone()
        assert len(latent) == 4 * 48 * 4 * 4
        damaged = bytes([latent[0] ^ 1]) + latent[1:]
        connection.execute("UPDATE latents SET latent = ? WHERE latent = ?", (damaged, latent))
    with pytest.raises(CorruptDataError, match=r"checksum; remove the file"):
        model.encode_images(images)
    path.unlink()
    for end in ("-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)
    path.write_bytes(b"no database" * 100)
    with pytest.raises(CorruptDataError, match=r"latents\.sqlite3: .*not a database"):
        _cache(cached)
    path.unlink()
    model = _cache(cached)
    source = model.latent_cache.__self__
    source._connection.execute("PRAGMA max_page_count = 4")
    with pytest.raises(StorageFullError, match="no space left"):
        model.encode_images(images)
    usage = shutil.disk_usage(path.parent)._replace(free=0)
    monkeypatch.setattr(latent_cache.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(LimitExceededError, match=r"74 windows need 0\.0 GB"):
        latent_cache.fill_latent_cache(cached)


def test_processes_may_open_a_new_file_at_once_and_other_paths_are_named(tmp_path):
    weights = {"one": torch.zeros(3)}

    def opened(number):
        return LatentCache(tmp_path / str(number // 8) / "latents.sqlite3", weights, 192)

    with ThreadPoolExecutor(8) as pool:
        assert len(list(pool.map(opened, range(160)))) == 160
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="make the folder"):
        LatentCache(tmp_path / "file" / "latents.sqlite3", weights, 192)
    with pytest.raises(StorageError, match="a file on a local disk") as caught:
        LatentCache(tmp_path, weights, 192)
    assert "remove" not in str(caught.value)


def test_instructions_are_encoded_before_images_also_for_a_checkpoint(
    settings, cached, episodes, counted
):
    report = train_on(episodes[:2], episodes[2:], settings)
    counted.clear()
    episodes[:2] = [replace(one, instruction="stand the box") for one in episodes[:2]]
    init = {"init": report.checkpoint}
    without = cached.model_copy(
        update={**init, "wan": cached.wan.model_copy(update={"folder": None})}
    )
    with pytest.raises(InvalidInputError, match=r"stand the box.*--wan\.folder"):
        latent_cache.fill_latent_cache(without)
    assert not counted
    latent_cache.fill_latent_cache(cached.model_copy(update=init))
    assert (cached.wan.text_cache / f"{key_of('stand the box')}.safetensors").is_file()


def test_it_is_for_the_pretrained_autoencoder_and_has_a_place(settings, cached, tiny_model):
    with pytest.raises(InvalidInputError, match=r"name one with --wan\.latent-cache"):
        latent_cache.fill_latent_cache(settings)
    with pytest.raises(InvalidInputError, match="video_expert tiny"):
        latent_cache.use_latent_cache(tiny_model, cached.wan)
    without = cached.model_copy(update={"wan": WanFiles(latent_cache=cached.wan.latent_cache)})
    with pytest.raises(InvalidInputError, match=r"--wan\.folder, or --init"):
        latent_cache.fill_latent_cache(without)
