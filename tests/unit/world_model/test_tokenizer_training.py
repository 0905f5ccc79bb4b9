"""Pretraining of tactile tokenizers, and world models that keep them frozen."""

import pytest
import torch

from dextouch.episodes import EpisodeReader
from dextouch.errors import ConflictError, InvalidInputError
from services.networks.optimizer import Budget
from services.world_model.checkpoints import read_checkpoint, read_tokenizer
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile import build_tokenizer
from services.world_model.paper_settings import TrainTokenizerSettings
from services.world_model.training.episode_sets import load_split
from services.world_model.training.joint_trainer import train_on
from services.world_model.training.tokenizer_trainer import (
    TactileHands,
    load_hands,
    reconstruction,
    reconstruction_loss,
    train_tokenizer,
)


@pytest.fixture
def settings(toy_store, tmp_path):
    return TrainTokenizerSettings(
        episodes=(str(toy_store.root),),
        output=tmp_path / "tokenizer.safetensors",
        max_steps=4,
        num_evaluations=2,
        heldout_share=0.15,
        tactile_channels=48,
        optimizer={"batch": 8},
    )


def test_taxels_in_contact_weigh_more():
    torch.manual_seed(0)
    tokenizer = build_tokenizer(NetworkConfig(tokenizer="split_hands"))
    touch = torch.tensor([0.0, 0.5, 1.999, 2.0, 2.001, 90.0]).repeat(2, 54)[:, :320]
    decoded = tokenizer.roots(tokenizer.encode(touch)).detach()
    total, weights = 0.0, 0.0
    for hand in range(2):
        for taxel in range(320):
            kpa = float(touch[hand, taxel])
            weight = 7.0 if kpa >= 2.0 else 1.0
            total += weight * (float(decoded[hand, taxel]) - kpa**0.5) ** 2
            weights += weight
    loss = reconstruction_loss(tokenizer, touch, contact_weight=7.0)
    assert loss.item() == pytest.approx(total / weights, rel=1e-5)


def test_figures_are_those_of_a_plain_count():
    tokenizer = build_tokenizer(NetworkConfig(tokenizer="principal_axes", palm_channels=2))
    touch = torch.rand(40, 2, 320) * 5
    tokenizer.fit(touch)
    hands = touch[:3, 0].numpy()
    budget = Budget()
    budget.step = 12
    point = reconstruction(tokenizer, TactileHands(hands, ("a",), "0"), budget)
    decoded = tokenizer.decode(tokenizer.encode(touch[:3, 0])).numpy()
    both = either = squared = absolute = 0.0
    for true, predicted in zip(hands.ravel(), decoded.ravel(), strict=True):
        both += true >= 2 and predicted >= 2
        either += true >= 2 or predicted >= 2
        squared += (float(true) - float(predicted)) ** 2
        absolute += abs(float(true) - float(predicted))
    assert 0 < both < either
    assert point.step == 12
    assert point.contact_iou == pytest.approx(both / either)
    assert point.contact_f1 == pytest.approx(2 * both / (both + either))
    assert point.mse_kpa2 == pytest.approx(squared / hands.size, rel=1e-4)
    assert point.mae_kpa == pytest.approx(absolute / hands.size, rel=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("name", ["split_hands", "grid"])
def test_a_short_training_brings_touch_back(name, settings):
    report = train_tokenizer(
        settings.model_copy(update={"tokenizer": name, "max_steps": 60, "tactile_channels": 96})
    )
    first, last = report.metadata.curve[0], report.metadata.curve[-1]
    assert last.mse_kpa2 < 0.1 * first.mse_kpa2
    assert last.contact_iou > 0.6


@pytest.mark.slow
def test_a_run_repeats_and_keeps_scenes_apart(settings, tmp_path):
    points = []
    report = train_tokenizer(settings, lambda share, point: points.append((share, point)))
    about = report.metadata
    assert [point.step for point in about.curve] == [0, 2, 4]
    assert [share for share, _ in points] == [0.0, 0.5, 1.0]
    assert tuple(point for _, point in points) == about.curve
    # Six scenes of 41 steps and two hands.
    num_training = len(about.train_scenes)
    assert 0 < num_training < 6
    assert about.num_training_hands == 82 * num_training
    assert about.num_heldout_hands == 82 * (6 - num_training)
    again = train_tokenizer(settings.model_copy(update={"output": tmp_path / "b.safetensors"}))
    for name, tensor in read_tokenizer(again.checkpoint).tokenizer.state_dict().items():
        assert torch.equal(tensor, read_tokenizer(settings.output).tokenizer.state_dict()[name])
    other = train_tokenizer(settings.model_copy(update={"seed": 1, "output": tmp_path / "c"}))
    assert other.metadata.curve[0] != about.curve[0]


def test_principal_axes_take_no_steps(settings):
    report = train_tokenizer(settings.model_copy(update={"tokenizer": "principal_axes"}))
    assert report.metadata.training_steps == 0
    assert len(report.metadata.curve) == 1
    assert report.metadata.curve[0].contact_iou > 0.9


@pytest.mark.parametrize("tokens", ["hand", "pad"])
@pytest.mark.slow
def test_the_world_model_keeps_the_tokenizer_frozen(settings, train_settings, toy_episodes, tokens):
    trained = train_tokenizer(settings)
    learned = set(trained.metadata.train_scenes)
    unseen = [e for e in toy_episodes if e.scene not in learned]
    seen = [e for e in toy_episodes if e.scene in learned]
    # Like flags: nothing but the form of the tokens is asked for, the file decides the rest.
    given = train_settings.network.model_dump(exclude_unset=True, exclude={"palm_channels"})
    network = NetworkConfig(**given, tactile_tokens=tokens)
    asked = train_settings.model_copy(
        update={"network": network, "tokenizer": settings.output, "max_steps": 3}
    )
    report = train_on(seen, unseen[:1], asked)
    checkpoint = read_checkpoint(report.checkpoint)
    assert checkpoint.metadata.tokenizer_digest == trained.digest
    assert checkpoint.metadata.network.tokenizer == "split_hands"
    assert checkpoint.model.tokenizer.num_tokens == (6 if tokens == "pad" else 1)
    kept = read_tokenizer(settings.output).tokenizer.state_dict()
    for name, tensor in checkpoint.model.tokenizer.state_dict().items():
        if name != "peak_kpa":
            assert torch.equal(tensor, kept[name]), name
    peak_kpa = max(float(kept["peak_kpa"]), *(float(e.tactile_kpa.max()) for e in seen))
    assert float(checkpoint.model.tokenizer.peak_kpa) <= peak_kpa
    with pytest.raises(InvalidInputError, match="trained on the scenes of 1 held-out"):
        train_on(unseen, seen[:1], asked)


def test_a_learned_tokenizer_needs_its_file(train_settings, toy_episodes, tmp_path):
    network = train_settings.network.model_copy(update={"tokenizer": "grid"})
    asked = train_settings.model_copy(update={"network": network})
    with pytest.raises(InvalidInputError, match="--tokenizer"):
        train_on(toy_episodes[:4], toy_episodes[4:], asked)
    both = asked.model_copy(update={"tokenizer": tmp_path / "a", "init": tmp_path / "b"})
    with pytest.raises(InvalidInputError, match="expected one of them"):
        train_on(toy_episodes[:4], toy_episodes[4:], both)


@pytest.mark.long
def test_the_file_decides_the_network(settings):
    about = train_tokenizer(settings).metadata
    network = about.network(NetworkConfig(video_width=16))
    assert (network.tokenizer, network.tactile_channels) == ("split_hands", 48)
    assert network.video_width == 16
    with pytest.raises(ConflictError, match="'tactile_channels': \\(48, 96\\)"):
        about.network(NetworkConfig(tactile_channels=96))


def test_both_sides_need_a_scene(settings):
    with pytest.raises(InvalidInputError, match="0 held out"):
        train_tokenizer(settings.model_copy(update={"heldout_share": 1e-9}))


def test_hands_without_a_measurement_are_left_out(toy_store, monkeypatch):
    whole = EpisodeReader.touch

    def with_gap(reader, *places):
        tactile_kpa, tactile_valid = whole(reader, *places)
        tactile_valid[:5, 0] = False
        return tactile_kpa, tactile_valid

    monkeypatch.setattr(EpisodeReader, "touch", with_gap)
    training, heldout = load_hands([str(toy_store.root)], heldout_share=0.15)
    assert len(training.tactile_kpa) + len(heldout.tactile_kpa) == 6 * (2 * 41 - 5)
    assert not set(training.scenes) & set(heldout.scenes)


def test_training_without_any_touch_is_refused(settings):
    # Only the scenes 0 and 3 remain, in which nothing is touched.
    with pytest.raises(InvalidInputError, match="that touch nothing"):
        train_tokenizer(settings.model_copy(update={"heldout_share": 0.5}))


@pytest.mark.long
@pytest.mark.parametrize("streaming", [False, True])
def test_one_store_trains_both_and_other_scenes_are_held_out(settings, train_settings, streaming):
    trained = train_tokenizer(settings)
    asked = train_settings.model_copy(
        update={
            "network": NetworkConfig(
                **train_settings.network.model_dump(exclude_unset=True, exclude={"palm_channels"})
            ),
            "tokenizer": settings.output,
            "streaming": streaming,
            "heldout_percent": 20,
        }
    )
    episodes, heldout = load_split(asked)
    # The two scenes that the tokenizer has not seen have a third of the episodes.
    assert {e.scene for e in heldout} == {"push_box/1", "push_box/4"}
    assert {e.scene for e in episodes} == set(trained.metadata.train_scenes)
    _, fewer = load_split(asked.model_copy(update={"heldout_percent": 5}))
    assert [e.scene for e in fewer] == ["push_box/1"]
    with pytest.raises(InvalidInputError, match="give a --heldout store"):
        load_split(asked.model_copy(update={"splits": ("A",)}))


def test_a_network_without_touch_needs_no_tokenizer(settings, train_settings, toy_episodes):
    network = train_settings.network.model_copy(update={"use_touch": False})
    asked = train_settings.model_copy(update={"network": network, "tokenizer": settings.output})
    with pytest.raises(InvalidInputError, match="without touch"):
        train_on(toy_episodes[:4], toy_episodes[4:], asked)
