"""Free, fixed and jointed objects: poses, speeds and contacts against MuJoCo and by hand."""

import mujoco
import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import actions_from_poses, poses_from_actions
from services.twin.cameras import HEAD_HOME
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TakeOptions, record
from services.twin.scene import compile_scene, object_boxes_m
from services.twin.simulation import STEPS_PER_GRID, STEPS_PER_TACTILE, Command, Simulation
from services.twin.stage import _displaced, command_row
from services.twin.tasks.task import relaxed

HALF_TURN = np.sqrt(0.5)
# A box with a drawer that pulls along -y, a door on its right edge, and a ball on the table.
FURNITURE = """
<body name="cabinet" mocap="true"><geom class="object" type="box" size="0.05 0.04 0.03"
 pos="0 0 0.03"/>
 <body name="drawer" pos="0 -0.05 0.03"><joint name="pull" type="slide" axis="0 -1 0"
  range="0 0.1" damping="1"/><geom class="object" type="box" size="0.03 0.01 0.02" mass="0.1"/>
 </body>
 <body name="door" pos="0.05 0 0"><joint name="swing" type="hinge" axis="0 0 1" damping="0.001"/>
  <geom class="object" type="box" size="0.03 0.002 0.02" pos="0.05 0 0.05" mass="0.05"/></body>
</body>
<body name="ball"><freejoint/><geom class="object" type="sphere" size="0.02" mass="0.03"/></body>
"""
NAMES = ("drawer", "ball", "cabinet", "door")
# The cabinet at (0.1, 0.2, 0), turned by 90° to the left: its -y becomes the world's +x.
PLACED = np.array(
    [
        [0.15, 0.20, 0.03, HALF_TURN, 0, 0, HALF_TURN],
        [-0.05, 0.10, 0.02, 1, 0, 0, 0],
        [0.10, 0.20, 0.0, HALF_TURN, 0, 0, HALF_TURN],
        [0.10, 0.25, 0.0, HALF_TURN, 0, 0, HALF_TURN],
    ]
)


def still() -> Command:
    hands = [relaxed("left", "robot"), relaxed("right", "robot")]
    Ts = [hand.T_world_wrist for hand in hands]
    return Command(np.stack([*Ts, HEAD_HOME]), np.stack([hand.joints_rad for hand in hands]))


@pytest.fixture
def furnished():
    return Simulation(compile_scene("robot", objects=FURNITURE, object_names=NAMES))


def pulled(simulation, *, distance_m: float = 0.0, turn_rad: float = 0.0, speed: float = 0.0):
    model, data = simulation.scene.model, simulation.data
    for name, value in (("pull", distance_m), ("swing", turn_rad)):
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
        data.qpos[model.jnt_qposadr[joint]] = value
        data.qvel[model.jnt_dofadr[joint]] = speed if name == "pull" else 0.0


def test_objects_stand_where_they_were_placed(furnished):
    furnished.place(still(), PLACED, settle_s=0.1)
    np.testing.assert_allclose(furnished.object_poses(), PLACED, atol=5e-4)
    assert furnished.object_speeds().max() < 0.02
    assert [furnished.touches_table(index) for index in range(4)] == [False, True, False, False]


def test_a_drawer_moves_along_its_slide_and_a_door_about_its_hinge(furnished):
    furnished.place(still(), PLACED, settle_s=0.0)
    pulled(furnished, distance_m=0.06, turn_rad=np.pi / 2, speed=0.3)
    expected = PLACED.copy()
    expected[0, 0] += 0.06
    expected[3, 3:] = [0, 0, 0, 1]
    np.testing.assert_allclose(furnished.object_poses(), expected, atol=1e-12)
    np.testing.assert_allclose(furnished.object_speeds(), [0.3, 0, 0, 0], atol=1e-12)


def test_poses_are_current_after_every_physics_step(furnished):
    furnished.place(still(), PLACED, settle_s=0.0)
    pulled(furnished, speed=0.5)
    for _ in furnished.advance(still()):
        got = furnished.object_poses()
        truth = mujoco.MjData(furnished.scene.model)
        truth.qpos[:] = furnished.data.qpos
        truth.mocap_pos[:], truth.mocap_quat[:] = (
            furnished.data.mocap_pos,
            furnished.data.mocap_quat,
        )
        mujoco.mj_forward(furnished.scene.model, truth)
        ids = [furnished.scene.model.body(name).id for name in NAMES]
        np.testing.assert_array_equal(got[:, :3], truth.xpos[ids])
    assert furnished.object_poses()[0, 0] > PLACED[0, 0] + 0.01


def test_a_state_holds_where_fixed_things_stand(furnished):
    furnished.place(still(), PLACED, settle_s=0.0)
    pulled(furnished, speed=0.5)
    state, step = furnished.state(), furnished.step_index
    list(furnished.advance(still()))
    expected = furnished.object_poses()
    elsewhere = PLACED + np.array([0.1, -0.1, 0, 0, 0, 0, 0])
    furnished.place(still(), elsewhere, settle_s=0.0)
    furnished.set_state(state, step_index=step)
    np.testing.assert_allclose(furnished.object_poses()[2], PLACED[2], atol=1e-12)
    list(furnished.advance(still()))
    assert furnished.object_poses().tobytes() == expected.tobytes()


def test_a_miss_moves_everything_together(furnished):
    for seed in range(4):
        moved = _displaced(PLACED, np.random.default_rng(seed))
        furnished.place(still(), moved, settle_s=0.0)
        np.testing.assert_allclose(furnished.object_poses(), moved, atol=1e-6)


def test_parts_that_cannot_both_be_there_are_refused(furnished):
    torn = PLACED.copy()
    torn[0, 1] += 0.01
    with pytest.raises(InvalidInputError, match="'cabinet'"):
        furnished.place(still(), torn, settle_s=0.0)


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        ('<body name="thing"><geom size="0.01"/></body>', "'thing'"),
        ('<body name="thing"><joint type="ball"/><geom size="0.01"/></body>', "'thing'"),
        ('<body name="other"/>', "names of bodies"),
    ],
)
def test_bodies_that_cannot_be_placed_are_refused(objects, message):
    with pytest.raises(InvalidInputError, match=message):
        Simulation(compile_scene("robot", objects=objects, object_names=("thing",)))


def test_contacts_are_told_by_hand_and_object(furnished):
    hand_m = relaxed("right", "robot").T_world_wrist[:3, 3]
    placed = PLACED.copy()
    placed[1, :3] = hand_m + np.array([0.0, 0.06, -0.02])
    furnished.place(still(), placed, settle_s=0.0)
    np.testing.assert_array_equal(furnished.hand_contacts(), [[0, 0, 0, 0], [0, 1, 0, 0]])
    assert furnished.hand_touches(1)
    assert not furnished.hand_touches(0)
    assert furnished.hand_touches()
    placed[1, :3] = [0.10, 0.20, 0.079]
    furnished.place(still(), placed, settle_s=0.0)
    assert furnished.objects_touch(1, 2)
    assert furnished.objects_touch(2, 1)
    assert not furnished.objects_touch(0, 1)
    assert not furnished.hand_touches()


def test_boxes_of_shapes_are_those_computed_by_hand():
    turned = 'quat="0.9238795325112867 0.3826834323650898 0 0"'  # 45° about x
    objects = f"""<body name="thing" pos="1 2 3" quat="0.5 0.5 0.5 0.5"><freejoint/>
     <geom type="cylinder" size="0.03 0.10" {turned}/>
     <geom type="capsule" size="0.01 0.05" pos="0.3 0 0" euler="0 1.5707963267948966 0"/>
     <body pos="0 0 -0.2"><geom type="ellipsoid" size="0.01 0.02 0.04" {turned}/></body></body>
     <body name="block"><freejoint/><geom type="box" size="0.1 0.2 0.3" pos="0 0 1" {turned}/>
     </body>"""
    boxes = object_boxes_m(compile_scene("robot", objects=objects, object_names=("thing", "block")))
    side = (0.03 + 0.10) * np.sqrt(0.5)
    bottom = -0.2 - np.hypot(0.02, 0.04) * np.sqrt(0.5)
    low, high = np.array([-0.03, -side, bottom]), np.array([0.36, side, side])
    np.testing.assert_allclose(boxes[0], [*(low + high) / 2, *(high - low) / 2], atol=1e-9)
    half = 0.5 * np.sqrt(0.5)
    np.testing.assert_allclose(boxes[1], [0, 0, 1, 0.1, half, half], atol=1e-9)


@pytest.mark.slow
def test_a_task_of_free_objects_moves_as_mujoco_alone_moves_it(bowls_stage):
    """Fixed and jointed objects must not change a bit of scenes that have none."""
    episode = record(bowls_stage, 6, TakeOptions(0.01, images=()))
    plan = bowls_stage.plan(6, noise_m=0.01)
    bowls_stage.start(plan)
    simulation = bowls_stage.simulation
    model, data = simulation.scene.model, mujoco.MjData(simulation.scene.model)
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_setState(model, data, simulation.state(), kind)
    free = [int(model.body(name).jntadr[0]) for name in simulation.scene.object_names]
    where = [model.jnt_qposadr[joint] + np.arange(7) for joint in free]
    poses = [data.qpos[where].copy()]
    anchor = bowls_stage.anchor()
    commands = poses_from_actions(actions_from_poses(plan.commands, anchor), anchor)
    step = 0
    for row in range(1, NUM_GRID_STEPS):
        for _ in simulation.advance(command_row(commands, row)):
            step += 1
            data.mocap_pos[:], data.mocap_quat[:] = (
                simulation.data.mocap_pos,
                simulation.data.mocap_quat,
            )
            data.ctrl[:] = simulation.data.ctrl
            mujoco.mj_step(model, data)
            if step % STEPS_PER_TACTILE == 0:
                mujoco.mj_forward(model, data)
            if step % 6 == 0:
                poses.append(data.qpos[where].copy())
    assert step == (NUM_GRID_STEPS - 1) * STEPS_PER_GRID
    assert np.stack(poses).tobytes() == episode.streams["object_poses"].values.tobytes()
