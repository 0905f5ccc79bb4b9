"""Checkpoints: a round trip, and every way in which a file can be wrong."""

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
from services.evaluation.policies.behaviour_cloning import KIND, BehaviourCloningPolicy
from services.evaluation.success_classifier import KIND as PROBE_KIND
from services.evaluation.success_classifier import SuccessClassifier
from services.evaluation.trained_networks import (
    MAX_CHECKPOINT_BYTES,
    Checkpoint,
    load_checkpoint,
    save_checkpoint,
)


def changed(checkpoint: Checkpoint, **tensors: torch.Tensor | None) -> Checkpoint:
    merged = {**checkpoint.tensors, **{k.replace("__", "."): v for k, v in tensors.items()}}
    return Checkpoint(checkpoint.metadata, {k: v for k, v in merged.items() if v is not None})


@pytest.mark.long
def test_round_trip(policy_checkpoint, probe_checkpoint, tmp_path):
    for kind, checkpoint, build in (
        (KIND, policy_checkpoint, BehaviourCloningPolicy),
        (PROBE_KIND, probe_checkpoint, SuccessClassifier),
    ):
        path = tmp_path / "deep" / f"{kind}.safetensors"
        save_checkpoint(path, checkpoint)
        assert path.stat().st_size <= MAX_CHECKPOINT_BYTES
        back = load_checkpoint(path, kind=kind)
        assert back.metadata.model_dump_json() == checkpoint.metadata.model_dump_json()
        assert all(torch.equal(back.tensors[k], v) for k, v in checkpoint.tensors.items())
        build.load(path)
        assert not list(path.parent.glob("*.partial"))


def test_it_says_what_it_was_trained_on(policy_checkpoint, demonstrations):
    metadata = policy_checkpoint.metadata
    known = {d.episode_id: d for d in demonstrations}
    assert set(metadata.training_episodes) < set(known)
    assert {known[e].start_digest for e in metadata.training_episodes} == set(
        metadata.training_starts
    )
    assert (metadata.command, metadata.seed, len(metadata.data_hash)) == ("a test", 0, 64)


def test_wrong_files_are_refused(policy_checkpoint, tmp_path):
    path = tmp_path / "policy.safetensors"
    with pytest.raises(NotFoundError, match="train one"):
        load_checkpoint(path, kind=KIND)
    save_checkpoint(path, policy_checkpoint)
    with pytest.raises(InvalidInputError, match="expected success-probe"):
        load_checkpoint(path, kind=PROBE_KIND)
    whole = path.read_bytes()
    for broken in (b"", b"\x80\x04", whole[:-40]):
        path.write_bytes(broken)
        with pytest.raises(CorruptDataError, match="not a safetensors"):
            load_checkpoint(path, kind=KIND)
    path.write_bytes(bytes(3 * MAX_CHECKPOINT_BYTES))
    with pytest.raises(LimitExceededError, match="at most"):
        load_checkpoint(path, kind=KIND)


@pytest.mark.parametrize("text", [None, "{", json.dumps({"kind": KIND})])
def test_foreign_metadata_is_refused(text, tmp_path):
    path = tmp_path / "policy.safetensors"
    save_file({"a": torch.ones(1)}, path, metadata=None if text is None else {"dextouch": text})
    with pytest.raises(CorruptDataError, match="metadata"):
        load_checkpoint(path, kind=KIND)


def test_weights_that_do_not_fit_are_refused(policy_checkpoint):
    for tensors in (
        {"network__task__weight": None},
        {"network__task__weight": torch.zeros(2, 3)},
        {"network__stranger": torch.zeros(1)},
    ):
        with pytest.raises(InvalidInputError, match=r"network\.(task\.weight|stranger)"):
            BehaviourCloningPolicy(changed(policy_checkpoint, **tensors))


def test_nan_and_oversized_weights_are_never_written(policy_checkpoint, tmp_path):
    path = tmp_path / "policy.safetensors"
    with pytest.raises(NonFiniteError, match="NaN"):
        save_checkpoint(path, changed(policy_checkpoint, extra=torch.tensor([torch.nan])))
    with pytest.raises(LimitExceededError, match="at most"):
        save_checkpoint(path, changed(policy_checkpoint, extra=torch.zeros(MAX_CHECKPOINT_BYTES)))
    assert not path.exists()
    save_file(
        {"a": torch.tensor([torch.inf])}, path,
        metadata={"dextouch": policy_checkpoint.metadata.model_dump_json()},
    )  # fmt: skip
    with pytest.raises(NonFiniteError, match="infinity in"):
        load_checkpoint(path, kind=KIND)
