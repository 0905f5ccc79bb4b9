"""Training moves the loss, repeats itself, and never judges what it has seen."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open

from dextouch.errors import ConflictError, InvalidInputError
from services.world_model.checkpoints import METADATA_KEY, read_checkpoint
from services.world_model.training import evaluation
from services.world_model.training.episode_sets import check_disjoint
from services.world_model.training.evaluation import evaluate_prediction, predict_all
from services.world_model.training.joint_dataset import WindowPosition, stack_windows
from services.world_model.training.joint_trainer import TrainingRun, train, train_on
from tests.unit.world_model.conftest import losses


@pytest.fixture
def heldout(toy_episode):
    return [toy_episode(seed, 25) for seed in (10_000, 10_001)]


@pytest.mark.long
def test_the_loss_falls(toy_episodes, train_settings):
    run = TrainingRun(toy_episodes, train_settings.model_copy(update={"max_steps": 80}))
    run.fit_codecs()
    log = run.run()
    assert log[-1].loss_tactile < 0.7 * log[0].loss_tactile
    assert log[-1].loss_video < log[0].loss_video
    assert log[-1].share == 1.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_weights(toy_episodes, train_settings):
    def weights():
        run = TrainingRun(toy_episodes, train_settings)
        run.fit_codecs()
        run.run()
        return run.whole_average().state_dict()

    a, b = weights(), weights()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_averaged_weights_follow_fast_at_first(toy_episodes, train_settings):
    run = TrainingRun(toy_episodes, train_settings)
    run.fit_codecs()
    batches = run._batches()
    averages = run._averages
    mean = [weight.clone() for weight in averages.values()]
    # 1 − (1 + k) / (10 + k) of the way at step k, as long as that is more than 1 − ema_decay.
    for share in (9 / 10, 9 / 11, 9 / 12):
        run.learn(next(batches))
        run.budget.step += 1
        weights = list(run.learned.values())
        mean = [m + share * (w - m) for m, w in zip(mean, weights, strict=True)]
        for expected, averaged in zip(mean, averages.values(), strict=True):
            torch.testing.assert_close(averaged, expected)
    run.budget.step = 10**6
    before = [weight.clone() for weight in averages.values()]
    run.learn(next(batches))
    decay = train_settings.optimizer.ema_decay
    for was, weight, averaged in zip(before, run.learned.values(), averages.values(), strict=True):
        torch.testing.assert_close(averaged, decay * was + (1 - decay) * weight)


@pytest.mark.long
def test_a_report_holds_what_was_measured_on_the_stored_weights(
    toy_store, toy_episodes, heldout, train_settings
):
    seen = []
    report = train_on(toy_episodes, heldout, train_settings, seen.append)
    stored = read_checkpoint(report.checkpoint)
    assert stored.digest == report.digest
    assert stored.metadata.metrics == report.metrics
    assert stored.metadata.train_fingerprints == tuple(
        sorted(e.fingerprint() for e in toy_episodes)
    )
    assert stored.metadata.tasks == ("push_box",)
    assert seen == report.log
    again = evaluate_prediction(
        stored.model, heldout, train_fingerprints=stored.metadata.train_fingerprints
    )
    assert again == report.metrics
    names = {
        "psnr", "psnr_copy", "psnr_codec", "psnr_other_take", "psnr_hold", "psnr_hands_still",
        "tactile_mse",
        "tactile_mse_zero", "tactile_mse_copy", "contact_f1", "contact_f1_copy",
    }  # fmt: skip
    assert names <= report.metrics.keys()
    assert all(np.isfinite(value) for value in report.metrics.values())
    assert report.metrics["num_windows"] == 4
    with safe_open(report.checkpoint, framework="np") as file:
        assert json.loads(file.metadata()[METADATA_KEY])["data_hash"] == stored.metadata.data_hash


@pytest.mark.long
def test_training_from_a_store_splits_it_by_hash(toy_store, train_settings):
    settings = train_settings.model_copy(update={"heldout_percent": 50, "max_steps": 2})
    report = train(settings)
    metadata = read_checkpoint(report.checkpoint).metadata
    assert not set(metadata.train_episode_ids) & set(metadata.heldout_episode_ids)
    assert len(metadata.train_episode_ids) + len(metadata.heldout_episode_ids) == 6


def test_held_out_episodes_cannot_be_trained_on(toy_episodes, heldout, train_settings):
    check_disjoint(toy_episodes, heldout)
    renamed = replace(toy_episodes[0], episode_id="new-name", scene="push_box/777")
    with pytest.raises(InvalidInputError, match="new-name"):
        check_disjoint(toy_episodes, [*heldout, renamed])
    # Another recording of the same scene.
    same_scene = replace(heldout[0], scene=toy_episodes[1].scene)
    with pytest.raises(InvalidInputError, match="same scene"):
        train_on(toy_episodes, [same_scene], train_settings)


def test_held_out_episodes_without_a_window_are_refused_before_training(
    toy_episodes, toy_episode, train_settings, monkeypatch
):
    monkeypatch.setattr(TrainingRun, "run", lambda *_: pytest.fail("trained"))
    with pytest.raises(InvalidInputError, match="without a window of 17 steps"):
        train_on(toy_episodes, [toy_episode(70, 12)], train_settings)


@pytest.mark.long
def test_a_model_has_the_rate_of_its_episodes(toy_episodes, heldout, train_settings):
    fast, others = ([replace(one, model_rate_hz=30.0) for one in some]
                    for some in (toy_episodes, heldout))  # fmt: skip
    settings = train_settings.model_copy(update={"max_steps": 1})
    report = train_on(fast, others, settings)
    assert read_checkpoint(report.checkpoint).metadata.network.model_rate_hz == 30.0
    network = settings.network.model_copy(update={"model_rate_hz": 20.0})
    with pytest.raises(ConflictError, match="is 20 Hz, the episodes have steps at 30 Hz"):
        train_on(fast, others, settings.model_copy(update={"network": network}))
    slow = settings.model_copy(update={"network": network, "init": report.checkpoint})
    with pytest.raises(ConflictError, match=r"safetensors has steps at 20 Hz.*align them at its"):
        train_on(fast, others, slow)


def test_training_episodes_cannot_be_judged_on(tiny_model, toy_episodes):
    prints = [toy_episodes[2].fingerprint()]
    with pytest.raises(InvalidInputError, match="toy-2"):
        evaluate_prediction(tiny_model, toy_episodes, train_fingerprints=prints)
    with pytest.raises(InvalidInputError, match="without a window"):
        evaluate_prediction(tiny_model, [], train_fingerprints=prints)


def test_false_actions_are_of_the_same_moment(tiny_model, heldout, monkeypatch):
    asked = []

    def remember(model, requests):
        asked.append(requests)
        return predict_all(model, requests)

    monkeypatch.setattr(evaluation, "predict_all", remember)
    evaluate_prediction(tiny_model, heldout, train_fingerprints=(), stride=8)
    own, other_take, hold, hands_still = asked
    starts = (0, 8, 0, 8)
    other = [
        heldout[1 - index // 2]
        .cut(WindowPosition(0, start, 17, action_kind="commanded"))
        .request.actions
        for index, start in enumerate(starts)
    ]
    for index, request in enumerate(own):
        assert (other_take[index].actions == other[index]).all()
        assert (hold[index].actions == request.actions[0]).all()
        assert (hands_still[index].actions[:, :58] == request.actions[0, :58]).all()
        assert (hands_still[index].actions[:, 58:] == request.actions[:, 58:]).all()
        for false in (other_take, hold, hands_still):
            assert (false[index].first_image == request.first_image).all()
            assert false[index].anchor is request.anchor


def test_copy_and_zero_are_what_they_say(tiny_model, heldout):
    figures = evaluate_prediction(tiny_model, heldout, train_fingerprints=(), stride=25)
    touch = np.stack([e.tactile_kpa[:17] for e in heldout]).astype(np.float64)
    assert figures["tactile_mse_zero"] == pytest.approx((touch[:, 1:] ** 2).mean())
    assert figures["tactile_mse_copy"] == pytest.approx(((touch[:, 1:] - touch[:, :1]) ** 2).mean())
    assert figures["num_windows"] == 2


def test_invalid_touch_is_not_learned_from(tiny_model, toy_episodes):
    def loss(*, valid):
        windows = [episode.cut(WindowPosition(0, 0, 9)) for episode in toy_episodes]
        windows = [replace(w, tactile_valid=np.full((9, 2), valid)) for w in windows]
        batch = stack_windows(windows)
        return losses(tiny_model, batch, generator=torch.Generator().manual_seed(0))

    assert loss(valid=True).tactile > 0
    assert loss(valid=False).tactile == 0
    assert loss(valid=True).video == loss(valid=False).video


def test_the_learning_rate_warms_up_and_falls(toy_episodes, train_settings):
    settings = train_settings.optimizer
    options = TrainingRun(toy_episodes, train_settings).loop.options
    rates = [options.rate(step, step / 100) for step in range(101)]
    assert rates[0] < rates[5] < rates[10]
    assert max(rates) <= settings.learning_rate
    assert 0 < rates[-1] < 0.02 * settings.learning_rate
