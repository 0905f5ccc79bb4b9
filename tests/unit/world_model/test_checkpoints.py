"""A checkpoint comes back as it was stored, or not at all."""

import json
import resource

import pytest
import torch
from safetensors.torch import load, load_file, save, save_file

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
    StorageError,
)
from services.networks.weight_files import read_weights
from services.world_model import checkpoints, shipped_checkpoints
from services.world_model.checkpoints import (
    METADATA_KEY,
    CheckpointMetadata,
    list_checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from services.world_model.settings import WorldModelSettings
from services.world_model.shipped_checkpoints import default_checkpoint


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.safetensors"


def _damage(path, model, metadata, *, change=None, notes=None):
    write_checkpoint(path, model, metadata)
    tensors = load(path.read_bytes())
    if change is not None:
        change(tensors)
    note = metadata.model_dump_json() if notes is None else notes
    path.write_bytes(save(tensors, {METADATA_KEY: note} if note else None))
    return path


def test_weights_and_history_come_back(path, tiny_model, metadata):
    digest = write_checkpoint(path, tiny_model, metadata)
    loaded = read_checkpoint(path)
    assert loaded.digest == digest
    assert loaded.metadata == metadata
    for name, tensor in tiny_model.state_dict().items():
        stored = loaded.model.state_dict()[name]
        assert stored.dtype == torch.float32
        torch.testing.assert_close(stored, tensor, rtol=1e-3, atol=1e-6)


def test_storing_what_was_loaded_gives_the_same_bytes(path, tiny_model, metadata):
    digest = write_checkpoint(path, tiny_model, metadata)
    assert write_checkpoint(path, read_checkpoint(path).model, metadata) == digest


def test_statistics_keep_their_full_precision(path, tiny_model, metadata):
    tiny_model.codec.mean.fill_(1 / 3)
    write_checkpoint(path, tiny_model, metadata)
    assert torch.equal(read_checkpoint(path).model.codec.mean, tiny_model.codec.mean)


def test_missing_foreign_and_misshapen_tensors_are_named(path, tiny_model, metadata):
    with pytest.raises(InvalidInputError, match=r"missing \['video.places'\]"):
        read_checkpoint(_damage(path, tiny_model, metadata, change=lambda t: t.pop("video.places")))
    with pytest.raises(InvalidInputError, match=r"unexpected \['extra'\]"):
        read_checkpoint(
            _damage(path, tiny_model, metadata, change=lambda t: t.update(extra=torch.ones(2)))
        )
    with pytest.raises(InvalidInputError, match=r"video.places is .* \(2,\)"):
        read_checkpoint(
            _damage(
                path,
                tiny_model,
                metadata,
                change=lambda t: t.update({"video.places": torch.ones(2)}),
            )
        )
    with pytest.raises(InvalidInputError, match=r"int64"):
        read_checkpoint(
            _damage(
                path,
                tiny_model,
                metadata,
                change=lambda t: t.update({"video.places": t["video.places"].long()}),
            )
        )


def test_weights_that_are_no_numbers_are_refused_both_ways(path, tiny_model, metadata):
    def poison(tensors):
        tensors["tactile.hands"][0, 0] = float("nan")

    with pytest.raises(NonFiniteError, match=r"tactile.hands"):
        read_checkpoint(_damage(path, tiny_model, metadata, change=poison))
    with torch.no_grad():
        tiny_model.tactile.hands[0, 0] = 1e6
    with pytest.raises(NonFiniteError, match="to be written"):
        write_checkpoint(path, tiny_model, metadata)


def test_foreign_files_are_refused(path, tiny_model, metadata):
    with pytest.raises(NotFoundError):
        read_checkpoint(path)
    path.write_bytes(b"not a checkpoint at all")
    with pytest.raises(CorruptDataError, match="not a safetensors"):
        read_checkpoint(path)
    with pytest.raises(CorruptDataError, match="no 'dextouch_world_model'"):
        read_checkpoint(_damage(path, tiny_model, metadata, notes=""))
    with pytest.raises(CorruptDataError, match="unreadable"):
        read_checkpoint(_damage(path, tiny_model, metadata, notes="{"))
    newer = json.dumps({**metadata.model_dump(mode="json"), "format_version": 2})
    with pytest.raises(InvalidInputError, match="format version 2"):
        read_checkpoint(_damage(path, tiny_model, metadata, notes=newer))
    with pytest.raises(LimitExceededError, match="at most 100"):
        read_weights(path, CheckpointMetadata, METADATA_KEY, max_bytes=100)
    with path.open("wb") as file:
        file.truncate(64 * 2**20 + 1)
    with pytest.raises(LimitExceededError, match="at most 67108864"):
        read_checkpoint(path)


def test_a_large_network_may_have_a_large_file(path, tiny_model, metadata, monkeypatch):
    monkeypatch.setattr(checkpoints, "MAX_FILE_BYTES", 1000)
    write_checkpoint(path, tiny_model, metadata)
    assert path.stat().st_size > 1000
    assert read_checkpoint(path).metadata == metadata
    # More than its network, which is of float32 at most, needs.
    spare = {**load_file(path), "spare": torch.zeros(3 * path.stat().st_size, dtype=torch.uint8)}
    save_file(spare, path, {METADATA_KEY: metadata.model_dump_json()})
    with pytest.raises(LimitExceededError, match="expected at most"):
        read_checkpoint(path)


def test_files_have_the_usual_permissions(path, tiny_model, metadata):
    write_checkpoint(path, tiny_model, metadata)
    plain = path.with_name("plain")
    plain.touch()
    assert path.stat().st_mode == plain.stat().st_mode


def test_a_cut_off_file_is_refused(path, tiny_model, metadata):
    write_checkpoint(path, tiny_model, metadata)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CorruptDataError):
        read_checkpoint(path)


def test_a_disk_that_is_full_is_named_and_nothing_is_left_on_it(path, tiny_model, metadata):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(StorageError, match=r"write .*free space"):
            write_checkpoint(path, tiny_model, metadata)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(path.parent.glob("*.partial"))


def test_an_output_that_cannot_be_a_file_is_refused(tmp_path, tiny_model, metadata):
    for output in (tmp_path, tmp_path / "file" / "model.safetensors"):
        (tmp_path / "file").touch()
        with pytest.raises(StorageError, match="write "):
            write_checkpoint(output, tiny_model, metadata)


def test_checkpoints_are_listed_with_their_digests(tmp_path, tiny_model, metadata):
    a = write_checkpoint(tmp_path / "a.safetensors", tiny_model, metadata)
    b = write_checkpoint(
        tmp_path / "b.safetensors", tiny_model, metadata.model_copy(update={"seed": 1})
    )
    assert a != b
    found = {path.name: digest for path, digest in list_checkpoints(tmp_path).items()}
    assert found == {"a.safetensors": a, "b.safetensors": b}


def test_the_default_is_the_state_model_where_it_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(shipped_checkpoints, "PRETRAINED", tmp_path)
    (tmp_path / "tiny.safetensors").touch()
    assert default_checkpoint() == WorldModelSettings().checkpoint == tmp_path / "tiny.safetensors"
    (tmp_path / "state.safetensors").touch()
    assert default_checkpoint() == WorldModelSettings().checkpoint == tmp_path / "state.safetensors"
