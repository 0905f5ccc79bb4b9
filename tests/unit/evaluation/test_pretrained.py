"""The checkpoints that come with the package: they load, are small, and say how good they are."""

import sys

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from dextouch.clients import PolicyStart
from dextouch.errors import UnknownNameError
from dextouch.worlds.world import ReturnSelector, RolloutStart
from services.evaluation.bundled_policies import DEFAULT_POLICY
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.settings import DEFAULT_PROBE, EARLY_POLICY
from services.evaluation.success_classifier import SuccessClassifier
from services.evaluation.trained_networks import MAX_CHECKPOINT_BYTES
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from tests.unit.evaluation import true_endings

SIX = (
    "insert_peg",
    "open_drawer",
    "place_phone",
    "place_shoes",
    "stack_bowls",
    "stand_bottle",
)
MAX_POLICY_BYTES = 1_000_000
# Least AUC and balanced accuracy on true endings.
LEAST = {"stack_bowls": (0.97, 0.90), "stand_bottle": (0.97, 0.90)}


@pytest.mark.parametrize(
    ("path", "build", "tasks"),
    [
        (DEFAULT_POLICY, BehaviourCloningPolicy, SIX),
        (EARLY_POLICY, BehaviourCloningPolicy, SIX),
        (DEFAULT_PROBE, SuccessClassifier, SIX),
    ],
)
def test_a_committed_checkpoint(path, build, tasks):
    metadata = build.load(path).metadata
    assert path.stat().st_size <= MAX_CHECKPOINT_BYTES
    assert metadata.tasks == tasks
    assert set(metadata.settings["instructions"]) == set(metadata.tasks)
    assert len(metadata.training_starts) == len(set(metadata.training_starts)) > 100
    assert metadata.command.startswith(("dextouch train ", "python -m services.evaluation train-"))
    assert "/" not in metadata.command


def test_the_policies_are_better_than_not_looking():
    early, finished = (
        BehaviourCloningPolicy.load(path).metadata.metrics
        for path in (EARLY_POLICY, DEFAULT_POLICY)
    )
    for task in SIX:
        error_mm, mean_mm = (f"wrist_error_mm{name}_{task}" for name in ("", "_of_mean_chunk"))
        assert finished[error_mm] < 0.8 * finished[mean_mm]
        assert finished[error_mm] < early[error_mm] < early[mean_mm]


def test_both_policies_come_from_one_training():
    early, finished = (
        BehaviourCloningPolicy.load(path).metadata for path in (EARLY_POLICY, DEFAULT_POLICY)
    )
    assert (early.command, early.data_hash) == (finished.command, finished.data_hash)
    assert early.training_starts == finished.training_starts
    assert early.settings["share_of_training"] < 0.2 < finished.settings["share_of_training"]
    for path in (EARLY_POLICY, DEFAULT_POLICY):
        assert path.stat().st_size < MAX_POLICY_BYTES


@pytest.fixture(scope="module")
def twin():
    return TwinWorld(TwinSettings(cameras=("camera_head",)))


@pytest.mark.long
@pytest.mark.parametrize("task", SIX)
def test_both_policies_act_in_every_task(task, twin):
    begun = twin.reset(RolloutStart(task, 30007, ""))
    start = PolicyStart(task, "", 30007, begun.anchor, begun.K_head)
    sent = []
    for path in (EARLY_POLICY, DEFAULT_POLICY, DEFAULT_POLICY):
        policy = BehaviourCloningPolicy.load(path)
        policy.reset(start)
        sent.append(policy.act(begun.observation))
    early, finished, again = sent
    assert early.shape == finished.shape == (16, 67)
    np.testing.assert_array_equal(finished, again)
    assert np.abs(early - finished)[:, [9, 10, 11]].max() > 1e-4
    # It begins within 10 cm of where the hands are: poses of step 0 are zero.
    assert np.abs(finished[0, [0, 1, 2, 9, 10, 11]]).max() < 0.10


def test_the_finished_policy_opens_the_drawer(twin):
    begun = twin.reset(RolloutStart("open_drawer", 30000, ""))
    policy = BehaviourCloningPolicy.load(DEFAULT_POLICY)
    policy.reset(PolicyStart("open_drawer", "", 30000, begun.anchor, begun.K_head))
    state, seen = begun.state, begun.observation
    for _ in range(5):
        stepped = twin.step(state, policy.act(seen), seed=0, selector=ReturnSelector(steps="last"))
        state, seen = stepped.state, stepped.observation
    assert seen.success


def test_an_unknown_task_is_refused(twin):
    begun = twin.reset(RolloutStart("open_drawer", 30000, ""))
    policy = BehaviourCloningPolicy.load(DEFAULT_POLICY)
    with pytest.raises(UnknownNameError, match="insert_peg"):
        policy.reset(PolicyStart("juggle", "", 0, begun.anchor, begun.K_head))


@pytest.mark.parametrize("task", SIX)
def test_the_probe_says_what_it_was_measured_on(task):
    metrics = SuccessClassifier.load(DEFAULT_PROBE).metadata.metrics
    assert metrics[f"held_out_auc_{task}"] >= 0.97
    assert metrics[f"held_out_balanced_accuracy_{task}"] >= 0.90
    for outcome in ("successes", "failures"):
        assert metrics[f"num_held_out_{outcome}_{task}"] >= 10
    assert metrics["num_imagined_training_episodes"] >= 500


@pytest.mark.parametrize("task", ["stack_bowls", "stand_bottle"])
def test_the_probe_tells_true_endings_near_the_border(task, capsys):
    endings, success = true_endings.read(task)
    told = SuccessClassifier.load(DEFAULT_PROBE).probabilities(endings)
    wins, losses = told[success], told[~success]
    auc = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
    balanced = ((wins >= 0.5).mean() + (losses < 0.5).mean()) / 2
    with capsys.disabled():
        sys.stdout.write(
            f"\n{task}: {len(wins)} successes, {len(losses)} failures, AUC {auc:.3f}, "
            f"balanced accuracy {balanced:.3f}\n"
        )
    least_auc, least_balanced = LEAST[task]
    assert auc >= least_auc
    assert balanced >= least_balanced
