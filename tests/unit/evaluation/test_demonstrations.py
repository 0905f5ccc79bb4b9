"""Episodes of a store as arrays and pictures, and what is refused."""

import json

import numpy as np
import pytest

from dextouch.clients import PolicyStart
from dextouch.episodes import EpisodeStore, select_episodes
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from services.cli.main import run_command
from services.evaluation.command_line import run_train_judge
from services.evaluation.endings import read_ending_episodes
from services.evaluation.matched_starts import refuse_training_starts, start_digest
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.cloning_training import read_cloning_episodes
from services.evaluation.policies.open_loop import ReplayPolicy
from services.evaluation.reporting.pictures import action_picture, episode_picture
from services.evaluation.success_classifier import SuccessClassifier
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    folder = tmp_path_factory.mktemp("episodes")
    store = EpisodeStore(folder)
    for item in toy.demonstrations(range(12), noise_m=0.06):
        write(store, item)
    write(store, toy.demonstration("reach", 77, name="a-person"), domain="human")
    return str(folder)


def robot_episodes(*stores):
    return select_episodes(stores, domain="robot")


def test_robot_episodes_are_replayed_as_they_were_commanded(url):
    found = list(robot_episodes(EpisodeStore(url)))
    assert len(found) == 24
    policy = ReplayPolicy.of(found)
    item = toy.demonstration("reach far", 4, noise_m=0.06)
    policy.reset(PolicyStart(item.task, "", item.seed, toy.ANCHOR, toy.K_HEAD))
    world = toy.ToyWorld("judge", judge=True)
    seen = world.reset(toy.RolloutStart(item.task, item.seed, "")).observation
    np.testing.assert_allclose(policy.act(seen), item.commanded[1:17], atol=1e-12)


def test_a_start_is_replayed_from_one_episode_of_known_seed(tmp_path):
    store = EpisodeStore(tmp_path)
    for name in ("once", "twice"):
        write(store, toy.demonstration("reach", 4, name=name), shown=[0], success=None)
    with pytest.raises(ConflictError, match="seed 4"):
        ReplayPolicy.of(robot_episodes(store))
    write(store, toy.demonstration("reach", 5, name="no-seed"), seed=None)
    with pytest.raises(InvalidInputError, match="no-seed"):
        ReplayPolicy.of([store.open("no-seed")])


# What `dextouch train data --images 4` draws.
SPARSE = [*range(0, 77, 4), 78, 79, 80]


def test_the_last_three_steps_of_sparse_images_are_enough_for_the_probe(tmp_path):
    store = EpisodeStore(tmp_path)
    item = toy.demonstration("reach", 2)
    write(store, item, shown=SPARSE)
    (episode,) = read_ending_episodes(store)
    np.testing.assert_array_equal(episode.final.images, item.images[[78, 79, 80]])
    assert episode.start_digest == item.start_digest
    # Steps of which there are neither images nor poses are left out, not shown by others' images.
    assert set(episode.endings) == {80}


def test_takes_whose_end_shows_nothing_are_left_out(tmp_path):
    store = EpisodeStore(tmp_path)
    write(store, toy.demonstration("reach", 2), shown=SPARSE)
    write(store, toy.demonstration("reach", 4), shown=range(40))
    assert [one.episode_id for one in read_ending_episodes(store)] == ["reach-2-0"]


def test_pictures_of_an_episode(url):
    reader = EpisodeStore(url).open("reach-3-0")
    picture = episode_picture(reader, num_moments=5)
    assert picture.times_s == pytest.approx([0, 20 / 15, 40 / 15, 60 / 15, 80 / 15])
    assert picture.title == "reach, robot, twin: success"
    np.testing.assert_array_equal(picture.images[-1], toy.demonstration("reach", 3).images[-1])
    actions = action_picture(reader)
    assert actions.measured.shape == actions.commanded.shape == (toy.STEPS, 67)


@pytest.mark.long
def test_the_probe_can_be_trained_from_the_command_line(url, tmp_path, capsys):
    output, figures = tmp_path / "probe.safetensors", tmp_path / "figures.json"
    flags = ["--episodes", url, "--output", str(output), "--json", str(figures)]
    training = ["--training.num-training-steps", "3", "--training.held-out-share", "0.5"]
    training += ["--training.development-share", "0.2"]
    assert run_command(["train", "judge", *flags, *training]) == 0
    assert "held_out_accuracy" in capsys.readouterr().out
    probe = SuccessClassifier.load(output)
    assert probe.metadata.settings["instructions"] == toy.INSTRUCTIONS
    assert json.loads(figures.read_text())["metrics"] == probe.metadata.metrics
    assert probe.metadata.command.startswith("dextouch train judge --episodes ")


@pytest.mark.long
@pytest.mark.parametrize(
    ("network", "trained"), [("judge", SuccessClassifier), ("policy", BehaviourCloningPolicy)]
)
def test_what_a_station_recorded_can_be_trained_on(network, trained, tmp_path):
    store = EpisodeStore(tmp_path / "recorded")
    for item in toy.demonstrations(range(40), noise_m=0.03):
        write(store, item, shown=SPARSE, origin="recorded", seed=None)
    output = tmp_path / "trained.safetensors"
    flags = ["--episodes", str(store.root), "--output", str(output)]
    training = ["--training.num-training-steps", "3", "--training.held-out-share", "0.4"]
    assert run_command(["train", network, *flags, *training]) == 0
    assert set(trained.load(output).metadata.training_episodes) <= set(store.list())


@pytest.mark.long
def test_a_judge_that_nothing_would_measure_is_refused_before_it_is_trained(tmp_path):
    store = EpisodeStore(tmp_path / "recorded")
    for item in toy.demonstrations(range(40), noise_m=0.03):
        write(store, item)
    flags = ["--episodes", str(store.root), "--output", str(tmp_path / "judge.safetensors")]
    with pytest.raises(InvalidInputError, match=r"are held out.* --training\.held-out-share"):
        run_train_judge([*flags, "--training.held-out-share", "0.02"])


@pytest.mark.long
def test_policies_can_be_trained_from_the_command_line(url, tmp_path, capsys):
    output = tmp_path / "policy.safetensors"
    training = ["--training.num-training-steps", "4", "--training.held-out-share", "0.5"]
    flags = ["--episodes", url, "--output", str(output), "--early-at", "0.5"]
    assert run_command(["train", "policy", *flags, *training]) == 0
    assert capsys.readouterr().out.count("wrist_error_mm_of_mean_chunk ") == 2
    finished, early = (
        BehaviourCloningPolicy.load(path)
        for path in (output, tmp_path / "policy_early.safetensors")
    )
    assert finished.metadata.settings["instructions"] == toy.INSTRUCTIONS
    assert early.metadata.settings["share_of_training"] == 0.5
    assert finished.metadata.training_starts == early.metadata.training_starts


def test_robots_without_commands_teach_the_poses_that_they_reached(tmp_path):
    store, item = EpisodeStore(tmp_path), toy.demonstration("reach", 3)
    write(store, item, without=["action_commanded"], origin="recorded", seed=None)
    (episode,) = read_cloning_episodes(store)
    np.testing.assert_allclose(episode.commanded, item.measured)


def test_policies_learn_from_images_of_every_eighth_step(tmp_path):
    store = EpisodeStore(tmp_path)
    item = toy.demonstration("reach", 1)
    write(store, item, shown=SPARSE)
    write(store, toy.demonstration("reach", 2, name="failed"), success=False)
    (episode,) = read_cloning_episodes(store)
    assert episode.start_digest == item.start_digest
    assert sorted(episode.moments) == list(range(0, 81, 8))
    for step, moment in episode.moments.items():
        np.testing.assert_array_equal(moment.image, item.images[step])
        np.testing.assert_allclose(moment.tactile_kpa, item.tactile_kpa[step])
    for name in ("measured", "commanded"):
        np.testing.assert_allclose(getattr(episode, name), getattr(item, name), atol=1e-12)
    sparser = EpisodeStore(tmp_path / "sparser")
    write(sparser, toy.demonstration("reach", 3), shown=range(0, 81, 6))
    with pytest.raises(NotFoundError, match=r"1 without an image of every 8th step .*--images 8"):
        read_cloning_episodes(sparser)


def test_the_command_line_refuses_clearly():
    with pytest.raises(InvalidInputError, match="FIRST:LAST"):
        run_command(["evaluate", "--seeds", "9:3"])
    with pytest.raises(InvalidInputError, match="episodes"):
        run_command(["train", "policy"])
    with pytest.raises(InvalidInputError, match="early_at"):
        run_command(["train", "policy", "--episodes", "x", "--early-at", "1.5"])


def test_starts_are_told_apart_by_image_and_touch():
    item = toy.demonstration("reach", 0)
    image, taxels = item.images[0], item.tactile_kpa[0]
    digest = start_digest(image, taxels)
    assert digest == start_digest(image.copy(), taxels.copy())
    brighter, touched = image.copy(), taxels.copy()
    brighter[3, 4, 1] ^= 1
    touched[1, 9] += 0.01
    assert len({digest, start_digest(brighter, taxels), start_digest(image, touched)}) == 3
    refuse_training_starts([digest], trained_on=["something else"], what="a probe")
    with pytest.raises(ConflictError, match="1 starts were trained on by a probe"):
        refuse_training_starts([digest], trained_on=[digest], what="a probe")
