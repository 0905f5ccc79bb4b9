"""Place Phone: demonstrations and misses, the verdict by hand, the pocket by MuJoCo alone."""

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

SEEDS = (0, 4)
PAD = (0.15, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
STAND = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
# A quarter turn to the left and away from the origin.
TURNED_STAND = (-0.05, 0.04, 0.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
# In the corner of ledge and back rest, 26 mm above the table and leaning at 60°: 75 mm along the
# lean (0, 1/2, √3/2) and 4.5 mm out of the back rest (0, -√3/2, 1/2).
LEAN, OUT = np.array([0.0, 0.5, np.sqrt(0.75)]), np.array([0.0, -np.sqrt(0.75), 0.5])
SEAT_M = np.array([0.0, 0.0, 0.026]) + 0.075 * LEAN + 0.0045 * OUT
SEATED, NOTHING = (False, False, False, True, True), (False,) * 5


def leaning(*, aside_m=0.0, up_m=0.0, out_m=0.0, lean_deg=60.0):
    """The phone at a stand at the origin, by how far it is from its seat."""
    half = np.deg2rad(0.5 * lean_deg)
    middle_m = SEAT_M + up_m * LEAN + out_m * OUT + [aside_m, 0.0, 0.0]
    return (*middle_m, np.cos(half), np.sin(half), 0.0, 0.0)


@pytest.fixture(scope="module", params=["robot", "human"])
def phone_stage(request):
    return Stage("place_phone", request.param, TwinSettings())


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
def test_a_demonstration_places_the_phone_and_its_milestones_agree(phone_stage, seed):
    phone_stage.start(phone_stage.plan(seed))
    before = phone_stage.simulation.object_poses()
    reached = reached_at_every_step(phone_stage, seed)
    touched, lifted, over_stand, placed, released = reached.T
    assert not reached[0].any()
    assert reached.any(axis=0).all()
    assert (np.diff(reached.argmax(axis=0)) >= 0).all()
    assert not (lifted & ~touched).any()
    assert not (over_stand & ~lifted).any()
    assert not (released & ~placed).any()
    assert not (released & touched).any()
    assert (placed & touched).any()
    assert released[-1]
    after = phone_stage.simulation.object_poses()
    np.testing.assert_array_equal(after[1:], before[1:])
    # It leans: 60° between screen and table.
    np.testing.assert_allclose(transform_from_pose(after[0])[2, 2], 0.5, atol=0.05)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.slow
def test_a_miss_places_nothing(phone_stage, seed):
    assert not reached_at_every_step(phone_stage, seed, miss=True)[:, 1:].any()


@pytest.mark.long
def test_a_demonstrator_far_off_fails(phone_stage):
    assert not reached_at_every_step(phone_stage, 0, noise_m=0.1)[-1, -1]


@pytest.mark.parametrize(
    ("phone", "stand", "expected"),
    [
        (leaning(), STAND, SEATED),
        (leaning(aside_m=-0.013), STAND, SEATED),
        (leaning(aside_m=0.015), STAND, NOTHING),
        # Half in, on top of the lip, in front of the pocket.
        (leaning(up_m=0.007), STAND, NOTHING),
        (leaning(up_m=0.0096, out_m=0.0036, lean_deg=50.0), STAND, NOTHING),
        (leaning(out_m=0.010), STAND, NOTHING),
        # Leaning by 9° and by 14° more than the stand; on its pad; upside down in the pocket.
        (leaning(lean_deg=69.0), STAND, SEATED),
        (leaning(lean_deg=74.0), STAND, NOTHING),
        ((0.15, 0, 0.0205, 1, 0, 0, 0), STAND, NOTHING),
        ((*SEAT_M, 0, 0, -0.5, np.sqrt(0.75)), STAND, NOTHING),
        # The turned stand's pocket opens to the right: its y is the world's -x.
        (
            (-0.05 - SEAT_M[1], 0.04, SEAT_M[2], np.sqrt(3 / 8), 8**-0.5, 8**-0.5, np.sqrt(3 / 8)),
            TURNED_STAND,
            SEATED,
        ),
        (leaning(), TURNED_STAND, NOTHING),
    ],
)
def test_states_made_by_hand_are_judged_rightly(phone, stand, expected, hand_made):
    simulation = hand_made("place_phone", [phone, stand, PAD])
    task = get_task("place_phone")
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


@pytest.mark.parametrize("aside_m", [-0.010, 0.0, 0.010])
def test_a_phone_let_go_above_its_seat_slides_into_it(aside_m, hand_made):
    """MuJoCo alone says where the pocket leads, and that what rests there counts as seated."""
    start = leaning(aside_m=aside_m, up_m=0.018, out_m=0.003)
    simulation = hand_made("place_phone", [start, STAND, PAD])
    task = get_task("place_phone")
    assert not task.succeeded(simulation)
    for _ in range(900):
        mujoco.mj_step(simulation.scene.model, simulation.data)
    offset_m = simulation.object_poses()[0, :3] - SEAT_M
    assert abs(offset_m[0]) < 0.008
    np.testing.assert_allclose(offset_m[1:], 0.0, atol=0.001)
    assert task.succeeded(simulation)


@pytest.mark.parametrize("seed", range(6))
def test_all_objects_are_in_the_head_cameras_view(phone_stage, seed):
    phone_stage.start(phone_stage.plan(seed))
    simulation, rig = phone_stage.simulation, phone_stage.rig
    T_camera_world = invert(rig.pose(simulation, "camera_head"))
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    height_px, width_px = rig.image(simulation, "camera_head").shape[:2]
    for pose, box in zip(
        simulation.object_poses(), np.array(object_boxes_m(simulation.scene)), strict=True
    ):
        seen = apply(T_camera_world @ transform_from_pose(pose), box[:3] + signs * box[3:])
        pixels, in_front = project(rig.K["camera_head"], seen)
        assert in_front.all()
        assert ((pixels > 0) & (pixels < [width_px, height_px])).all()
