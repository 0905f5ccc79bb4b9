"""Scenes, and splits that every store and every demonstrator share."""

from collections import Counter
from dataclasses import dataclass

import pytest

from dextouch.episodes import (
    SPLITS,
    is_in,
    scene_fraction,
    scene_of,
    split_by_scene,
    split_of,
    split_of_scene,
)
from dextouch.errors import InvalidInputError
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
            LineageEntry(kind="episode", id=name),
            LineageEntry(kind="checkpoint", id="model"),
        )
        changed = {"episode_id": f"imagined-{name}", "origin": "imagined", "lineage": lineage}
        imagined = source.model_copy(update=changed)
        assert scene_of(imagined) == scene_of(source) == f"{source.task}/{name}"
        assert split_of(imagined) == split_of(source)


def test_all_that_is_made_of_a_recording_is_one_scene(about):
    """Aligned again with other options, an episode has another id."""
    recording = LineageEntry(kind="recording", id="take-7", sha256="ab" * 32)
    first, again = (
        about.model_copy(update={"seed": None, "episode_id": name, "lineage": (recording,)})
        for name in ("take-7-1234", "take-7-5678")
    )
    source = LineageEntry(kind="episode", id="take-7-1234")
    imagined = first.model_copy(
        update={"episode_id": "new", "origin": "imagined", "lineage": (recording, source)}
    )
    scenes = {scene_of(one) for one in (first, again, imagined)}
    assert scenes == {f"{about.task}/{'ab' * 8}"}
    # Stations number their takes anew: ids alone may be equal.
    other = recording.model_copy(update={"sha256": "cd" * 32})
    assert scene_of(first.model_copy(update={"lineage": (other,)})) not in scenes


@pytest.mark.parametrize("splits", [(), SPLITS])
def test_all_splits_hold_every_episode(about, splits):
    assert is_in(about, splits)


@dataclass(frozen=True)
class Take:
    scene: str
    number: int = 0


def test_fractions_are_spread_evenly_and_depend_on_the_name_alone():
    fractions = [scene_fraction(f"stand_bottle/{seed}") for seed in range(3000)]
    # Of SHA-256("stand_bottle/0"), by `printf … | sha256sum`; it must never change.
    assert fractions[0] == pytest.approx(int("4a2ba8d05b391083", 16) / 2**64)
    deciles = Counter(int(10 * fraction) for fraction in fractions)
    # 3000 draws with p = 1/10: five standard deviations are 82.
    assert sorted(deciles) == list(range(10))
    assert all(abs(count - 300) < 82 for count in deciles.values())
    assert scene_fraction("stand_bottle/0", salt="other ") != fractions[0]


def test_a_split_keeps_every_scene_on_one_side():
    takes = [Take(f"stand_bottle/{seed}", number) for seed in range(60) for number in range(2)]
    training, held_out = split_by_scene(takes, held_out_share=0.3)
    assert len(training) + len(held_out) == 120
    assert 20 <= len(held_out) <= 52
    assert not {take.scene for take in training} & {take.scene for take in held_out}
    # Fewer or other episodes leave every scene where it was.
    fewer, _ = split_by_scene(takes[::-4], held_out_share=0.3)
    assert set(fewer) <= set(training)
    with pytest.raises(InvalidInputError, match="at least one each"):
        split_by_scene(takes[:2], held_out_share=0.3)
