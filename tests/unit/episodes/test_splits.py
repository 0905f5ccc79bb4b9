"""Splits of scenes: thirds that every store and every demonstrator share."""

from collections import Counter

import pytest

from dextouch.episodes import SPLITS, is_in, split_of, split_of_scene
from dextouch.schemas import LineageEntry

# First 8 bytes modulo 3: 2, 0, 0, 2, 0, 1.
GOLDEN = ["C", "A", "A", "C", "A", "B"]


@pytest.fixture
def about(made):
    return made.attributes


def test_a_third_each():
    tasks = ("stand_bottle", "stack_bowls", "open_drawer")
    counts = Counter(split_of_scene(task, seed) for task in tasks for seed in range(1000))
    assert set(counts) == set(SPLITS)
    # 3000 draws with p = 1/3: five standard deviations are 129.
    assert all(abs(count - 1000) < 130 for count in counts.values())


def test_golden_scenes():
    """Of SHA-256("split/stand_bottle/0") …, by `printf … | sha256sum`; they must never change."""
    assert [split_of_scene("stand_bottle", seed) for seed in range(6)] == GOLDEN


def test_a_scene_is_in_one_split_whoever_acts(about):
    others = (
        {"domain": "human", "episode_id": "other"},
        {"origin": "imagined", "success": None},
        {"instruction": "something else"},
    )
    assert {split_of(about.model_copy(update=one)) for one in others} == {split_of(about)}
    assert {split_of(about.model_copy(update={"seed": seed})) for seed in range(20)} == set(SPLITS)


def test_without_a_seed_imagined_episodes_follow_their_source(about):
    for name in ("take-1", "take-2", "take-3", "take-4"):
        source = about.model_copy(update={"seed": None, "episode_id": name})
        lineage = (
            LineageEntry(kind="recording", id="recording"),
            LineageEntry(kind="episode", id=name),
            LineageEntry(kind="checkpoint", id="model"),
        )
        changed = {"episode_id": f"imagined-{name}", "origin": "imagined", "lineage": lineage}
        assert split_of(source.model_copy(update=changed)) == split_of(source)


@pytest.mark.parametrize("splits", [(), SPLITS])
def test_all_splits_hold_every_episode(about, splits):
    assert is_in(about, splits)
