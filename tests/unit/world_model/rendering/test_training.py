"""Training brings drawn images nearer to the truth and repeats itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.evaluator.playing import sharpness
from dextouch.errors import InvalidInputError
from services.world_model.rendering.renderer import RendererNetwork
from services.world_model.rendering.training import (
    RendererRun,
    drawing_loss,
    gather,
    train_renderer,
)
from services.world_model.settings import RendererTraining
from tests.unit.world_model.rendering.drawing_accuracy import evaluate_drawing


@pytest.fixture
def settings() -> RendererTraining:
    return RendererTraining(
        cpu_budget_s=1e6, max_steps=40, batch=6, warmup_steps=5, learning_rate=4e-3, ema_decay=0.5
    )


@pytest.fixture
def trained(clips, small, settings):
    network, _ = train_renderer(clips, small, settings, rng=np.random.default_rng(0))
    return network


@pytest.mark.long
def test_a_short_training_draws_nearer_to_the_truth_than_the_warp(trained, clips):
    report = evaluate_drawing(trained, clips)
    drawn, warp = report.chunks["drawn"][0], report.chunks["warp"][0]
    assert report.num_images == 8
    assert drawn.psnr_objects_db > warp.psnr_objects_db + 0.4


@pytest.mark.slow
def test_the_same_generator_gives_the_same_weights(trained, clips, small, settings):
    again, _ = train_renderer(clips, small, settings, rng=np.random.default_rng(0))
    for a, b in zip(again.parameters(), trained.parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_loss_of_a_bright_column_by_hand():
    drawn, true = torch.zeros(1, 3, 4, 5), torch.zeros(1, 3, 4, 5)
    true[..., 2] = 1.0

    def loss(**weights: float) -> float:
        settings = RendererTraining(**{"gradient_weight": 0, "sharpness_weight": 0, **weights})
        return drawing_loss(drawn, true, settings).item()

    # A fifth of the pixels is wrong by 1; of four differences across, two; of those down, none.
    assert loss() == pytest.approx(0.2)
    assert loss(gradient_weight=0.5) == pytest.approx(0.2 + 0.5 * 0.5)
    # Laplacians inside the border are 1, -2, 1; the window is as large as they are, 2 by 3, cut to
    # the shorter side: 1 and -2.
    assert loss(sharpness_weight=0.5) == pytest.approx(0.2 + 0.5 * 1.5)


def test_edges_count_wherever_they_are_in_their_window():
    true = torch.zeros(1, 3, 12, 12)
    true[..., 5:] = 1.0
    settings = RendererTraining(gradient_weight=0, sharpness_weight=1.0)
    elsewhere = drawing_loss(true.roll(1, -1), true, settings)
    nowhere = drawing_loss(torch.full_like(true, 0.5), true, settings)
    assert elsewhere < 0.4 * nowhere


def test_clips_of_other_numbers_of_objects_share_a_batch(clips):
    one = replace(clips[0], boxes_m=clips[0].boxes_m[:1], states=_first_object(clips[0].states))
    scenes = gather([one, clips[1]], np.array([[0, 1], [1, 2]]))
    assert scenes.states.object_present.tolist() == [[True, False], [True, False]]
    assert scenes.boxes_m[0, 1].tolist() == [0.0] * 6
    np.testing.assert_array_equal(scenes.images[1], clips[1].images[2])


def _first_object(states):
    return replace(
        states,
        object_poses=states.object_poses[:, :1],
        object_present=states.object_present[:, :1],
    )


def test_poses_are_shaken_in_their_share_of_states_only(clips, small, settings):
    calm = settings.model_copy(update={"shaken_fraction": 0.0})
    run = RendererRun(clips, small, calm, rng=np.random.default_rng(0))
    states = clips[0].states
    np.testing.assert_allclose(run._shaken(states).object_poses, states.object_poses, atol=1e-12)
    wild = settings.model_copy(update={"shaken_fraction": 1.0, "shake_m": 0.01})
    run = RendererRun(clips, small, wild, rng=np.random.default_rng(0))
    shift = run._shaken(states).object_poses[..., :3] - states.object_poses[..., :3]
    assert 0.005 < shift.std() < 0.015


def test_figures_of_a_copy_are_those_by_hand(small, clips):
    untrained = RendererNetwork(small)
    report = evaluate_drawing(untrained, clips[:1], chunk_steps=4)
    assert len(report.chunks["copy"]) == 4
    first = clips[0].images[0].astype(float)
    error = np.square(clips[0].images[2] - first).mean()
    assert report.chunks["copy"][1].psnr_db == pytest.approx(10 * np.log10(255**2 / error))
    # The camera stands still: the warp is the start, and so is the truth's sharpness near it.
    assert report.chunks["warp"][1].psnr_db == pytest.approx(report.chunks["copy"][1].psnr_db)


def test_sharpness_of_a_point_by_hand():
    image = np.zeros((1, 5, 5, 3))
    image[0, 2, 2] = 1.0
    # Inside the border of 9 pixels: once 4 and four times 1.
    assert sharpness(image).tolist() == pytest.approx([8 / 9])


@pytest.mark.slow
def test_poses_of_another_source_can_be_judged(trained, clips):
    def elsewhere(_number, clip):
        poses = clip.states.object_poses.copy()
        poses[1:, 0, :2] += 0.05
        return replace(clip.states, object_poses=poses)

    wrong = evaluate_drawing(trained, clips, states_of=elsewhere).chunks["drawn"][0]
    right = evaluate_drawing(trained, clips).chunks["drawn"][0]
    assert wrong.psnr_objects_db < right.psnr_objects_db


def test_clips_that_do_not_fit_are_refused(clips, small, settings):
    with pytest.raises(InvalidInputError, match="0 clips"):
        train_renderer([], small, settings, rng=np.random.default_rng(0))
    odd = replace(clips[0], images=clips[0].images[:, :62])
    with pytest.raises(InvalidInputError, match="multiples of 4"):
        train_renderer([odd], small, settings, rng=np.random.default_rng(0))
    with pytest.raises(InvalidInputError, match="no clips"):
        evaluate_drawing(RendererNetwork(small), [])
