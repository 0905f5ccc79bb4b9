"""Human and robot episodes are mixed in the share asked for, and their tasks are kept apart."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore, data_hash
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.serving import load_settings
from services.world_model.checkpoints import read_checkpoint
from services.world_model.command_line import run_adapt
from services.world_model.network.configuration import NetworkConfig
from services.world_model.paper_settings import (
    AdaptCommand,
    TrainCommand,
    TrainSettings,
    command_line,
)
from services.world_model.training.episode_sets import check_tasks, load_split, subset_by_hash
from services.world_model.training.joint_dataset import WindowSampler
from services.world_model.training.joint_trainer import train
from tests.unit.world_model.conftest import PX, human_episode, make_episode, write_episode


@pytest.fixture
def settings(toy_store, human_store, train_settings):
    return train_settings.model_copy(
        update={
            "human": (str(human_store.root),),
            "heldout_percent": 50,
            "human_share": 0.5,
            "human_episodes": 3,
            "max_steps": 2,
            "cpu_budget_s": 1e6,
        }
    )


def sampler(episodes, share, seed=0):
    return WindowSampler(episodes, np.random.default_rng(seed), max_steps=17, human_share=share)


def test_windows_come_from_both_domains_in_the_share_asked_for():
    episodes = [make_episode(0), human_episode(100), *(make_episode(seed) for seed in (1, 2))]
    episodes += [human_episode(101)]
    num = 6000
    for share in (0.0, 0.3, 1.0):
        places = sampler(episodes, share).places(num, 17)
        counts = np.bincount([place.episode_index for place in places], minlength=5)
        # Two human episodes share theirs evenly, three robot ones the rest.
        robot, human = (1 - share) / 3, share / 2
        expected = np.array([robot, human, robot, robot, human])
        deviation = np.sqrt(num * expected * (1 - expected))
        assert (np.abs(counts - num * expected) <= 4 * deviation).all(), (share, counts)
        # People command nothing.
        kinds = {episodes[p.episode_index].domain for p in places if p.action_kind == "commanded"}
        assert kinds <= {"robot"}


def test_without_a_share_or_a_second_domain_every_episode_is_as_likely_as_ever():
    robots = [make_episode(seed) for seed in range(3)]
    drawn = sampler([*robots, human_episode(100)], None, seed=5).places(50, 9)
    rng = np.random.default_rng(5)
    for place in drawn:
        assert place.episode_index == rng.integers(4)
        assert place.start == rng.integers(41 - 9 + 1)
        rng.random(2)
    assert sampler(robots, 0.5, seed=5).places(50, 9) == sampler(robots, None, seed=5).places(50, 9)


def test_larger_subsets_contain_smaller_ones_in_any_order():
    episodes = [make_episode(seed) for seed in range(9)]
    subsets = [
        {e.episode_id for e in subset_by_hash(some, count, what="robot")}
        for some in (episodes, episodes[::-1])
        for count in (1, 3, 8)
    ]
    assert subsets[:3] == subsets[3:]
    assert subsets[0] < subsets[1] < subsets[2]
    # What is added or removed elsewhere changes nothing about the rest.
    fewer = {e.episode_id for e in subset_by_hash(episodes[:7], 3, what="robot")}
    assert fewer >= subsets[1] & {e.episode_id for e in episodes[:7]}
    assert subset_by_hash(episodes, None, what="robot") == episodes
    assert subset_by_hash(episodes, 0, what="human") == []
    with pytest.raises(InvalidInputError, match="got 10 as the number of robot"):
        subset_by_hash(episodes, 10, what="robot")


@pytest.mark.long
@pytest.mark.parametrize("streaming", [False, True])
def test_subsets_of_both_domains_leave_the_held_out_robots_as_they_are(settings, streaming):
    settings = settings.model_copy(update={"streaming": streaming})
    plain = settings.model_copy(update={"human": (), "human_episodes": None})
    robots, heldout = load_split(plain)
    trained, same = load_split(settings.model_copy(update={"robot_episodes": 1}))
    assert [e.episode_id for e in same] == [e.episode_id for e in heldout]
    assert {e.domain for e in heldout} == {"robot"}
    of = {d: [e.episode_id for e in trained if e.domain == d] for d in ("robot", "human")}
    assert (len(of["robot"]), len(of["human"])) == (1, 3)
    assert set(of["robot"]) < {e.episode_id for e in robots}
    more, _ = load_split(settings.model_copy(update={"human_episodes": 4}))
    assert set(of["human"]) < {e.episode_id for e in more}
    none, _ = load_split(settings.model_copy(update={"human_episodes": 0}))
    assert [e.episode_id for e in none] == [e.episode_id for e in robots]
    # The held-out store may have human episodes, too; they are not evaluated on.
    given = settings.model_copy(update={"heldout": settings.human[0]})
    assert [e.episode_id for e in load_split(given)[1]] == ["toy-50"]


@pytest.mark.long
@pytest.mark.parametrize("streaming", [False, True])
def test_no_episode_counts_twice_and_all_have_one_rate(settings, tmp_path, streaming):
    settings = settings.model_copy(update={"streaming": streaming, "human_episodes": None})
    same, other = EpisodeStore(tmp_path / "same"), EpisodeStore(tmp_path / "other")
    write_episode(same, human_episode(100))
    write_episode(other, replace(human_episode(110), model_rate_hz=30.0))
    for store, message in ((same, "human-100"), (other, r"rates of \[15.0, 30.0\]")):
        human = (*settings.human, str(store.root))
        with pytest.raises(ConflictError, match=message):
            load_split(settings.model_copy(update={"human": human}))


def test_tasks_that_people_and_robots_share_are_refused_unless_allowed(settings):
    robots, heldout = [make_episode(0)], [make_episode(1)]
    people = [human_episode(100), human_episode(101, task="push_box")]
    check_tasks([*robots, people[0], *heldout], settings)
    with pytest.raises(InvalidInputError, match=r"tasks \['push_box'\].*--no-disjoint-tasks"):
        check_tasks([*robots, *people, *heldout], settings)
    with pytest.raises(InvalidInputError, match="push_box"):
        check_tasks([*people, *heldout], settings)
    allowed = settings.model_copy(update={"disjoint_tasks": False})
    check_tasks([*robots, *people, *heldout], allowed)


def test_people_in_held_out_scenes_are_not_trained_on(settings, tmp_path):
    _, heldout = load_split(settings)
    store = EpisodeStore(tmp_path / "people")
    for number, one in enumerate((heldout[0], make_episode(777))):
        human = replace(human_episode(120 + number), task=one.task, scene=one.scene)
        write_episode(store, human)
    given = {"human": (str(store.root),), "human_episodes": None, "disjoint_tasks": False}
    trained, _ = load_split(settings.model_copy(update=given))
    assert not {one.scene for one in trained} & {one.scene for one in heldout}
    assert [one.scene for one in trained if one.domain == "human"] == ["push_box/777"]


@pytest.mark.long
def test_a_checkpoint_proves_what_it_was_trained_on(settings):
    report = train(settings.model_copy(update={"max_steps": 1}))
    trained, heldout = load_split(settings)
    metadata = read_checkpoint(report.checkpoint).metadata
    found = {(one.domain, one.heldout): one for one in metadata.sets}
    for (domain, held), episodes in {
        ("robot", False): [e for e in trained if e.domain == "robot"],
        ("human", False): [e for e in trained if e.domain == "human"],
        ("robot", True): heldout,
    }.items():
        one = found.pop((domain, held))
        task = "fold_cloth" if domain == "human" else "push_box"
        assert one.tasks == {task: len(episodes)}
        assert one.data_hash == data_hash((e.content_sha256 for e in episodes), image_px=PX)
        assert one.window_share == (None if held else 0.5)
    assert not found
    assert "--human=human" in metadata.command
    assert "--human-episodes=3" in metadata.command


@pytest.mark.long
def test_an_adapted_checkpoint_has_new_tasks_the_ancestors_codecs_and_its_history(
    settings, tmp_path, capsys
):
    first = train(settings.model_copy(update={"max_steps": 1}))
    ancestor = read_checkpoint(first.checkpoint)
    new, people = EpisodeStore(tmp_path / "new"), EpisodeStore(tmp_path / "new_human")
    for seed in range(200, 204):
        write_episode(new, replace(make_episode(seed), episode_id=f"r{seed}", task="pour"))
    for seed in range(210, 213):
        write_episode(people, human_episode(seed, task="pour"))
    output, summary = tmp_path / "adapted.safetensors", tmp_path / "report.json"
    argv = [
        f"--init={first.checkpoint}", f"--output={output}", f"--json={summary}", "--max-steps=2",
        "--human-episodes=2", "--heldout-percent=50", "--optimizer.batch=2",
    ]  # fmt: skip
    mixed = [f"--episodes={new.root}", f"--human={people.root}"]
    assert run_adapt([*argv, *mixed]) == 0
    capsys.readouterr()
    assert json.loads(summary.read_text())["steps"] == 2
    adapted = read_checkpoint(output)
    assert adapted.metadata.network == settings.network
    assert adapted.metadata.initialized_from == first.digest
    assert "--init=model.safetensors" in adapted.metadata.command
    # A tenth of the usual rate, though another setting of the optimizer was given.
    assert "--optimizer.learning-rate=0.0002" in adapted.metadata.command
    learned = {name for name, _ in ancestor.model.named_parameters()}
    moved = adapted.model.state_dict()
    changed = {
        name
        for name, tensor in ancestor.model.state_dict().items()
        if not torch.equal(tensor, moved[name])
    }
    assert changed
    assert changed <= learned
    assert [(one.checkpoint, one.domain, one.tasks) for one in adapted.metadata.sets[:3]] == [
        (first.digest, one.domain, one.tasks) for one in ancestor.metadata.sets
    ]
    own = [one for one in adapted.metadata.sets if one.checkpoint is None]
    assert [(one.domain, one.heldout) for one in own] == [
        ("human", False), ("robot", False), ("robot", True)
    ]  # fmt: skip
    assert all(one.tasks.keys() == {"pour"} for one in own)
    with pytest.raises(InvalidInputError, match=r"trained on tasks \['push_box'\]"):
        run_adapt([*argv, f"--episodes={settings.episodes}", f"--human={people.root}"])
    with pytest.raises(InvalidInputError, match=r"\['fold_cloth'\].*--no-new-tasks"):
        run_adapt([*argv, f"--episodes={new.root}", f"--human={settings.human[0]}"])


def test_the_settings_of_an_adaptation_are_those_of_a_training():
    flags = [
        "--init=a.safetensors",
        "--episodes=new",
        "--robot-episodes=200",
        "--optimizer.batch=4",
    ]
    settings = load_settings(AdaptCommand, flags)
    network = NetworkConfig(video_width=16)
    training = settings.training(network)
    words = command_line(training).split()
    again = load_settings(TrainCommand, [*words[3:], "--output", str(settings.output)])
    assert again.model_dump(include=set(TrainSettings.model_fields)) == training.model_dump()
