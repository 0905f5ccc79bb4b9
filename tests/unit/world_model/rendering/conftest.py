"""A scene by hand: a camera 60 cm above the table, two resting hands, two boxes."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.geometry import transform
from services.world_model.network.configuration import RendererConfig
from services.world_model.rendering.inputs import Scenes
from services.world_model.rendering.training import SceneClip
from tests.unit.world_model.rendering.scene_by_hand import (
    BOXES_M,
    DOWN,
    K,
    SceneState,
    shifted,
    stacked,
)


@pytest.fixture
def still() -> SceneState:
    left, right = (transform(DOWN, np.array([x, -0.05, 0.10])) for x in (-0.12, 0.12))
    poses = np.array([[0.05, 0.08, 0.0, 1, 0, 0, 0], [-0.05, 0.08, 0.02, 1, 0, 0, 0]], dtype=float)
    return SceneState(
        transform(DOWN, np.array([0.0, 0.0, 0.6])),
        np.stack([left, right]),
        np.full((2, 20), 0.2),
        poses,
        np.array([True, True]),
    )


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (64, 64, 3), dtype=np.uint8)


@pytest.fixture
def scenes(image, still) -> Scenes:
    return Scenes(image[None], K[None], stacked(still), BOXES_M[None])


@pytest.fixture
def small() -> RendererConfig:
    return RendererConfig(widths=(8, 16), depths=(1, 1))


@pytest.fixture
def clips(still) -> list[SceneClip]:
    """A red square (the first box) that slides over grey; all else stands still."""
    made = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        states, images = [], []
        for step in range(5):
            move = np.array([*rng.uniform(-0.08, 0.08, size=2), 0.0]) * (step > 0)
            state = shifted(still, objects_m=move)
            u, v = (K @ [state.object_poses[0, 0], -state.object_poses[0, 1], 0.6])[:2] / 0.6
            picture = np.full((64, 64, 3), 120, dtype=np.uint8)
            columns = np.abs(np.arange(64) + 0.5 - u) < 0.03 * K[0, 0] / 0.6
            rows = np.abs(np.arange(64) + 0.5 - v) < 0.02 * K[0, 0] / 0.6
            picture[np.outer(rows, columns)] = [200, 30, 30]
            states.append(replace(state, object_present=np.array([True, False])))
            images.append(picture)
        made.append(SceneClip(np.arange(5) * 4, np.stack(images), stacked(*states), K, BOXES_M))
    return made
