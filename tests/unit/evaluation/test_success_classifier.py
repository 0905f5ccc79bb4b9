"""The success classifier: accuracy on held-out toys, balance, and honest refusals."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu

from dextouch.episodes import split_by_scene
from dextouch.errors import ConflictError, InvalidInputError, NonFiniteError, UnknownNameError
from services.evaluation.success_classifier import (
    ClassifierNetwork,
    ClassifierShape,
    SuccessClassifier,
)
from services.evaluation.success_classifier_training import (
    ClassifierSets,
    ClassifierSettings,
    calibrate_success_classifier,
    labelled_endings,
    train_success_classifier,
)
from tests.unit.evaluation import toy
from tests.unit.evaluation.shown_endings import ending_episode, final_ending

pytestmark = pytest.mark.long


def _episodes(demonstrations):
    return [ending_episode(d) for d in demonstrations]


def test_held_out_accuracy_is_kept_in_the_checkpoint(trained_probe):
    metrics = trained_probe.metadata.metrics
    for task in toy.TASKS:
        assert metrics[f"held_out_balanced_accuracy_{task}"] >= 0.8
        assert metrics[f"num_held_out_failures_{task}"] > 0


def test_it_tells_new_successes_from_failures(trained_probe):
    probe = SuccessClassifier(trained_probe)
    fresh = [toy.demonstration(t, s, noise_m=n) for t in toy.TASKS for s in range(500, 510)
             for n in (0.0, 0.06)]  # fmt: skip
    told = probe.probabilities([final_ending(d, d.num_steps - 1) for d in fresh]) > 0.5
    assert np.mean(told == [d.success for d in fresh]) >= 0.85
    untouched = [final_ending(d, 2) for d in fresh]
    assert np.mean(probe.probabilities(untouched) > 0.5) <= 0.15


def test_one_and_many_agree(probe_checkpoint):
    probe = SuccessClassifier(probe_checkpoint)
    endings = [final_ending(toy.demonstration("reach", s), 80) for s in range(4)]
    together = probe.probabilities(endings)
    assert together == pytest.approx(
        np.concatenate([probe.probabilities([e]) for e in endings]), abs=1e-6
    )


def test_both_outcomes_weigh_the_same(demonstrations):
    shape = ClassifierShape(tasks=toy.TASKS, image_size_px=toy.SIZE)
    labelled = labelled_endings(_episodes(demonstrations), shape)
    for task in range(2):
        of_task = labelled.batch.task == task
        wins = labelled.outcome[:, 0] > 0.5
        assert float(labelled.weight[of_task & wins].sum()) == pytest.approx(
            float(labelled.weight[of_task & ~wins].sum()), rel=1e-4
        )


def test_one_sided_data_is_refused():
    with pytest.raises(InvalidInputError, match=r"no failed episode of true 'reach'"):
        train_success_classifier(
            _episodes(toy.demonstrations(range(20))), ClassifierSettings(), command="x"
        )


def test_foreign_input_is_refused(probe_checkpoint):
    probe = SuccessClassifier(probe_checkpoint)
    ending = final_ending(toy.demonstration("reach", 0), 80)
    with pytest.raises(UnknownNameError, match="juggle"):
        probe.probabilities([toy.replace(ending, task="juggle")])
    with pytest.raises(InvalidInputError, match="no endings"):
        probe.probabilities([])
    large = np.zeros((3, 64, 64, 3), np.uint8)
    with pytest.raises(InvalidInputError, match="32, 32"):
        probe.probabilities([toy.replace(ending, images=large)])


def test_a_start_never_stands_on_both_sides(demonstrations):
    twice = demonstrations + [
        toy.replace(d, episode_id=f"{d.episode_id}-b") for d in demonstrations
    ]
    training, held_out = split_by_scene(twice, held_out_share=0.3)
    assert len(training) + len(held_out) == len(twice)
    assert not {d.start_digest for d in training} & {d.start_digest for d in held_out}


def test_what_was_imagined_of_a_held_out_scene_is_not_trained_on(demonstrations):
    episodes = _episodes(demonstrations)
    # As a world that sees smaller images than the take has.
    imagined = replace(episodes[3], episode_id="imagined", start_digest="another")
    for others in ({"held_out": [imagined]}, {"development": [imagined]}):
        with pytest.raises(ConflictError, match=f"1 scenes were trained on .*{imagined.scene};"):
            ClassifierSets.split(episodes, ClassifierSettings(), **others)


def test_tasks_have_any_name(demonstrations):
    names = ("v1.2 pick", "pop", "training", "a/b", "reach")
    network = ClassifierNetwork(ClassifierShape(tasks=names))
    assert len({id(network.of(name)) for name in names}) == len(names)
    assert any(name.startswith("tasks.reach.") for name in network.state_dict())
    with pytest.raises(InvalidInputError, match="two have one name"):
        ClassifierNetwork(ClassifierShape(tasks=("a.b", "a%2Eb")))


def test_a_training_that_diverges_is_named(demonstrations):
    settings = ClassifierSettings(num_training_steps=20, learning_rate=1e30)
    with pytest.raises(NonFiniteError, match="gradients of step"):
        train_success_classifier(_episodes(demonstrations), settings, command="x")


def test_it_is_measured_on_the_held_out_episodes_it_is_given(demonstrations):
    settings = ClassifierSettings(num_training_steps=1)
    others = toy.demonstrations(range(900, 920), noise_m=0.03)
    unknown = toy.replace(_episodes(others)[0], task="juggle", instruction="Juggle.")
    checkpoint = train_success_classifier(
        _episodes(demonstrations), settings, command="x", held_out=[*_episodes(others), unknown]
    )
    # What it was not trained for is not evaluated by default, either.
    assert set(checkpoint.metadata.settings["instructions"]) == set(toy.TASKS)
    assert len(checkpoint.metadata.training_episodes) == len(demonstrations)
    metrics, probe = checkpoint.metadata.metrics, SuccessClassifier(checkpoint)
    for task in toy.TASKS:
        mine = [d for d in others if d.task == task]
        told = probe.probabilities([final_ending(d, 80) for d in mine])
        wins, losses = ([p for p, d in zip(told, mine, strict=True) if d.success is w]
                        for w in (True, False))  # fmt: skip
        auc = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
        assert metrics[f"held_out_auc_{task}"] == pytest.approx(auc)
        assert metrics[f"num_held_out_failures_{task}"] == len(losses) > 0
    with pytest.raises(ConflictError, match="trained on by the success classifier"):
        train_success_classifier(
            _episodes(demonstrations),
            settings,
            command="x",
            held_out=_episodes([*others, demonstrations[3]]),
        )


def test_early_endings_do_not_crowd_out_near_misses(demonstrations):
    shape = ClassifierShape(tasks=toy.TASKS, image_size_px=toy.SIZE)
    labelled = labelled_endings(_episodes(demonstrations), shape)
    # Two endings of each episode are late; an early one follows them.
    early = torch.tensor([False, False, True] * len(demonstrations))
    failed = labelled.outcome[:, 0] < 0.5
    share = labelled.weight[early].sum() / labelled.weight[failed].sum()
    assert float(share) == pytest.approx(0.1, abs=1e-3)


def test_a_probe_with_spoiled_probabilities_is_calibrated_to_what_happened(
    probe_checkpoint, demonstrations
):
    """Against the frequency of success, with the weights as they were."""
    episodes = _episodes(demonstrations)
    spoiled = {"calibration": {}, "threshold": probe_checkpoint.metadata.settings["threshold"]}
    settings = {**probe_checkpoint.metadata.settings, **spoiled}
    for task in probe_checkpoint.metadata.tasks:
        settings["calibration"][f"{task}/true"] = {"temperature": 1.0, "bias": 8.0, "band": 0.0}
    metadata = probe_checkpoint.metadata.model_copy(update={"settings": settings})
    base = replace(probe_checkpoint, metadata=metadata)
    calibrated = calibrate_success_classifier(base, episodes, ClassifierSettings(), command="test")
    for name, tensor in base.tensors.items():
        assert (calibrated.tensors[name] == tensor).all()
    assert calibrated.metadata.settings["calibrated_by"] == "test"
    last = [one.endings[max(one.endings)] for one in episodes]
    rate = sum(one.success for one in episodes) / len(episodes)
    assert SuccessClassifier(base).probabilities(last).mean() > rate + 0.2
    mine, other = calibrated.metadata.tasks
    part = [one for one in episodes if one.task == mine]
    partly = calibrate_success_classifier(base, part, ClassifierSettings(), command="test")
    found = partly.metadata.settings["calibration"]
    assert found[f"{other}/true"] == settings["calibration"][f"{other}/true"]
    assert found[f"{mine}/true"] != settings["calibration"][f"{mine}/true"]
    assert SuccessClassifier(calibrated).probabilities(last).mean() == pytest.approx(rate, abs=0.08)
