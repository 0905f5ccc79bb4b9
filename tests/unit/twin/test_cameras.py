"""Pictures: a known point appears at the projected pixel, and the hand moves with its camera."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.geometry import apply, invert, project, transform
from services.twin.cameras import HEAD_HOME, CameraRig, look_at
from services.twin.names import CAMERAS
from services.twin.scene import compile_scene
from services.twin.simulation import Command, Simulation
from services.twin.tasks.task import relaxed

MARK = (
    '<body name="mark"><freejoint/><geom class="object" type="sphere" size="0.006" '
    'rgba="1 0 1 1"/></body>'
)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.05), (0.12, 0.1, 0.006), (-0.1, -0.1, 0.15)])
def test_a_known_point_appears_at_the_projected_pixel(place):
    scene = compile_scene("robot", objects=MARK, object_names=("mark",))
    simulation = Simulation(scene)
    rig = CameraRig(scene, height_px=240, width_px=320)
    hands = [relaxed("left", "robot"), relaxed("right", "robot")]
    command = Command(
        np.stack([hands[0].T_world_wrist, hands[1].T_world_wrist, HEAD_HOME]),
        np.stack([hand.joints_rad for hand in hands]),
    )
    simulation.place(command, np.array([[*place, 1.0, 0.0, 0.0, 0.0]]), settle_s=0.0)
    image = rig.image(simulation, "camera_head").astype(int)
    rows, columns = np.nonzero((image[..., 0] > image[..., 1] + 40) & (image[..., 1] < 5))
    assert len(rows) > 3
    T_world_camera = rig.pose(simulation, "camera_head")
    point = apply(invert(T_world_camera), np.array([place]))
    pixels, in_front = project(rig.K["camera_head"], point)
    assert in_front.all()
    seen = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    np.testing.assert_allclose(seen, pixels[0], atol=1.0)


def test_the_same_state_gives_the_same_pictures(bottle_stage):
    bottle_stage.start(bottle_stage.plan(0))
    for camera in CAMERAS:
        one = bottle_stage.rig.image(bottle_stage.simulation, camera)
        other = bottle_stage.rig.image(bottle_stage.simulation, camera)
        assert one.tobytes() == other.tobytes()
        assert one.std() > 5


def test_wrist_cameras_ride_on_their_wrists(bottle_stage):
    bottle_stage.start(bottle_stage.plan(0))
    for side, anchor in zip(("left", "right"), bottle_stage.anchor().as_tuple(), strict=False):
        mount = invert(anchor) @ bottle_stage.rig.pose(
            bottle_stage.simulation, f"camera_wrist_{side}"
        )
        assert mount[2, 3] > 0.05
        assert mount[2, 2] < -0.9


def all_rays_cast(rig, simulation, T_world_camera, K):
    """What MuJoCo finds by testing every ray against every geom."""
    height, width = rig.shape_px
    rows, columns = np.mgrid[:height, :width] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    rays = rays.reshape(-1, 3) @ T_world_camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    geoms, distances_m = np.empty(len(rays), np.int32), np.empty(len(rays))
    groups = np.array([1, 1, 1, 1, 0, 0], dtype=np.uint8)
    mujoco.mj_multiRay(
        rig._model, simulation.data, T_world_camera[:3, 3].copy(), rays.ravel(), groups, 1, -1,
        geoms, distances_m, None, len(rays), 4.0,
    )  # fmt: skip
    depth_m = distances_m * (rays @ T_world_camera[:3, 2])
    return geoms.reshape(height, width), np.where(geoms < 0, np.inf, depth_m).reshape(height, width)


@pytest.mark.parametrize("seed", range(30))
def test_rays_that_are_left_out_meet_what_mujoco_says(seed, bottle_stage, monkeypatch):
    bottle_stage.start(bottle_stage.plan(seed))
    rig, simulation = bottle_stage.rig, bottle_stage.simulation
    generator = np.random.default_rng(seed)
    # Above, beside and below the table, in front of it and between the hands; any axis upwards.
    eye_m = generator.uniform([-1.2, -1.0, -0.3], [1.2, 1.0, 0.8])
    pose = look_at(eye_m, generator.uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.2]))
    roll = Rotation.from_euler("z", generator.uniform(0, 360), degrees=True).as_matrix()
    pose = pose @ transform(roll, np.zeros(3))
    monkeypatch.setattr(rig, "pose", lambda *_: pose)
    geoms, depth_m = rig.cast(simulation, "camera_head")
    expected, expected_m = all_rays_cast(rig, simulation, pose, rig.K["camera_head"])
    # Rays along an edge may fall to either side of it.
    same = geoms == expected
    assert same.mean() > 0.999
    np.testing.assert_allclose(depth_m[same], expected_m[same], rtol=1e-9)
