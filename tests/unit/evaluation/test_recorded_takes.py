"""Policies scored from recorded first observations, with the trust that replays earn."""

import dataclasses

import numpy as np
import pytest

from dextouch.clients.rollouts import RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.images import scaled_square
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.matched_starts import WorldAddress, start_digest
from services.evaluation.policies.open_loop import HoldPolicy
from services.evaluation.recorded_takes import (
    REPLAY,
    RecordedScores,
    _digests,
    read_takes,
    score_lines,
    score_recorded,
)
from services.evaluation.scores import RolloutScore
from services.evaluation.success_classifier import SuccessClassifier
from tests.unit.evaluation import toy, toy_store
from tests.unit.other_gloves import small_layout
from tests.unit.worlds.running import served

SEEDS = range(3000, 3012)


class Remembering(toy.ToyWorld):
    """Knows the target of every first observation, as a world that saw the image would."""

    def __init__(self, name, targets, **options):
        super().__init__(name, judge=False, **options)
        self.targets = targets

    def reset(self, start):
        seen = start.observation
        target = self.targets[start_digest(seen.images["camera_head"][0], seen.tactile_kpa[0])]
        return dataclasses.replace(super().reset(start), state=toy.ToyState(target, 0, seen))


@pytest.fixture(scope="module")
def items():
    """Half of the takes miss."""
    return [toy.demonstration("reach", s, noise_m=0.0 if s % 2 else 0.09) for s in SEEDS]


@pytest.fixture(scope="module")
def store(items, tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("takes"))
    for item in items:
        toy_store.write(store, item, seed=None, origin="recorded")
    unknown = dataclasses.replace(items[0], episode_id="unknown", success=None)
    toy_store.write(store, unknown, seed=None, origin="recorded")
    toy_store.write(store, dataclasses.replace(items[1], episode_id="dreamt"), origin="imagined")
    return store


@pytest.fixture(scope="module")
def client(items):
    targets = {item.start_digest: toy.target_m(item.task, item.seed) for item in items}
    worlds = {
        "right": Remembering("right", targets),
        "wrong": Remembering("wrong", targets, drift_m=0.06),
    }
    with served(create_world_app(worlds, WorldServiceSettings())) as url, RolloutClient(url) as it:
        yield it


@pytest.fixture(scope="module")
def probe(trained_probe):
    return SuccessClassifier(trained_probe)


def scored(store, client, probe, world, **options):
    takes = read_takes([store])
    (description,) = [one for one in client.worlds() if one.name == world]
    address = WorldAddress(client, world)
    return score_recorded(takes, {"hold": HoldPolicy()}, address, description, probe, **options)


def test_takes_are_true_episodes_of_known_outcome(store, items):
    takes = read_takes([store])
    assert {take.episode_id for take in takes} == {item.episode_id for item in items}
    by_id = {item.episode_id: item for item in items}
    for take in takes:
        item = by_id[take.episode_id]
        assert take.success == item.success
        np.testing.assert_allclose(take.actions, item.commanded[1:])
    assert len(read_takes([store], most=4)) == 4
    with pytest.raises(NotFoundError, match="no robot episode of stir"):
        read_takes([store], tasks=["stir"])


def test_takes_without_a_first_image_or_a_chunk_are_left_out(items, tmp_path):
    store, (late, short, kept) = EpisodeStore(tmp_path), items[:3]
    toy_store.write(store, late, shown=range(30, toy.STEPS))
    few = {name: getattr(short, name)[:4]
           for name in ("images", "tactile_kpa", "measured", "commanded")}  # fmt: skip
    toy_store.write(store, dataclasses.replace(short, **few), shown=range(4))
    toy_store.write(store, kept)
    assert [take.episode_id for take in read_takes([store], chunk_multiple=4)] == [kept.episode_id]


@pytest.mark.long
def test_a_right_world_earns_trust_and_a_wrong_one_does_not(store, client, probe, items):
    right, wrong = (scored(store, client, probe, name) for name in ("right", "wrong"))
    trusted, distrusted = right.trust("reach"), wrong.trust("reach")
    assert trusted["takes"] == len(SEEDS)
    assert trusted["real"] == np.mean([item.success for item in items])
    assert trusted["auc"] > 0.95
    assert trusted["auc_interval"][0] > 0.6
    assert trusted["wrong"] < 0.15
    assert distrusted["auc"] < 0.8
    row = right.policy_row("hold", "reach")
    assert row["rollouts"] == len(SEEDS)
    assert row["imagined"] < 0.3
    text = "\n".join(score_lines(right))
    assert "reach" in text
    assert "hold" in text
    report = right.to_report()
    assert len(report["rollouts"]) == 2 * len(SEEDS)
    assert {one["policy"] for one in report["rollouts"]} == {REPLAY, "hold"}


def test_undecided_replays_count_in_the_area_alone(store):
    takes = tuple(read_takes([store]))
    outcomes = tuple(
        RolloutScore(
            "imagined", REPLAY, "reach", take.start.seed, take.start.digest,
            success=take.success if index % 3 else not take.success,
            probability=0.9 if take.success else 0.1,
            cannot_tell=None if index % 3 else "vague",
        )
        for index, take in enumerate(takes)
    )  # fmt: skip
    found = RecordedScores(takes, outcomes, ()).trust("reach")
    assert (found["takes"], found["decided"], found["wrong"], found["auc"]) == (12, 8, 0.0, 1.0)


def test_with_few_takes_no_area_is_given(store, client, probe):
    takes = read_takes([store], most=6)
    (description,) = [one for one in client.worlds() if one.name == "right"]
    few = score_recorded(takes, {}, WorldAddress(client, "right"), description, probe)
    assert "auc" not in few.trust("reach")
    assert "too few takes" in "\n".join(score_lines(few))


def test_takes_that_were_trained_on_are_refused(store, client, probe):
    first = read_takes([store])[0]
    with pytest.raises(ConflictError, match="my policy"):
        scored(store, client, probe, "right", trained_on={"my policy": [first.start.digest]})


def test_a_start_is_known_by_what_a_world_shows_of_it_too(store, client, probe):
    """What was trained on imagined episodes alone has seen the scaled image."""
    first = read_takes([store])[0].start.observation
    large = np.repeat(np.repeat(first.images["camera_head"], 4, axis=1), 4, axis=2)
    take = read_takes([store])[0]
    seen = dataclasses.replace(first, images={"camera_head": large})
    start = dataclasses.replace(take.start, observation=seen)
    small = scaled_square(large, start.K_head, 64)[0][0]
    digests = _digests(start)
    assert digests[0] == start.digest
    assert digests[1] == start_digest(small, np.maximum(first.tactile_kpa[0], 0))


def test_robots_without_commands_replay_what_was_reached(tmp_path, items):
    store = EpisodeStore(tmp_path)
    toy_store.write(store, items[0], without=["action_commanded"], seed=None, origin="recorded")
    (take,) = read_takes([store])
    assert take.start.action_kind == "measured"
    np.testing.assert_allclose(take.actions, items[0].measured[1:])


def test_tasks_and_images_must_fit_world_and_judge(store, client, probe):
    takes = read_takes([store])
    (description,) = [one for one in client.worlds() if one.name == "right"]
    address = WorldAddress(client, "right")
    other = description.model_copy(update={"tasks": ("stir",)})
    with pytest.raises(InvalidInputError, match="'reach' is not one of the world"):
        score_recorded(takes, {}, address, other, probe)
    fast = description.model_copy(update={"model_rate_hz": 30.0})
    with pytest.raises(InvalidInputError, match="at 15 steps a second, expected 30"):
        score_recorded(takes, {}, address, fast, probe)
    larger = description.model_copy(update={"image_height_px": 64})
    with pytest.raises(InvalidInputError, match="images of 64 px"):
        score_recorded(takes, {}, address, larger, probe)
    small = description.model_copy(update={"tactile_layout": small_layout()})
    with pytest.raises(InvalidInputError, match=r"'right' 'small' .138 taxels"):
        score_recorded(takes, {}, address, small, probe)
