"""Labels and depths of recorded steps, against the images and contacts that the physics gave."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.geometry import apply, invert
from dextouch.hands.actions import poses_from_actions
from services.evaluation.prediction_scenes import TABLE, labelled
from services.pipelines.twin_geometry import SceneViews
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage

PX = 48


@pytest.fixture(scope="module", params=["stand_bottle", "open_drawer"])
def take(request, tmp_path_factory):
    """A free object, and one on a slide; its stored images and the views of the same steps."""
    stage = Stage(request.param, "robot", TwinSettings(image_height_px=PX, image_width_px=PX))
    store = EpisodeStore(tmp_path_factory.mktemp("store"))
    options = TakeOptions(images=("camera_head",), streams="training")
    episode_id = write_episode(store, record(stage, 3, options))
    reader = store.open(episode_id)
    window = reader.window(0, reader.num_steps)
    poses = poses_from_actions(window.actions, window.anchor)
    objects = reader.read("object_poses").values.astype(np.float64)
    views = SceneViews(stage)
    steps = list(range(0, reader.num_steps, 12))
    return (
        stage,
        window.images["camera_head"][steps],
        views,
        [(step, views.of(poses, objects, step)) for step in steps],
        poses,
        objects,
    )


def test_a_rebuilt_step_looks_like_the_image_that_was_recorded(take):
    """The images were rendered during the physics, with every joint where it was."""
    stage, images, views, seen, poses, objects = take
    for image, (step, _) in zip(images, seen, strict=True):
        views.of(poses, objects, step)
        again = stage.rig.image(stage.simulation, "camera_head").astype(float)
        blocks = np.abs(again - image).mean(axis=2).reshape(PX // 4, 4, PX // 4, 4).mean((1, 3))
        assert blocks.max() < 1


def test_pixels_have_the_colour_of_what_their_label_says(take):
    _, images, views, seen, *_ = take
    for image, (_, (labels, _)) in zip(images, seen, strict=True):
        agrees = labelled(image[None], views.colours)[0] == labels
        # The rest are borders, after JPEG, and bodies of nearly one hue.
        assert agrees.mean() > 0.93


def test_every_body_is_seen_where_it_projects_to(take):
    """An object's pixels, back in the world by their depth, lie close to its pose."""
    stage, _, views, seen, poses, objects = take
    rays = stage.rig.rays["camera_head"].reshape(PX, PX, 3)
    for step, (labels, depth_m) in seen:
        T_world_camera = poses.Ts_world_camera_head[step]
        for index, name in enumerate(views.names[4:]):
            mask = labels == 4 + index
            if mask.sum() < 4:
                continue
            points = rays[mask] / rays[mask][:, 2:] * depth_m[mask][:, None]
            world = apply(T_world_camera, points)
            extent_m = np.abs(world.mean(axis=0) - objects[step, index, :3]).max()
            assert extent_m < 0.2, name
        table = labels == TABLE
        points = rays[table] / rays[table][:, 2:] * depth_m[table][:, None]
        np.testing.assert_allclose(apply(T_world_camera, points)[:, 2], 0.0, atol=1e-6)
        assert np.isfinite(invert(T_world_camera)).all()
