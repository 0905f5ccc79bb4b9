"""The judge with and without images and poses, true and imagined; and what it leaves undecided."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from dextouch.schemas import Observation, RolloutUncertainty, Uncertainty
from services.evaluation.classifier_calibration import fit_combinations
from services.evaluation.endings import Ending, EndingEpisode, milestones_of
from services.evaluation.success_classifier import (
    Calibration,
    ClassifierShape,
    Combination,
    SuccessClassifier,
    probe_batch,
)
from services.evaluation.success_classifier_training import (
    ClassifierSettings,
    labelled_endings,
    some_parts,
    train_success_classifier,
)
from tests.unit.evaluation import toy
from tests.unit.evaluation.shown_endings import ending_episode

pytestmark = pytest.mark.long

NEAR_M = 0.02


def _poses(task: str, seed: int, hand: np.ndarray) -> np.ndarray:
    """Target and hand as two objects that lie 50 mm high."""
    places = np.stack([toy.target_m(task, seed), hand])
    poses = np.zeros((3, 2, 7), np.float32)
    poses[:, :, :2], poses[:, :, 2], poses[:, :, 3] = places, 0.05, 1.0
    return poses


# Both kinds and several tests take the same ones.
@cache
def _demonstration(task: str, seed: int) -> toy.Demonstration:
    return toy.demonstration(task, seed, noise_m=0.03 * (seed % 3))


def _episode(task: str, seed: int, *, imagined: bool) -> EndingEpisode:
    """A toy episode with poses and a milestone; an imagined one has blurred images."""
    shown = _demonstration(task, seed)
    hands = shown.commanded[:, :2]
    plain = ending_episode(shown)
    noise = np.random.default_rng([7, seed]).normal(size=(3, 64, 3)) * 10 if imagined else 0.0
    endings = {
        step: replace(
            ending,
            images=_noisy(ending.images, noise) if imagined else ending.images,
            object_poses=_poses(task, seed, hands[step]),
            imagined=imagined,
        )
        for step, ending in plain.endings.items()
    }
    moved = np.flatnonzero(np.linalg.norm(hands, axis=1) > NEAR_M)
    times = {"moved": float(moved[0]) / 15} if len(moved) else {}
    return replace(
        plain,
        episode_id=f"{plain.episode_id}-{'imagined' if imagined else 'true'}",
        endings=endings,
        event_times_s={"begun": 0.0, **times} | ({"there": 4.0} if shown.success else {}),
    )


def _noisy(images: np.ndarray, noise: np.ndarray) -> np.ndarray:
    added = noise[:, : images.shape[1], None] * np.ones(images.shape[2])[:, None]
    return (images + added).clip(0, 255).astype(np.uint8)


def _episodes(seeds: range) -> list[EndingEpisode]:
    return [_episode(t, s, imagined=i) for t in toy.TASKS for s in seeds for i in (False, True)]


@pytest.fixture(scope="module")
def judge():
    settings = ClassifierSettings(num_training_steps=150, batch_size=32, learning_rate=3e-3)
    return SuccessClassifier(
        train_success_classifier(
            _episodes(range(45)),
            settings,
            command="a test",
            development=_episodes(range(600, 624)),
            held_out=_episodes(range(700, 724)),
        )
    )


@pytest.mark.parametrize(
    "seen",
    [{"object_poses": None}, {"images": None}, {}],
    ids=["images and touch", "poses and touch", "everything"],
)
@pytest.mark.parametrize("imagined", [False, True])
def test_it_is_right_with_and_without_poses_and_images(judge, seen, imagined):
    fresh = [_episode(t, s, imagined=imagined) for t in toy.TASKS for s in range(700, 724)]
    told = judge.probabilities([replace(e.final, **seen) for e in fresh]) >= 0.5
    assert np.mean(told == [e.success for e in fresh]) >= 0.85


def test_an_ending_with_images_and_poses_is_looked_at_twice(judge):
    whole = [_episode(t, 700, imagined=True).final for t in toy.TASKS]
    without_images = [replace(e, images=None) for e in whole]
    without_poses = [replace(e, object_poses=None) for e in whole]
    odds = judge.log_odds([*without_poses, *whole, *without_images])
    num = len(toy.TASKS)
    with torch.no_grad():
        network = judge._network(probe_batch(whole, judge.shape)).numpy()
    assert not np.allclose(network, odds[-num:], atol=0.1)
    np.testing.assert_allclose(odds[num : 2 * num], (network + odds[-num:]) / 2, atol=1e-4)
    # What has only one of them is seen once, whatever else is in the batch.
    alone = np.concatenate([judge.log_odds([e]) for e in (*without_poses, *without_images)])
    np.testing.assert_allclose(odds[[*range(num), *range(2 * num, 3 * num)]], alone, atol=1e-4)


def test_its_figures_of_every_kind_are_kept(judge):
    metrics = judge.metadata.metrics
    for task in toy.TASKS:
        for kind in ("", "poses_", "imagined_"):
            assert metrics[f"held_out_{kind}auc_{task}"] >= 0.85
            assert 0 <= metrics[f"held_out_{kind}ece_{task}"] <= 0.3
            assert metrics[f"held_out_{kind}brier_uncalibrated_{task}"] <= 0.3
    assert metrics["num_imagined_training_episodes"] == 90
    assert set(judge.metadata.settings["calibration"]) == {
        f"{task}/{kind}" for task in toy.TASKS for kind in ("true", "imagined")
    }


def test_classifiable_milestones_are_reported(judge):
    assert judge.shape.milestones["reach"] == ("begun", "moved", "there")
    # "begun" holds in every episode, so nothing shows that the judge can tell it.
    assert "there" in judge.metadata.settings["classifiable_milestones"]["reach"]
    assert "begun" not in judge.metadata.settings["classifiable_milestones"]["reach"]
    wins = [e for e in _episodes(range(700, 724)) if e.success and e.task == "reach"]
    told = [judge.verdict(e.final).milestones["there"] for e in wins]
    assert np.mean(told) > 0.7


def test_no_milestone_is_less_probable_than_success_which_needs_all(judge):
    ending = _episode("reach", 1, imagined=True).final
    for estimate in (0.02, 0.5, 0.98):
        verdict = judge.verdict(replace(ending, success_probability=estimate))
        assert min(verdict.milestones.values()) >= verdict.probability


def test_an_ending_with_neither_images_nor_poses_is_refused(judge):
    bare = replace(_episode("reach", 1, imagined=True).final, images=None, object_poses=None)
    with pytest.raises(InvalidInputError, match="neither images nor object poses"):
        judge.verdict(bare)


def test_it_cannot_tell_what_the_world_doubts(judge):
    ending = _episode("reach", 0, imagined=True).final
    plain = judge.verdict(ending)
    unreliable = judge.verdict(replace(ending, unreliable="the hands left the training data"))
    assert unreliable.decision == "cannot tell"
    assert unreliable.reason is not None
    assert "left the training data" in unreliable.reason
    assert unreliable.likely_success == plain.likely_success


def test_it_cannot_tell_within_its_band(judge):
    settings = judge.metadata.settings
    ending = _episode("reach", 0, imagined=False).final
    odds = float(judge.log_odds([ending])[0, 0])
    verdicts = {}
    for told, band in ((0.5, 0.0), (0.55, 0.04), (0.55, 0.06), (0.45, 0.06), (0.45, 0.04)):
        shift = float(np.log(told / (1 - told))) - odds
        calibration = {"reach/true": Calibration(bias=shift, band=band).model_dump()}
        metadata = judge.metadata.model_copy(
            update={"settings": {**settings, "calibration": calibration}}
        )
        probe = object.__new__(SuccessClassifier)
        probe.__dict__ |= judge.__dict__ | {
            "metadata": metadata,
            "_calibrations": {
                name: Calibration.model_validate(one) for name, one in calibration.items()
            },
        }
        verdicts[told, band] = probe.verdict(ending).decision
    assert list(verdicts.values()) == [
        "success", "success", "cannot tell", "cannot tell", "failure",
    ]  # fmt: skip


def _with_combination(judge, *, name="reach", **fields):
    """A probe of which only these fields of the combination are known, and no calibration."""
    probe = object.__new__(SuccessClassifier)
    combination = {name: Combination(**fields)} if fields else {}
    probe.__dict__ |= judge.__dict__ | {"_calibrations": {}, "_combinations": combination}
    return probe


def test_it_cannot_tell_where_the_world_itself_expects_the_opposite(judge):
    ending = _episode("reach", 0, imagined=True).final
    probe = _with_combination(judge)
    alone = probe.verdict(ending)
    assert (alone.world_probability, alone.decision) == (None, "success")
    # The shipped probes hold no combination.
    for world, decision in ((0.9, "success"), (0.5, "success"), (0.49, "cannot tell")):
        verdict = probe.verdict(replace(ending, success_probability=world))
        assert (verdict.decision, verdict.world_probability) == (decision, world)
    assert f"probability {alone.probability:.2f}, the world itself with 0.49" in verdict.reason
    tolerant = _with_combination(judge, margin=0.1)
    assert tolerant.verdict(replace(ending, success_probability=0.45)).decision == "success"
    assert tolerant.verdict(replace(ending, success_probability=0.35)).decision == "cannot tell"


def test_without_a_fit_only_what_both_are_sure_of_is_decided(judge):
    ending = replace(_episode("reach", 0, imagined=True).final, success_probability=0.7)
    probe = _with_combination(judge)
    probability, reason = probe._judged(ending, 0.8)
    # sqrt(0.8/0.2 · 0.7/0.3) = 3.055 to 1.
    assert probability == pytest.approx(3.055 / 4.055, abs=1e-3)
    assert "within 0.30 of 0.5" in reason
    assert probe._judged(ending, 0.9) == (pytest.approx(4.583 / 5.583, abs=1e-3), None)


def test_it_cannot_tell_within_the_band_of_both_estimates(judge):
    ending = replace(_episode("reach", 0, imagined=True).final, success_probability=0.7)
    # Of the world alone, so that its probability is that of the verdict.
    for band, decision in ((0.19, "success"), (0.21, "cannot tell")):
        probe = _with_combination(judge, probe_weight=0.0, world_weight=1.0, band=band)
        verdict = probe.verdict(ending)
        assert (verdict.probability, verdict.decision) == (pytest.approx(0.7), decision)
    assert "within 0.21 of 0.5" in verdict.reason
    # Uncertainty of the world comes first.
    unreliable = probe.verdict(replace(ending, unreliable="at step 8, slipped"))
    assert unreliable.reason == "the world flags its prediction: at step 8, slipped"


def test_objects_of_unusual_sizes_are_decided_by_their_own_combination(judge):
    ending = replace(_episode("reach", 0, imagined=True).final, success_probability=0.7)
    unusual = replace(ending, size_deviation=0.18)
    weights = {"probe_weight": 0.0, "world_weight": 1.0}
    usual = _with_combination(judge, **weights)
    assert usual.verdict(replace(ending, size_deviation=0.09)).decision == "success"
    verdict = usual.verdict(unusual)
    assert (verdict.decision, verdict.likely_success) == ("cannot tell", True)
    assert "differs by 18% from the usual" in verdict.reason
    fitted = _with_combination(judge, name="reach/unusual sizes", **weights, band=0.19)
    assert fitted.verdict(unusual).decision == "success"
    unreliable = fitted.verdict(replace(unusual, unreliable="at step 8, slipped"))
    assert unreliable.reason == "the world flags its prediction: at step 8, slipped"


def test_estimates_of_development_endings_are_fitted_and_kept_in_the_checkpoint():
    def estimated(seeds, *, sure):
        rng = np.random.default_rng(6)
        for item in _episodes(seeds):
            told = None
            if item.imagined:
                told = 0.9 if item.success else 0.1
                told = told if rng.random() < sure else 1 - told
            final = replace(item.final, success_probability=told)
            yield replace(item, endings={**item.endings, item.last_step: final})

    settings = ClassifierSettings(num_training_steps=2)
    checkpoint = train_success_classifier(
        _episodes(range(30)),
        settings,
        command="x",
        development=[*estimated(range(600, 660), sure=1.0)],
        held_out=_episodes(range(700, 712)),
    )
    # The probe has learned nothing in two steps, the world is always right.
    kept = checkpoint.metadata.settings["combination"]["reach"]
    assert kept["world_weight"] > 0.5
    ending = next(
        e for e in estimated(range(700, 706), sure=1.0) if e.imagined and e.task == "reach"
    )
    found = SuccessClassifier(checkpoint).verdict(ending.final)
    assert found.world_probability in {0.1, 0.9}
    unreliable = [
        replace(e, endings={**e.endings, e.last_step: replace(e.final, unreliable="slipped")})
        for e in estimated(range(600, 660), sure=1.0)
    ]
    probe = SuccessClassifier(checkpoint)
    assert fit_combinations(probe, unreliable, risk=0.1, margin=0.0) == {}
    assert fit_combinations(probe, _episodes(range(600, 660)), risk=0.1, margin=0.0) == {}


def test_processes_do_not_change_the_weights():
    torch.set_num_threads(2)
    one, two = (
        train_success_classifier(
            _episodes(range(30)),
            ClassifierSettings(num_training_steps=3),
            command="x",
            development=_episodes(range(600, 612)),
            held_out=_episodes(range(700, 712)),
            jobs=jobs,
        )
        for jobs in (1, 2)
    )
    assert one.tensors.keys() == two.tensors.keys()
    for name, tensor in one.tensors.items():
        assert torch.equal(tensor, two.tensors[name]), name


def test_a_world_that_is_wrong_about_unusual_sizes_decides_nothing_about_them():
    def estimated(item):
        is_unusual = int(item.scene.split("/")[1]) % 2 == 1
        told = 0.9 if item.success != is_unusual else 0.1
        final = replace(
            item.final,
            success_probability=told if item.imagined else None,
            size_deviation=0.2 if is_unusual else 0.02,
        )
        return replace(item, endings={**item.endings, item.last_step: final})

    development = [estimated(item) for item in _episodes(range(600, 720))]
    checkpoint = train_success_classifier(
        _episodes(range(30)),
        ClassifierSettings(num_training_steps=2),
        command="x",
        development=development,
        held_out=_episodes(range(800, 812)),
    )
    kept = checkpoint.metadata.settings["combination"]
    usual, unusual = kept["reach"], kept["reach/unusual sizes"]
    assert usual["world_weight"] > 0.5
    assert unusual["world_weight"] < 0.1
    assert (usual["band"], unusual["band"]) == (0.0, 0.5)


def test_an_ending_of_an_observation():
    steps = np.arange(5, dtype=np.float32)[:, None, None]
    seen = Observation(
        first_step=76,
        images={"camera_head": np.zeros((5, 32, 32, 3), np.uint8)},
        tactile_kpa=steps * np.ones((2, 320), np.float32),
        action_reached=np.zeros((5, 67)),
        reached_is_measured=False,
        object_poses=steps * np.ones((1, 7), np.float32),
        uncertainty=Uncertainty(disagreement=0, distance=1),
    )
    ending = Ending.of(seen, "reach", imagined=True)
    assert ending.tactile_kpa[:, 0, 0].tolist() == [2, 3, 4]
    assert ending.object_poses[:, 0, 0].tolist() == [2, 3, 4]
    assert ending.unreliable is None
    outside = replace(
        seen,
        images={},
        uncertainty=Uncertainty(disagreement=0, distance=9, outside=True, reason="far away"),
    )
    ending = Ending.of(outside, "reach", imagined=True)
    assert (ending.images, ending.unreliable) == (None, "at step 80, far away")
    whole = RolloutUncertainty(
        reason="slipped", step=16, success_probability=0.25, size_deviation=0.1
    )
    ending = Ending.of(outside, "reach", imagined=True, uncertainty=whole)
    assert (ending.unreliable, ending.success_probability) == ("at step 16, slipped", 0.25)
    assert (ending.size_deviation, ending.has_unusual_sizes) == (0.1, False)
    with pytest.raises(InvalidInputError, match="at least 3"):
        Ending.of(seen.last(), "reach", imagined=True)


def test_milestones_are_known_where_somebody_noted_them():
    plain = ending_episode(toy.demonstration("reach", 0))
    assert plain.reached(("there",), 80) is None
    noted = replace(plain, event_times_s={"there": 2.0, "begun": 0.0})
    assert noted.reached(("begun", "there", "never"), 30) == [True, True, False]
    assert noted.reached(("begun", "there", "never"), 29) == [True, False, False]
    assert milestones_of([noted, plain]) == {"reach": ("begun", "there")}


def test_true_and_imagined_endings_weigh_as_asked():
    episodes = _episodes(range(30))
    shape = ClassifierShape(
        tasks=toy.TASKS, image_size_px=toy.SIZE, milestones=milestones_of(episodes)
    )
    labelled = labelled_endings(episodes, shape, imagined_share=0.25)
    imagined = np.repeat([e.imagined for e in episodes], 4)
    share = labelled.weight[imagined].sum() / labelled.weight.sum()
    assert float(share) == pytest.approx(0.25, abs=1e-3)
    # In the middle only milestones are known.
    assert labelled.known[3].tolist() == [False, True, True, True]
    assert labelled.known[0].all()


def test_true_endings_are_learned_without_poses_and_imagined_ones_with_them():
    episodes = _episodes(range(30))
    shape = ClassifierShape(tasks=toy.TASKS, image_size_px=toy.SIZE)
    batch = labelled_endings(episodes, shape).batch
    generator, shares = torch.Generator().manual_seed(0), ((1.0, 0.0), (0.0, 1.0))
    seen = some_parts(
        batch, torch.ones(105), generator, without_poses=shares[0], without_images=shares[1]
    )
    assert not seen.has_objects[~batch.imagined].any()
    assert seen.has_image[~batch.imagined].all()
    assert seen.has_objects[batch.imagined].all()
    assert not seen.has_image[batch.imagined].any()
    assert batch.imagined.float().mean() == 0.5
