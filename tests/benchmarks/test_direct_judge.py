"""Direct judge: what it reads, what does not count, and that it learns from its inputs."""

from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import torch

from benchmarks import direct_judge
from benchmarks.command import stage_parser
from benchmarks.direct_judge import (
    Attempts,
    DirectJudge,
    DirectNetwork,
    JudgeSettings,
    read_takes,
    reader_sigma_m,
    train_direct_judge,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas import Observation, Review, RolloutStart
from services.evaluation.matched_starts import start_digest
from services.evaluation.statistics import area_under_roc
from services.evaluation.success_classifier import Calibration
from services.evaluation.trained_networks import save_checkpoint
from services.twin.demonstrators import Motion
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.training.scene_table import scene_table
from tests.unit.world_model.test_state_training import NUM_STEPS, PX, episode
from tests.unit.world_model.toy_grid import ToyGrid, changed

CONFIG = DynamicsConfig(tasks=("press",), num_objects=(1,), image_px=PX)
LEAN = TakeOptions(images=("camera_head",), image_every=4, streams="training")


def start_of(one: ToyGrid, **changes) -> RolloutStart:
    """The first step of an episode as a rollout's start, as the evaluator has it."""
    observation = Observation(
        first_step=0,
        images={"camera_head": one.images([0])},
        tactile_kpa=one.tactile_kpa[:1],
        action_reached=one.measured[:1],
        reached_is_measured=True,
    )
    start = RolloutStart(
        one.task,
        one.about.seed,
        "Press it.",
        observation=observation,
        anchor=one.anchor,
        K_head=one.K_head,
    )
    return replace(start, **changes)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(3)
    return DirectNetwork(CONFIG).eval()


@torch.no_grad()
def odds_of(network, *episodes):
    return network(Attempts.of(network.reader, scene_table(list(episodes), CONFIG)))


def test_what_lies_behind_an_episode_does_not_count(network):
    """A short episode beside a long one, which fills the table up, gives what it gives alone."""
    short = episode(0, NUM_STEPS - 8)
    alone = odds_of(network, short)
    beside = odds_of(network, short, episode(1))
    torch.testing.assert_close(beside[:1], alone, atol=1e-5, rtol=1e-5)
    # The same with other commands behind the end.
    attempts = Attempts.of(network.reader, scene_table([short, episode(1)], CONFIG))
    behind = attempts.commands.points_m.clone()
    behind[0, -2:] += 0.3
    changed = replace(attempts, commands=replace(attempts.commands, points_m=behind))
    with torch.no_grad():
        torch.testing.assert_close(network(changed)[:1], alone, atol=1e-5, rtol=1e-5)


def test_slots_without_an_object_do_not_count(network):
    attempts = Attempts.of(network.reader, scene_table([episode(0)], CONFIG))
    objects = attempts.reading.objects
    position_m = objects.position_m.clone()
    position_m[:, 1:] += 0.2
    moved = replace(attempts.reading, objects=replace(objects, position_m=position_m))
    with torch.no_grad():
        assert torch.equal(network(attempts), network(replace(attempts, reading=moved)))
        position_m[:, 0] += 0.2
        assert not torch.equal(network(attempts), network(replace(attempts, reading=moved)))


def test_the_reader_s_error_is_that_of_a_normal_distribution_with_the_same_median(network):
    table = scene_table([episode(seed) for seed in range(5)], CONFIG)
    reading = Attempts.of(network.reader, table).reading
    off_m = torch.tensor([0.001, 0.002, 0.003, 0.004, 0.5])
    position_m = table.objects.position_m[:, 0].clone()
    position_m[:, 0, 0] += off_m
    position_m[:, 0, 1] -= off_m
    known = table.objects_known.clone()
    # The largest error is of an object that is not known there.
    known[4, 0, 0] = False
    table = replace(table, objects_known=known)
    objects = replace(reading.objects, position_m=position_m)
    sigma_m = reader_sigma_m(replace(reading, objects=objects), table)
    # Half of a normal distribution lies within 0.6745 sigma; torch takes the lower median.
    np.testing.assert_allclose(sigma_m[0, 0], [0.002 / 0.6745, 0.002 / 0.6745, 0.0], atol=1e-7)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """True takes of the twin, one with poses as a station measures them, and unfit ones."""
    stage = Stage("stand_bottle", "robot", TwinSettings())
    takes = {"script": record(stage, 3, replace(LEAN, noise_m=0.005))}
    takes["push"] = record(stage, 4, replace(LEAN, motion=Motion("push", 0)))
    for name, changes in {
        "imagined": {"origin": "imagined"},
        "human": {"domain": "human"},
        "rejected": {},
        "station": {"seed": None, "origin": "recorded"},
    }.items():
        attributes = takes["push"].attributes.model_copy(update={"episode_id": name, **changes})
        takes[name] = replace(takes["push"], attributes=attributes)
    streams = dict(takes["station"].streams)
    poses = streams.pop("object_poses")
    for slot, name in enumerate(takes["station"].attributes.object_names):
        descriptor = poses.descriptor.model_copy(update={"name": f"object_{name}", "shape": (7,)})
        streams[f"object_{name}"] = replace(
            poses, descriptor=descriptor, values=poses.values[:, slot]
        )
    takes["station"] = replace(takes["station"], streams=streams)
    store = EpisodeStore(tmp_path_factory.mktemp("takes"))
    for take in takes.values():
        write_episode(store, take)
    verdict = Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
    store.set_review("rejected", verdict)
    return store, takes


def test_true_robot_takes_are_read_also_those_of_stations(store):
    store, takes = store
    episodes, starts = read_takes([str(store.root)])
    by_id = {one.episode_id: one for one in episodes}
    names = {takes[name].attributes.episode_id for name in ("script", "push", "station")}
    assert set(by_id) == names
    station, push = by_id["station"], by_id[takes["push"].attributes.episode_id]
    assert station.objects.is_measured
    assert bool(station.objects.known.all())
    ours, theirs = station.objects.poses, push.objects.poses
    np.testing.assert_allclose(ours[..., :3], theirs[..., :3], atol=1e-4)
    # Digests are of the observations as recorded, which the evaluator compares.
    streams = takes["script"].streams
    assert not streams["tactile_left"].values[0].any()
    assert not streams["tactile_right"].values[0].any()
    untouched = np.zeros((2, 320), dtype=np.float32)
    assert start_digest(streams["camera_head"].values[0], untouched) in starts
    assert len(starts) == 2


def test_an_empty_store_is_refused(tmp_path):
    with pytest.raises(NotFoundError, match="has none"):
        read_takes([str(EpisodeStore(tmp_path).root)])


def test_episodes_that_all_end_alike_are_refused():
    with pytest.raises(InvalidInputError, match="same outcome"):
        train_direct_judge(
            [episode(seed) for seed in range(0, 60, 2)], (), JudgeSettings(), command="test"
        )


def test_a_quick_run_writes_a_judge_that_the_evaluator_opens(tmp_path, monkeypatch):
    episodes = [episode(seed) for seed in range(40)]
    monkeypatch.setattr(direct_judge, "read_takes", lambda *_, **__: (episodes, {"digest"}))
    parser = stage_parser("direct-judge")
    direct_judge.add_options(parser)
    path = tmp_path / "direct.safetensors"
    options = parser.parse_args(["--quick", "--output", str(path), "--episodes", "runs/a/takes/"])
    report = direct_judge.measure(options, tmp_path, lambda *_: nullcontext(lambda _: None))
    figures = dict(report.tables[0].rows)
    assert int(figures["num_training_episodes"]) + int(figures["num_development_episodes"]) == 40
    judge = DirectJudge.load(path)
    assert judge.metadata.tasks == ("press",)
    assert judge.metadata.training_starts == ("digest",)
    assert judge.metadata.command.endswith("--episodes takes")
    # A rollout's start and commands give what the table of training gives.
    one = episode(100)
    odds = odds_of(judge._network, one).double().numpy()
    fitted = judge.metadata.settings["calibration"].get("press", {})
    expected = float(Calibration.model_validate(fitted).probabilities(odds)[0])
    assert judge.probability(start_of(one), one.sent[1:]) == pytest.approx(expected, abs=1e-6)
    with pytest.raises(UnknownNameError, match="press"):
        judge.probability(start_of(one, task="lift"), one.sent[1:])


def pressed_or_elsewhere(seed: int) -> ToyGrid:
    """The hand comes down at a random place; a block is under it, or at another such place."""
    one, other = episode(2 * seed), episode(2 * seed + 1)
    if seed % 2:
        return one
    return changed(one, pictures=other.pictures, poses=other.objects.poses, success=False)


@pytest.mark.slow
def test_a_trained_judge_tells_where_the_block_is(tmp_path):
    torch.set_num_threads(1)
    settings = JudgeSettings(
        reader_steps=250,
        num_training_steps=300,
        max_cpu_s=60.0,
        batch_size=32,
        development_share=0.2,
    )
    episodes = [pressed_or_elsewhere(seed) for seed in range(200)]
    checkpoint = train_direct_judge(episodes, (), settings, command="test")
    path = tmp_path / "direct.safetensors"
    save_checkpoint(path, checkpoint)
    judge = DirectJudge.load(path)
    tested = [pressed_or_elsewhere(seed) for seed in range(1000, 1080)]
    told = [judge.probability(start_of(one), one.sent[1:]) for one in tested]
    # By the commands alone, both outcomes are alike: 0.5.
    assert area_under_roc(np.array(told), np.array([one.success for one in tested])) > 0.8
    assert checkpoint.metadata.metrics["development_auc_press"] > 0.8
