"""The checkpoints that come with the package: they load, are small, and say how good they are."""

import sys

import pytest
from scipy.stats import mannwhitneyu

from services.evaluation.checkpoints import MAX_CHECKPOINT_BYTES
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.settings import DEFAULT_POLICY, DEFAULT_PROBE
from services.evaluation.success_probe import SuccessProbe
from tests.unit.evaluation import true_endings


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


@pytest.mark.parametrize("task", ["stack_bowls", "stand_bottle"])
def test_the_probe_says_what_it_was_measured_on(task):
    metadata = SuccessProbe.load(DEFAULT_PROBE).metadata
    assert metadata.metrics[f"held_out_auc_{task}"] >= 0.97
    assert metadata.metrics[f"held_out_balanced_accuracy_{task}"] >= 0.9
    for outcome in ("successes", "failures"):
        assert metadata.metrics[f"num_held_out_{outcome}_{task}"] >= 50
    assert "--held_out" in metadata.command


@pytest.mark.parametrize("task", ["stack_bowls", "stand_bottle"])
def test_the_probe_tells_true_endings_near_the_border(task, capsys):
    endings, success = true_endings.read(task)
    told = SuccessProbe.load(DEFAULT_PROBE).probabilities(endings)
    wins, losses = told[success], told[~success]
    auc = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
    balanced = ((wins >= 0.5).mean() + (losses < 0.5).mean()) / 2
    with capsys.disabled():
        sys.stdout.write(
            f"\n{task}: {len(wins)} successes, {len(losses)} failures, AUC {auc:.3f}, "
            f"balanced accuracy {balanced:.3f}\n"
        )
    assert auc >= 0.95
    assert balanced >= 0.88
