"""`python -m benchmarks world-model`: one short run as users start it, and errors by hand.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from benchmarks.world_model import benchmark
from benchmarks.world_model.benchmark import (
    Imagined,
    RolloutError,
    held_out,
    imagine,
    imagine_together,
    rollout_error,
)
from dextouch.errors import InvalidInputError
from dextouch.schemas import ReturnSelector
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import CopyFirstWorld


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "world-model", "--quick"]
    done = subprocess.run(
        [*command, "--out", str(folder)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    return folder, json.loads((folder / "bench_world-model.json").read_text())


@pytest.mark.slow
def test_a_quick_run_measures_everything(run):
    folder, figures = run
    names = {one.name for one in benchmark.VARIANTS}
    assert set(figures["chunk_ms"]) == set(figures["errors"]) == names | {benchmark.COPY_FIRST}
    assert len(figures["requested_ms"]) == len(benchmark.SELECTORS) * len(benchmark.TOGETHER)
    assert len(figures["state_model_ms"]) == len(benchmark.SELECTORS) * len(benchmark.STATE_BATCHES)
    assert figures["options"]["served"] in names
    assert "as served" in (folder / "bench_world-model.md").read_text()
    assert "Imagined touch" in (folder / "bench_world-model.svg").read_text()


@pytest.mark.slow
def test_the_model_is_nearer_to_the_twin_than_standing_still(run):
    errors = run[1]["errors"]
    ours, copied = errors[run[1]["options"]["served"]], errors[benchmark.COPY_FIRST]
    assert ours["image_levels"] < copied["image_levels"]
    assert ours["touch_kpa"] < copied["touch_kpa"]


@pytest.mark.slow
def test_half_precision_is_near_full_precision_and_not_the_same(run):
    # Shape checks know float32 only, so half precision is tried without them.
    errors = run[1]["errors"]
    for steps in (1, 2, 4):
        full = errors[benchmark.Variant(steps).name]
        half = errors[benchmark.Variant(steps, precision="bfloat16").name]
        assert half != full
        assert half == pytest.approx(full, rel=0.05)


@pytest.mark.slow
def test_a_kept_context_does_not_change_the_errors(run):
    errors = run[1]["errors"]
    for steps in (2, 4, 8):
        kept = errors[benchmark.Variant(steps).name]
        assert kept == pytest.approx(
            errors[benchmark.Variant(steps, recomputed=True).name], rel=1e-3
        )


@pytest.fixture(scope="module")
def episode():
    (made,) = held_out(["stand_bottle"], [30_001], 16)
    return made


def test_errors_by_hand(episode):
    world = CopyFirstWorld(tasks=("stand_bottle",), image_height_px=16, image_width_px=16)
    imagined = imagine(world, [episode])
    assert len(imagined.seen[0]) == len(episode.chunks) == 5
    error = rollout_error(imagined, [episode])
    first = episode.start.observation
    off = episode.images[:80].astype(float) - first.images[HEAD_CAMERA].astype(float)
    assert error.image_levels == pytest.approx(np.sqrt((off**2).mean()))
    off_kpa = episode.tactile_kpa[:80].astype(float) - first.tactile_kpa
    assert error.touch_kpa == pytest.approx(np.sqrt((off_kpa**2).mean()), rel=1e-6)
    assert error.contact_f1 == 0.0


def test_the_truth_itself_has_no_error(episode):
    world = CopyFirstWorld(tasks=("stand_bottle",), image_height_px=16, image_width_px=16)
    seen = imagine(world, [episode]).seen[0]
    true = [
        type(one)(
            first_step=one.first_step,
            images={HEAD_CAMERA: episode.images[16 * k : 16 * k + 16]},
            tactile_kpa=episode.tactile_kpa[16 * k : 16 * k + 16],
            action_reached=one.action_reached,
            reached_is_measured=False,
        )
        for k, one in enumerate(seen)
    ]
    assert rollout_error(Imagined([true], 1.0), [episode]) == RolloutError(0.0, 0.0, 1.0)


def test_rollouts_may_show_less(episode):
    world = CopyFirstWorld(tasks=("stand_bottle",), image_height_px=16, image_width_px=16)
    seen = imagine(world, [episode], ReturnSelector(cameras=(), steps="last")).seen[0]
    assert [(one.first_step, len(one), one.images) for one in seen] == [
        (16 * k, 1, {}) for k in range(1, 6)
    ]


def test_verdicts():
    served = benchmark.Variant(2).name
    assert served == "2 Euler steps, float32"
    errors = {
        benchmark.COPY_FIRST: RolloutError(30.0, 4.0, 0.0),
        served: RolloutError(15.0, 5.0, 0.9),
    }
    found = benchmark.requirements({served: Figure.of([40.0])}, errors, served)
    assert [one.figure for one in found] == [40.0, 0.5, 1.25]
    assert [one.is_met for one in found] == [True, True, False]


def test_the_state_model_is_judged_by_its_rounds():
    costs = {
        benchmark.cost_name(amount, batch): Figure.of([8.0 / batch, 16.0 / batch, 8.0 / batch])
        for amount in benchmark.SELECTORS
        for batch in benchmark.STATE_BATCHES
    }
    found = benchmark.state_model_requirements(costs)
    assert [one.figure for one in found] == [8.0, 8.0, 8.0, 16.0]
    assert [one.is_met for one in found] == [False, True, True, True]
    rows = benchmark.state_model_table(costs, "state").rows
    assert [row[3] for row in rows] == ["", "125", "2000", "", "500", "8000", "", "2000", "32000"]


class OneAtATime(CopyFirstWorld):
    """Steps the rollouts of a batch in turn and keeps their actions."""

    def __init__(self, **shape):
        super().__init__(**shape)
        self.played = []

    def step_batch(self, states, actions, *, seeds, selectors):
        self.played.append(actions)
        rows = zip(states, actions, seeds, selectors, strict=True)
        return [
            self.step(state, chunk, seed=seed, selector=selector)
            for state, chunk, seed, selector in rows
        ]


def test_a_batch_plays_the_episodes_in_turn(episode):
    world = OneAtATime(tasks=("stand_bottle",), image_height_px=16, image_width_px=16)
    later = {name: getattr(episode, name)[32:64] for name in ("actions", "images", "tactile_kpa")}
    other = replace(episode, **later)
    imagine_together(world, [episode, other], 3, ReturnSelector())
    assert len(world.played) == 2
    for chunk, actions in enumerate(world.played):
        rows = slice(16 * chunk, 16 * chunk + 16)
        np.testing.assert_array_equal(
            actions, [one.actions[rows] for one in (episode, other, episode)]
        )


@pytest.mark.parametrize("words", [["--rounds", "0"], ["--seeds", "0"]])
def test_options_that_mean_nothing_are_refused(words, tmp_path):
    parser = stage_parser("world-model")
    benchmark.add_options(parser)
    with pytest.raises(InvalidInputError, match=words[0]):
        benchmark.measure(parser.parse_args(words), tmp_path, pytest.fail)
