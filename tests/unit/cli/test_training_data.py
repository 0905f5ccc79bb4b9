"""Mixed training data: shares as asked, the same every time, resumable; policies in the twin."""

import json
from collections import Counter

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import ClockFitError, InvalidInputError, UnknownNameError
from dextouch.jobs import Workers
from services.pipelines import training_data
from services.pipelines.training_data import PolicyChoice, Scope, make_training_data
from services.twin.mistakes import TRAINING
from services.twin.take_options import MIXES, STRENGTHS, Mix, options_of


def drawn(mix, seeds=2000, task="stand_bottle"):
    return [options_of(task, seed, mix) for seed in range(seeds)]


def kind_of(options):
    if options.miss:
        return "miss"
    if options.mistakes:
        return "mistaken"
    if options.motion is not None:
        return options.motion.kind
    if options.actions_of_seed is not None:
        return "other_scene"
    if options.frozen_from_step is not None:
        return "frozen" if options.frozen_from_step else "hold"
    return "script"


def test_episodes_are_the_same_every_time_and_differ_between_tasks():
    mix = MIXES["evaluator"]
    assert drawn(mix, 50) == drawn(mix, 50)
    # Two names of one length.
    assert drawn(mix, 50, "place_shoes") != drawn(mix, 50, "place_phone")


def test_the_evaluators_mix_has_what_decides():
    options = drawn(MIXES["evaluator"])
    shares = {kind: count / 2000 for kind, count in Counter(map(kind_of, options)).items()}
    expected = {
        "script": 0.22, "miss": 0.04, "frozen": 0.02, "hold": 0.02, "retreat": 0.02,
        "push": 0.02, "slip": 0.02, "other_scene": 0.02, "wander": 0.01, "mistaken": 0.61,
    }  # fmt: skip
    assert set(shares) == set(expected)
    for kind, share in expected.items():
        # Three standard deviations of 2000 draws.
        assert abs(shares[kind] - share) < 3 * (share * (1 - share) / 2000) ** 0.5, kind
    scripts_m = np.array([o.noise_m for o in options if kind_of(o) == "script"])
    assert 0.15 < (scripts_m == 0).mean() < 0.27
    assert 0.40 < ((scripts_m > 0) & (scripts_m <= 0.012)).mean() < 0.65
    assert 0.035 < scripts_m.max() <= 0.040
    steps = [o.motion.from_step for o in options if kind_of(o) == "slip"]
    assert 18 <= min(steps) < max(steps) <= 50
    mistakes = [m for o in options for m in o.mistakes]
    assert {m.kind for m in mistakes} == set(TRAINING)
    assert max(m.strength for m in mistakes) <= STRENGTHS["stand_bottle"]
    assert all(o.actions_of_seed < 10_000 for o in options if kind_of(o) == "other_scene")


def test_a_ladder_has_every_error_equally_often_and_nothing_else():
    options = drawn(MIXES["ladder"], 180)
    millimetres = Counter(round(o.noise_m * 1e3, 3) for o in options)
    assert millimetres == dict.fromkeys((0, 2.5, 5, 7.5, 10, 15, 20, 30, 40), 20)
    assert {kind_of(o) for o in options} == {"script"}
    some = drawn(MIXES["ladder"].changed(miss=0.1, still=0.1), 180)
    assert {kind_of(o) for o in some} == {"script", "miss", "frozen", "hold"}


def test_actions_of_evaluation_scenes_never_come_into_training_scenes():
    mix = Mix(exact=0.01, other_scene=0.99)
    for first in (0, 20_000, 30_000):
        others = [options_of("stand_bottle", first + s, mix).actions_of_seed for s in range(300)]
        given = [seed for seed in others if seed is not None]
        assert len(given) > 280
        assert first <= min(given)
        assert max(given) < first + 10_000


def test_demonstrations_are_a_third_exact_and_a_fifth_misses():
    options = drawn(MIXES["demonstrations"])
    assert 0.17 < np.mean([o.miss for o in options]) < 0.23
    assert 0.31 < np.mean([o.noise_m == 0 for o in options]) < 0.39
    assert max(o.noise_m for o in options) <= 0.025
    (exact,) = drawn(MIXES["exact"], 1)
    assert kind_of(exact) == "script"
    assert exact.noise_m == 0


@pytest.mark.parametrize(
    ("shares", "match"),
    [
        ({"exact": -0.1, "miss": 1.1}, "share of exact"),
        ({"exact": float("nan")}, "share of exact"),
        ({"exact": 0.5}, "sum to 0.5"),
        ({"miss": 1.0}, "no share of any script"),
    ],
)
def test_shares_that_do_not_fit_are_refused(shares, match):
    with pytest.raises(InvalidInputError, match=match):
        Mix(**shares)


@pytest.mark.parametrize("changes", [{"miss": 1.1}, {"still": -0.1}, {"miss": 0.6, "still": 0.6}])
def test_shares_changed_to_more_than_all_are_refused(changes):
    with pytest.raises(InvalidInputError, match=r"share|0 … 1"):
        MIXES["ladder"].changed(**changes)


@pytest.mark.long
def test_a_run_goes_on_where_it_was_interrupted(tmp_path, capsys):
    scope = Scope(("stand_bottle",), image_every=40)
    first = make_training_data(
        str(tmp_path), range(2), MIXES["exact"], workers=Workers(1), scope=scope
    )
    assert first == {"made": 2, "kept": 0, "succeeded": 2, "refused": 0}
    store = EpisodeStore(tmp_path)
    before = {name: store.open(name).content_sha256 for name in store.list()}
    again = make_training_data(
        str(tmp_path), range(2), MIXES["exact"], workers=Workers(1), scope=scope
    )
    assert again == {"made": 0, "kept": 2, "succeeded": 0, "refused": 0}
    assert before == {name: store.open(name).content_sha256 for name in store.list()}
    capsys.readouterr()


def test_an_episode_that_cannot_be_made_is_told_and_the_others_go_on(tmp_path, capsys, monkeypatch):
    def diverge(stage, seed, options, *, played):
        raise InvalidInputError("twin: physics diverged")

    monkeypatch.setattr(training_data, "record", diverge)
    argv = ["--store", str(tmp_path), "--count", "2", "--tasks", "stand_bottle", "--jobs", "1"]
    assert training_data.main(argv) == 1
    told = capsys.readouterr().out
    assert told.count("physics diverged") == 2
    assert "0 made, 0 kept, 0 succeeded, 2 refused" in told


@pytest.mark.slow
def test_human_hands_pass_the_devices_unless_written_directly(tmp_path, capsys):
    summary = tmp_path / "counts.json"
    argv = ["--tasks", "stack_bowls", "--domains", "human", "--exact", "--images", "20"]
    argv += ["--store", str(tmp_path / "store"), "--count", "1", "--json", str(summary)]
    assert training_data.main([*argv, "--jobs", "1"]) == 0
    assert json.loads(summary.read_text())["made"] == 1
    assert training_data.main([*argv, "--path", "direct"]) == 0
    store = EpisodeStore(tmp_path / "store")
    direct, devices = (store.open(name) for name in store.list())
    assert direct.attributes.episode_id == "twin-stack_bowls-human-000000-i20-training"
    assert devices.attributes.episode_id == f"{direct.attributes.episode_id}-devices"
    assert set(devices.streams) == set(direct.streams)
    assert "action_commanded" not in devices.streams
    # Joint angles of a human hand, and of the robot's hand that does the same.
    q_human, q_robot = (one.read("action").values[:, 18:58] for one in (direct, devices))
    assert np.abs(q_human - q_robot[: len(q_human)]).max() > 0.1
    # A second run keeps both.
    assert training_data.main([*argv, "--path", "devices"]) == 0
    assert json.loads(summary.read_text()) == {"made": 0, "kept": 1, "succeeded": 0, "refused": 0}
    capsys.readouterr()


def test_a_human_take_that_cannot_be_aligned_is_told(tmp_path, capsys, monkeypatch):
    def refuse(order):
        raise ClockFitError("stream 'head': stamps fit no clock")

    monkeypatch.setattr(training_data, "_written", refuse)
    argv = ["--store", str(tmp_path), "--count", "1", "--tasks", "open_drawer", "--exact"]
    assert training_data.main([*argv, "--domains", "human", "--jobs", "1"]) == 1
    told = capsys.readouterr().out
    assert "stamps fit no clock" in told
    assert "1 refused" in told
    assert EpisodeStore(tmp_path).list() == []


def test_unknown_tasks_and_policies_for_human_hands_are_refused(tmp_path, capsys):
    with pytest.raises(UnknownNameError, match="'juggle'; valid: "):
        training_data.main(["--store", str(tmp_path), "--tasks", "juggle"])
    with pytest.raises(InvalidInputError, match="at least one of each"):
        training_data.main(["--store", str(tmp_path), "--tasks", ","])
    with pytest.raises(InvalidInputError, match="robot"):
        make_training_data(
            str(tmp_path), range(1), MIXES["exact"], scope=Scope(domains=("human",)),
            policy=PolicyChoice("a:b"),
        )  # fmt: skip
    with pytest.raises(InvalidInputError, match="MODULE:FACTORY"):
        PolicyChoice.parse("nothing", {})
    for text in ("[1]", "{"):
        with pytest.raises(SystemExit):
            training_data.main(["--store", str(tmp_path), "--policy-arguments", text])
    capsys.readouterr()


POLICY = """
import numpy as np

class Lift:
    def __init__(self, step_m=0.01):
        self.step_m = step_m
    def act(self, observation):
        rows = np.tile(observation.action_reached[-1], (16, 1))
        rows[:, 11] += np.linspace(0, self.step_m, 16)
        return rows
"""


@pytest.mark.long
def test_a_policy_acts_in_the_twin_and_its_actions_become_an_episode(tmp_path, monkeypatch, capsys):
    (tmp_path / "lifting_policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    argv = ["--store", "takes", "--first", "4", "--count", "1", "--tasks", "stand_bottle"]
    policy = ["--policy", "lift=lifting_policy:Lift", "--policy-arguments", '{"step_m": 0.02}']
    assert training_data.main([*argv, *policy, "--images", "40", "--jobs", "1"]) == 0
    (name,) = EpisodeStore("takes").list()
    assert name.startswith("twin-stand_bottle-robot-000004-by_lift_")
    episode = EpisodeStore("takes").open(name)
    commanded = episode.window(0, 81, cameras=(), action_kind="commanded").actions
    # Each chunk ends 2 cm above where the hand was measured before it.
    reached = episode.window(0, 81, cameras=()).actions
    np.testing.assert_allclose(commanded[16, 11], reached[0, 11] + 0.02, atol=1e-9)
    np.testing.assert_allclose(commanded[32, 11], reached[16, 11] + 0.02, atol=1e-6)
    assert "--policy lift=lifting_policy:Lift" in episode.attributes.generator_command
    assert episode.attributes.success is False
    capsys.readouterr()
