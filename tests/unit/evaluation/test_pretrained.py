"""The checkpoints that come with the package: they load, are small, and say how good they are."""

import pytest

from services.evaluation.checkpoints import MAX_CHECKPOINT_BYTES
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.settings import DEFAULT_POLICY, DEFAULT_PROBE
from services.evaluation.success_probe import SuccessProbe


@pytest.mark.parametrize(
    ("path", "build"), [(DEFAULT_POLICY, BehaviourCloningPolicy), (DEFAULT_PROBE, SuccessProbe)]
)
def test_a_committed_checkpoint(path, build):
    metadata = build.load(path).metadata
    assert path.stat().st_size <= MAX_CHECKPOINT_BYTES
    assert metadata.tasks == ("stack_bowls", "stand_bottle")
    assert set(metadata.settings["instructions"]) == set(metadata.tasks)
    assert len(metadata.training_starts) == len(set(metadata.training_starts)) > 100
    assert metadata.command.startswith(("dextouch train ", "python -m services.evaluation train-"))
    assert "/" not in metadata.command


def test_the_policy_is_better_than_not_looking():
    metrics = BehaviourCloningPolicy.load(DEFAULT_POLICY).metadata.metrics
    assert metrics["wrist_error_mm"] < 0.85 * metrics["wrist_error_mm_of_mean_chunk"]


# True and imagined endings together; on true ones alone it is nearly always right.
@pytest.mark.parametrize(("task", "least"), [("stack_bowls", 0.7), ("stand_bottle", 0.8)])
def test_the_probe_tells_success_on_held_out_seeds(task, least):
    metrics = SuccessProbe.load(DEFAULT_PROBE).metadata.metrics
    assert metrics[f"held_out_balanced_accuracy_{task}"] >= least
    assert metrics[f"num_held_out_failures_{task}"] >= 10
