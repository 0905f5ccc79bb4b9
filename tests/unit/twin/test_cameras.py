"""Pictures: a known point appears at the projected pixel, and the hand moves with its camera."""

import numpy as np
import pytest

from dextouch.geometry import apply, invert, project
from services.twin.cameras import HEAD_HOME, CameraRig
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
