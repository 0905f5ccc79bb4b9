"""Renderers draw what moved, leave the rest alone, and do not care what else is drawn."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering.inputs import (
    CameraMotion,
    PreparedScenes,
    Scenes,
    drawing_inputs,
    sample_images,
)
from services.world_model.rendering.renderer import Renderer, RendererNetwork
from tests.unit.world_model.rendering.scene_by_hand import (
    BOXES_M,
    DOWN,
    K,
    SceneState,
    draw,
    shifted,
    stacked,
    turned,
)


def network(config: RendererConfig) -> RendererNetwork:
    """Weights that draw something everywhere."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        made = RendererNetwork(config)
        for weight in made.parameters():
            torch.nn.init.normal_(weight, std=0.08)
    return made


@pytest.fixture
def renderer(small) -> Renderer:
    return Renderer(network(small))


def test_nothing_that_moves_gives_the_start_image(renderer, image, still):
    drawn = draw(renderer, image, K, still, [still, still], BOXES_M)
    assert (drawn == image).all()


def test_skipping_the_network_changes_no_bit(small, image, still):
    states = [still, shifted(still, objects_m=(0.03, 0.0, 0.0)), still]
    renderer = Renderer(network(small))
    skipped = draw(renderer, image, K, still, states, BOXES_M)
    renderer._drawn = renderer._network
    np.testing.assert_array_equal(draw(renderer, image, K, still, states, BOXES_M), skipped)


def test_far_from_what_moved_the_image_is_the_start(renderer, image, still):
    poses = still.object_poses.copy()
    poses[0, 0] += 0.03
    drawn = draw(renderer, image, K, still, [replace(still, object_poses=poses)], BOXES_M)[0]
    changed = np.argwhere((drawn != image).any(axis=-1))
    # The box lies at x 2 … 11 cm and y 6 … 10 cm, 58 cm away, before or after; 4 px around it.
    focal = K[0, 0] / 0.58
    assert len(changed) > 100
    assert (changed[:, 1] >= 32 + 0.02 * focal - 6).all()
    assert (changed[:, 1] <= 32 + 0.11 * focal + 6).all()
    assert (changed[:, 0] >= 32 - 0.10 * focal - 6).all()
    assert (changed[:, 0] <= 32 - 0.06 * focal + 6).all()


def test_without_redrawing_the_table_only_bodies_change_under_a_moving_camera(image, still):
    config = RendererConfig(widths=(8, 16), depths=(1, 1), redraws_table=False)
    bare = replace(still, object_present=np.array([False, False]))
    hidden = transform(DOWN, np.array([0.0, 0.0, 5.0]))
    bare = replace(bare, Ts_world_wrist=np.stack([hidden, hidden]))
    moved = shifted(bare, camera_m=(0.004, 0.0, 0.0))
    drawn = draw(Renderer(network(config)), image, K, bare, [moved], BOXES_M)[0]
    positions = CameraMotion.between(
        K[None], bare.T_world_camera[None], moved.T_world_camera[None]
    ).image_positions((64, 64))
    planes = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255.0
    warped = sample_images(planes, torch.from_numpy(positions), interpolation="bicubic")
    expected = (warped[0].permute(1, 2, 0).clamp(0, 1) * 255).round().numpy()
    # The right edge shows what the start image lacks, and is the network's.
    np.testing.assert_array_equal(drawn[:, :55], expected[:, :55].astype(np.uint8))


@pytest.mark.parametrize(
    ("at_start", "now", "is_drawn"),
    [(True, True, True), (True, False, False), (False, True, False), (False, False, False)],
)
def test_an_object_is_drawn_that_was_there_at_the_start_and_still_is(
    image, still, small, at_start, now, is_drawn
):
    """Its colours come from the start image; the other object is never there."""
    first, then = (
        replace(still, object_present=np.array([present, False])) for present in (at_start, now)
    )
    scenes = Scenes(image[None], K[None], stacked(first), BOXES_M[None])
    drawn = drawing_inputs(
        PreparedScenes.of(scenes), stacked(then), np.zeros(1, dtype=np.int64), small
    )
    # Three channels of the warped start image, then those of the objects.
    assert bool(drawn.fine[:, 3:6].any()) == is_drawn


@pytest.mark.parametrize("redraws_table", [True, False])
def test_the_table_is_redrawn_as_the_camera_moves_if_it_may_be(image, still, redraws_table):
    """By 1 mm of 60 cm: a tenth of a pixel or so. The box moves, too."""
    config = RendererConfig(widths=(8, 16), depths=(1, 1), redraws_table=redraws_table)
    moved = shifted(still, camera_m=(0.001, 0.0, 0.0), objects_m=(0.03, 0.0, 0.0))
    scenes = Scenes(image[None], K[None], stacked(still), BOXES_M[None])
    states, owner = stacked(moved), np.zeros(1, dtype=np.int64)
    change = drawing_inputs(PreparedScenes.of(scenes), states, owner, config).change[0, 0]
    # A shift of focal length / 600, of a quarter of a pixel that counts as all.
    share = K[0, 0] / 600 / 0.25
    assert change.max() == 1.0
    table = change[-4:, 20:44]
    np.testing.assert_allclose(table, share if redraws_table else 0.0, rtol=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("uses_bfloat16", [False, True])
def test_alone_or_in_company_an_image_is_the_same(small, image, still, uses_bfloat16):
    rng = np.random.default_rng(0)
    states = [
        turned(shifted(still, objects_m=rng.normal(size=3) * 0.02), rng.normal(size=3) * 0.03)
        for _ in range(9)
    ]
    renderer = Renderer(network(small), uses_bfloat16=uses_bfloat16)
    together = draw(renderer, image, K, still, states, BOXES_M).astype(int)
    alone = [draw(renderer, image, K, still, [state], BOXES_M)[0] for state in states]
    assert np.abs(together - np.stack(alone)).max() <= 1
    again = draw(renderer, image, K, still, states, BOXES_M)
    np.testing.assert_array_equal(again, together)


@pytest.mark.long
@pytest.mark.parametrize("uses_bfloat16", [False, True])
def test_a_trace_of_single_images_gives_the_same_bytes(small, image, still, uses_bfloat16):
    rng = np.random.default_rng(1)
    renderer = Renderer(network(small), uses_bfloat16=uses_bfloat16)
    for _ in range(7):
        moved = turned(shifted(still, objects_m=rng.normal(size=3) * 0.02), rng.normal(size=3) / 30)
        # The first calls of a renderer are not traced.
        expected = Renderer(network(small), uses_bfloat16=uses_bfloat16)
        np.testing.assert_array_equal(
            draw(renderer, image, K, still, [moved], BOXES_M),
            draw(expected, image, K, still, [moved], BOXES_M),
        )
    assert renderer._paint._traces


def test_an_empty_slot_changes_nothing(renderer, image, still):
    moved = shifted(still, objects_m=(0.03, 0.01, 0.0))

    def with_slot(state: SceneState) -> SceneState:
        poses = np.concatenate([state.object_poses, [[9.0, 9, 9, 0, 0, 0, 0]]])
        return replace(state, object_poses=poses, object_present=np.array([True, True, False]))

    boxes = np.concatenate([BOXES_M, np.zeros((1, 6))])
    np.testing.assert_array_equal(
        draw(renderer, image, K, with_slot(still), [with_slot(moved)], boxes),
        draw(renderer, image, K, still, [moved], BOXES_M),
    )


def test_a_scene_without_slots_is_drawn(renderer, image, still):
    bare = replace(still, object_poses=np.zeros((0, 7)), object_present=np.zeros(0, dtype=bool))
    drawn = draw(renderer, image, K, bare, [turned(bare, (0, 0, 0.1))], np.zeros((0, 6)))
    assert drawn.shape == (1, 64, 64, 3)


@pytest.mark.long
@pytest.mark.parametrize("place", [[0, 0, 0.0], [0, 0, -1.0], [1e5, -1e5, 1e5], [0.05, 0.08, 0.0]])
@pytest.mark.parametrize("flip", [0.0, np.pi / 2, np.pi])
def test_wherever_the_camera_is_images_are_drawn(renderer, image, still, place, flip):
    R = rotation_from_vector(np.array([flip, 0.0, 0.0])) @ DOWN
    lost = replace(still, T_world_camera=transform(R, np.array(place, dtype=float)))
    with np.errstate(all="raise", under="ignore"):
        draw(renderer, image, K, still, [lost, still], BOXES_M)
        draw(renderer, image, K, lost, [still, lost], BOXES_M)
    inputs = np.isfinite(draw(renderer, image, K, lost, [still], BOXES_M * 0.0))
    assert inputs.all()


def test_states_are_taken_by_row(still):
    states = stacked(still, shifted(still, objects_m=(1.0, 0, 0)))
    assert states.take(np.array([1, 0])).object_poses[0, 0, 0] == states.object_poses[1, 0, 0]
