"""How a world is measured: on scenes whose touch and images follow a known rule."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.geometry import pinhole_matrix, transform
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses
from dextouch.metrics import tactile
from dextouch.schemas import EVERYTHING, Observation, RolloutStart
from dextouch.worlds import CopyFirstWorld, SteppedRollout
from services.evaluation.prediction import (
    ALL_TASKS,
    DEFAULT_BASELINES,
    METRICS,
    MODEL,
    measure_prediction,
)
from services.evaluation.prediction_scenes import Future, Scene, other_take, read_windows
from tests.unit.evaluation import toy, toy_store

PX, NUM_STEPS = 16, 32
DOWN = np.diag([1.0, -1.0, -1.0])
ANCHOR = AnchorPoses(
    transform(np.eye(3), np.array([-0.2, 0.0, 0.2])),
    transform(np.eye(3), np.array([0.2, 0.0, 0.2])),
    transform(DOWN, np.array([0.0, 0.0, 0.5])),
)


def felt(actions):
    """The toy's rule: 100 kPa on every taxel for each metre that the right hand goes down."""
    return np.broadcast_to(-100.0 * actions[:, 11, None, None], (len(actions), 2, 320))


class PressWorld(CopyFirstWorld):
    """Feels by the toy's rule and goes on showing the first image."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed)
        seen = replace(stepped.observation, tactile_kpa=felt(actions).astype(np.float32))
        return SteppedRollout(stepped.state, seen.selected(selector))


def scene(seed, depth_m):
    actions = np.zeros((NUM_STEPS, 67))
    for part in POSE_SLICES:
        actions[:, part] = IDENTITY_POSE_9D
    first = Observation(
        first_step=0,
        images={"camera_head": np.full((1, PX, PX, 3), 100, np.uint8)},
        tactile_kpa=np.zeros((1, 2, 320), np.float32),
        action_reached=actions[:1].copy(),
        reached_is_measured=True,
    )
    actions[:, 11] = -depth_m * np.arange(NUM_STEPS) / NUM_STEPS
    K_head = pinhole_matrix(width_px=PX, height_px=PX, fovy_rad=1.0)
    start = RolloutStart("press", seed, "press", observation=first, anchor=ANCHOR, K_head=K_head)
    # Ten grey levels off everywhere: 20 log10(255 / 10) dB for a world that copies.
    images = np.full((2, PX, PX, 3), 110, np.uint8)
    return Scene(
        f"e{seed}", start, actions, Future(images, felt(actions).astype(np.float32), (16, 32)), 15.0
    )


def test_steps_of_another_rate_are_refused():
    world = PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX, model_rate_hz=30.0)
    with pytest.raises(InvalidInputError, match="'e1' at 15 steps a second, expected 30"):
        measure_prediction(world, [scene(1, 0.2)])


def test_touch_that_was_not_measured_counts_in_no_figure():
    world = PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    whole = scene(1, 0.2)
    measured = np.ones(whole.truth.tactile_kpa.shape, dtype=bool)
    measured[:20] = False
    measured[:, 1, 7] = False
    figures = []
    for wrong_kpa in (0.0, 50.0):
        touch_kpa = np.where(measured, whole.truth.tactile_kpa, np.float32(wrong_kpa))
        truth = replace(whole.truth, tactile_kpa=touch_kpa, measured_taxels=measured)
        found = measure_prediction(world, [replace(whole, truth=truth)])
        figures.append(found.flat())
    names = ("tactile_mse", "tactile_mae", "contact_iou", "contact_f1", "pad_contact_f1")
    assert all(name in figures[0] for name in names)
    for name in (*names, "contact_mae", "tactile_psnr", "tactile_ssim"):
        assert figures[0][name] == figures[1][name]
    # This world feels as the truth does, so nothing is wrong with what was measured.
    assert figures[0]["contact_f1"] == 1.0
    # An error counts as much however many taxels were measured.
    rng, one_off = np.random.default_rng(0), rng_pressures()
    for share in (1.0, 0.5, 0.25):
        mask = rng.random(one_off.shape) < share
        found = tactile.mse(predicted_kpa=one_off + 1, true_kpa=one_off, measured=mask)
        assert found == pytest.approx(1.0)
        assert tactile.psnr(
            predicted_kpa=one_off + 1, true_kpa=one_off, measured=mask
        ) == pytest.approx(20 * np.log10(40.0))
    assert np.isnan(tactile.mae(predicted_kpa=one_off, true_kpa=one_off, measured=mask & False))


def rng_pressures():
    return np.random.default_rng(1).uniform(0, 20, (5, 2, 320))


def test_figures_of_a_world_that_feels_and_does_not_see():
    scenes = [scene(1, 0.2), scene(2, 0.1)]
    found = measure_prediction(
        PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX), scenes
    )
    figures, decibels = found.flat(), 20 * np.log10(255 / 10)
    for name in ("psnr", "psnr_copy", "psnr_warp", "psnr_hold"):
        assert figures[name] == pytest.approx(decibels)
    assert figures["tactile_mse"] == pytest.approx(0.0, abs=1e-9)
    assert figures["contact_f1"] == pytest.approx(1.0)
    # Row k is k/32 of 20 and of 10 kPa: their difference is k/32 of 10 kPa.
    share = np.mean((np.arange(NUM_STEPS) / NUM_STEPS) ** 2)
    assert figures["tactile_mse_other_take"] == pytest.approx(100 * share, rel=1e-5)
    truth = (400 * share + 100 * share) / 2
    for rival in ("copy", "zero", "hold", "hands_still"):
        assert figures[f"tactile_mse_{rival}"] == pytest.approx(truth, rel=1e-5)
    assert figures["num_rollouts"] == 2
    assert [picture.true_images.shape[0] for picture in found.pictures] == [2]


def test_a_lone_scene_has_no_other_and_no_scene_is_refused():
    world = CopyFirstWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    assert "psnr_other_take" not in measure_prediction(world, [scene(1, 0.1)]).flat()
    with pytest.raises(InvalidInputError, match="no scene"):
        measure_prediction(world, [])


def test_windows_that_begin_without_an_image_or_have_none_are_left_out(tmp_path):
    item = toy.demonstration("reach", 3)
    store = EpisodeStore(tmp_path)
    toy_store.write(store, item, shown=[*range(16), *range(17, 49), *range(65, 80)])
    windows = read_windows(store.open(item.episode_id))
    assert [window.first_step for window in windows] == [0, 32]


def recorded(episode_id, depth_m):
    """A scene of an episode that a station recorded: `read_windows` starts those without seed 0."""
    return replace(scene(0, depth_m), episode_id=episode_id)


@pytest.mark.parametrize(
    ("scenes", "others"),
    [
        ([recorded("a", 0.2), recorded("b", 0.1)], ["b", "a"]),
        ([recorded("a", 0.2), scene(7, 0.1)], ["e7", "a"]),
        # The same scene twice, by person and robot: another take, but one elsewhere is better.
        ([scene(7, 0.2), replace(scene(7, 0.1), episode_id="robot")], ["robot", "e7"]),
        (
            [scene(7, 0.2), replace(scene(7, 0.1), episode_id="robot"), scene(8, 0.1)],
            ["e8", "e8", "e7"],
        ),
        # One episode, listed twice, is one take.
        ([recorded("a", 0.2), recorded("a", 0.2)], [None, None]),
        ([recorded("a", 0.2)], [None]),
        # None of a window from another step, of another task, or too short.
        ([recorded("a", 0.2), replace(recorded("b", 0.1), first_step=16)], [None, None]),
        (
            [recorded("a", 0.2), replace(recorded("b", 0.1), actions=np.zeros((16, 67)))],
            [None, "a"],
        ),
    ],
)
def test_another_take_is_another_episode_also_without_seeds(scenes, others):
    found = [other_take(one, scenes) for one in scenes]
    assert [None if one is None else one.episode_id for one in found] == others


def test_recorded_episodes_keep_the_baseline_of_another_take():
    world = PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    found = measure_prediction(world, [recorded("a", 0.2), recorded("b", 0.1)])
    # Row k is k/32 of 20 and of 10 kPa: their difference is k/32 of 10 kPa.
    share = np.mean((np.arange(NUM_STEPS) / NUM_STEPS) ** 2)
    assert found.flat()["tactile_mse_other_take"] == pytest.approx(100 * share, rel=1e-5)
    assert found.missing == {"codec": "the world has no codecs (2 of 2 scenes)"}


def test_a_baseline_without_a_figure_is_named_with_its_reason():
    world = CodingWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    lone = replace(scene(3, 0.1), actions=np.zeros((16, 67)), first_step=16)
    scenes = [scene(1, 0.2), scene(2, 0.1), lone]
    baselines = ("codec", "other_take", "other_instruction", "hold")
    found = measure_prediction(world, scenes[:2], baselines=baselines)
    assert found.missing == {
        "codec": "it needs images of all steps (2 of 2 scenes)",
        "other_instruction": "no other task has another instruction (2 of 2 scenes)",
    }
    mixed = measure_prediction(
        world, [*scenes[:2], recorded("late", 0.1)], baselines=("other_take",)
    )
    assert mixed.missing == {}
    short = replace(scenes[2].truth, tactile_kpa=scenes[2].truth.tactile_kpa[:16])
    lone = replace(lone, truth=replace(short, images=short.images[:1], image_steps=(16,)))
    partly = measure_prediction(world, [*scenes[:2], lone], baselines=("other_take",))
    assert partly.missing == {
        "other_take": "no other take of the task is as long from this step (1 of 3 scenes)"
    }


def test_every_metric_stands_beside_every_baseline_that_has_it():
    world = PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    found = measure_prediction(
        world, [scene(1, 0.2), scene(2, 0.1)], metrics=(METRICS["ssim"], METRICS["tactile_mae"])
    )
    assert set(found.by_task) == {ALL_TASKS, "press"}
    figures = found.by_task["press"]
    assert set(figures) == {MODEL, *DEFAULT_BASELINES}
    assert figures["warp"]["tactile_mae"] is None
    assert figures["zero"]["ssim"] is None
    assert figures["codec"] == {"ssim": None, "tactile_mae": None}
    # Row k is k/32 of 20 and of 10 kPa.
    truth = 15.0 * np.mean(np.arange(NUM_STEPS) / NUM_STEPS)
    assert figures["zero"]["tactile_mae"] == pytest.approx(truth, rel=1e-5)


class PushWorld(PressWorld):
    """Says that its one object has gone as far in x as the right hand went down."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed)
        poses = np.zeros((len(actions), 2, 7), dtype=np.float32)
        poses[:, 0, 0] = -actions[:, 11]
        seen = replace(stepped.observation, object_poses=poses)
        return SteppedRollout(stepped.state, seen.selected(selector))


def with_objects(one, moved_m):
    """A scene whose first object moves in x; where the second one is, is not known at the end."""
    last_m = np.array([[moved_m, 0.0, 0.0], [np.nan] * 3])
    truth = replace(one.truth, objects_m=last_m)
    return replace(one, truth=truth, first_objects_m=np.zeros((2, 3)))


def test_errors_of_objects_are_those_of_the_ones_that_moved():
    world = PushWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    said_m = 0.2 * (NUM_STEPS - 1) / NUM_STEPS
    scenes = [with_objects(scene(1, 0.2), said_m + 0.03), with_objects(scene(2, 0.0), 0.009)]
    metrics = (METRICS["object_error"],)
    figures = measure_prediction(world, scenes, metrics=metrics).flat()
    assert figures["object_error"] == pytest.approx(30.0, abs=1e-3)
    assert figures["object_error_copy"] == pytest.approx(1e3 * (said_m + 0.03))
    # Given the actions of the other take, in which nothing moves.
    assert figures["object_error_other_take"] == pytest.approx(1e3 * (said_m + 0.03))
    assert not {"object_error_warp", "object_error_zero", "object_error_codec"} & set(figures)
    blind = PressWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    unseen = measure_prediction(blind, scenes, metrics=metrics).by_task[ALL_TASKS]
    assert unseen[MODEL]["object_error"] is None
    assert unseen["copy"]["object_error"] == pytest.approx(1e3 * (said_m + 0.03))


class CodingWorld(PressWorld):
    """Codecs that lose three grey levels and half of the touch."""

    def reconstruct(self, images, tactile_kpa):
        return images[1:] - np.uint8(3), tactile_kpa[1:] / 2


def test_the_limit_of_the_codecs_needs_images_of_all_steps():
    world = CodingWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    sparse = scene(1, 0.2)
    images = np.full((NUM_STEPS, PX, PX, 3), 110, np.uint8)
    steps = tuple(range(1, NUM_STEPS + 1))
    dense = replace(sparse, truth=Future(images, sparse.truth.tactile_kpa, steps))
    assert "psnr_codec" not in measure_prediction(world, [sparse]).flat()
    figures = measure_prediction(world, [dense]).flat()
    assert figures["psnr_codec"] == pytest.approx(20 * np.log10(255 / 3))
    assert figures["tactile_mae_codec"] == pytest.approx(figures["tactile_mae_zero"] / 2)


def test_a_world_without_touch_has_no_figures_of_touch():
    world = CopyFirstWorld(tasks=("press",), image_height_px=PX, image_width_px=PX)
    world._description = world.description.model_copy(update={"predicts_touch": False})
    figures = measure_prediction(world, [scene(1, 0.1)]).flat()
    assert "contact_f1" not in figures
    assert figures["contact_f1_copy"] == 0.0
    assert figures["psnr"] > 0


class ListeningWorld(PressWorld):
    """Feels twice as much when told to press hard."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed, selector=selector)
        factor = {"press hard": 2.0, "press": 1.0, "": 0.0}[self.heard]
        felt_kpa = factor * stepped.observation.tactile_kpa
        seen = replace(stepped.observation, tactile_kpa=felt_kpa.astype(np.float32))
        return SteppedRollout(stepped.state, seen)

    def reset(self, start):
        self.heard = start.instruction
        return super().reset(start)


def test_instructions_are_removed_and_swapped():
    world = ListeningWorld(tasks=("press", "press_hard"), image_height_px=PX, image_width_px=PX)
    gentle = scene(1, 0.2)
    hard = scene(2, 0.2)
    start = replace(hard.start, task="press_hard", instruction="press hard")
    truth = replace(hard.truth, tactile_kpa=2 * hard.truth.tactile_kpa)
    found = measure_prediction(
        world,
        [gentle, replace(hard, start=start, truth=truth)],
        metrics=(METRICS["tactile_mae"],),
        baselines=("zero", "no_instruction", "other_instruction"),
    )
    for task, share in (("press", 1.0), ("press_hard", 0.5)):
        figures = {name: row["tactile_mae"] for name, row in found.by_task[task].items()}
        assert figures["model"] == pytest.approx(0.0, abs=1e-6)
        assert figures["no_instruction"] == pytest.approx(figures["zero"])
        assert figures["other_instruction"] == pytest.approx(share * figures["zero"])
