"""Insert Peg: success and failure of demonstrations, the verdict by hand, the fit by MuJoCo."""

import itertools

import mujoco
import numpy as np
import pytest

from dextouch.geometry import apply, invert, project, transform_from_pose
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.scene import object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, command_row
from services.twin.tasks import get_task

SEEDS = (1, 2, 5)
HALF_TURN = np.sqrt(0.5)
AT_ORIGIN = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
# Turned by 0.2 rad about z, as `place` may turn it, and away from the origin.
TURNED = (-0.08, 0.03, 0.0, np.cos(0.1), 0.0, 0.0, np.sin(0.1))
NOTHING = (False,) * 5


@pytest.fixture(scope="module", params=["robot", "human"])
def peg_stage(request):
    return Stage("insert_peg", request.param, TwinSettings())


def reached_at_every_step(stage, seed, **options):
    plan = stage.plan(seed, **options)
    stage.start(plan)
    reached = [stage.task.reached(stage.simulation)]
    for row in range(1, NUM_GRID_STEPS):
        for _ in stage.simulation.advance(command_row(plan.commands, row)):
            pass
        reached.append(stage.task.reached(stage.simulation))
    return np.array(reached)


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_a_demonstration_inserts_and_its_milestones_agree(peg_stage, seed):
    reached = reached_at_every_step(peg_stage, seed)
    touched, lifted, over_hole, inserted, released = reached.T
    assert not reached[0].any()
    assert reached.any(axis=0).all()
    assert (np.diff(reached.argmax(axis=0)) >= 0).all()
    # The hand holds what it lifts, what is in the hole is not lifted, and lets go at the end.
    assert not (lifted & ~touched).any()
    assert not (over_hole & ~lifted).any()
    assert not (inserted & lifted).any()
    assert not (released & ~inserted).any()
    assert not (released & touched).any()
    assert (inserted & touched).any()
    assert released[-1]
    foot_m = peg_stage.simulation.object_poses()[0, :3] - [0.0, 0.0, 0.09]
    socket_m = peg_stage.simulation.object_poses()[1, :3]
    np.testing.assert_allclose(foot_m, socket_m, atol=0.004)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_a_miss_inserts_nothing(peg_stage, seed):
    assert not reached_at_every_step(peg_stage, seed, miss=True)[:, 1:].any()


@pytest.mark.parametrize(
    ("peg", "socket", "expected"),
    [
        # On the hole's ground, in the middle and 1.5 mm aside; 8 mm and 12 mm above it.
        ((0, 0, 0.090, 1, 0, 0, 0), AT_ORIGIN, (False, False, False, True, True)),
        ((-0.08, 0.0315, 0.090, 1, 0, 0, 0), TURNED, (False, False, False, True, True)),
        ((0, 0, 0.098, 1, 0, 0, 0), AT_ORIGIN, (False, False, False, True, True)),
        ((0, 0, 0.102, 1, 0, 0, 0), AT_ORIGIN, NOTHING),
        # Beside the block, on top of it, upside down in the hole.
        ((0.10, 0, 0.090, 1, 0, 0, 0), AT_ORIGIN, NOTHING),
        ((0, 0, 0.126, 1, 0, 0, 0), AT_ORIGIN, NOTHING),
        ((0, 0, 0.090, 0, 1, 0, 0), AT_ORIGIN, NOTHING),
        # Lying with its foot at the hole; leaning by 12° and by 8° about the middle of its foot.
        ((0.09, 0, 0, HALF_TURN, 0, -HALF_TURN, 0), AT_ORIGIN, NOTHING),
        ((0.0187, 0, 0.0880, np.cos(np.pi / 30), 0, np.sin(np.pi / 30), 0), AT_ORIGIN, NOTHING),
        (
            (0.0125, 0, 0.0891, np.cos(np.pi / 45), 0, np.sin(np.pi / 45), 0),
            AT_ORIGIN,
            (False, False, False, True, True),
        ),
    ],
)
def test_states_made_by_hand_are_judged_rightly(peg, socket, expected, hand_made):
    simulation = hand_made("insert_peg", [peg, socket])
    task = get_task("insert_peg")
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


def contacts_with_socket(simulation) -> int:
    model, data = simulation.scene.model, simulation.data
    bodies = model.geom_bodyid[data.contact.geom[data.contact.dist < 0.0]]
    peg, socket = (
        mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in ("peg", "socket")
    )
    return int(((bodies == peg).any(axis=1) & (bodies == socket).any(axis=1)).sum())


@pytest.mark.parametrize(
    ("aside_m", "touches"), [(0.0, False), (0.0018, False), (0.0024, True), (-0.0024, True)]
)
def test_the_peg_has_two_millimetres_of_room(aside_m, touches, hand_made):
    for direction in ((1.0, 0.0), (0.0, 1.0)):
        x, y = aside_m * np.array(direction)
        simulation = hand_made("insert_peg", [(x, y, 0.0901, 1, 0, 0, 0), AT_ORIGIN])
        assert (contacts_with_socket(simulation) > 0) is touches


@pytest.mark.long
@pytest.mark.parametrize("seed", range(6))
def test_both_objects_are_in_the_head_cameras_view(peg_stage, seed):
    peg_stage.start(peg_stage.plan(seed))
    simulation, rig = peg_stage.simulation, peg_stage.rig
    T_camera_world = invert(rig.pose(simulation, "camera_head"))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    height_px, width_px = rig.image(simulation, "camera_head").shape[:2]
    for pose, box in zip(
        simulation.object_poses(), np.array(object_boxes_m(simulation.scene)), strict=True
    ):
        corners = box[:3] + signs * box[3:]
        seen = apply(T_camera_world @ transform_from_pose(pose), corners)
        pixels, in_front = project(rig.K["camera_head"], seen)
        assert in_front.all()
        assert ((pixels > 0) & (pixels < [width_px, height_px])).all()


def test_hands_do_not_hide_the_objects_at_the_start(peg_stage):
    peg_stage.start(peg_stage.plan(SEEDS[0]))
    image = peg_stage.rig.image(peg_stage.simulation, "camera_head").astype(int)
    red, green, blue = np.moveaxis(image, 2, 0)
    pixels_of = {
        "peg": (red > green + 30) & (blue > green + 15),
        "foot": (red > blue + 60) & (green > blue + 60),
        "chamfer": (green > red + 30) & (blue > red + 30),
    }
    counts = {name: int(mask.sum()) for name, mask in pixels_of.items()}
    assert min(counts.values()) > 0.0005 * image[..., 0].size, counts
