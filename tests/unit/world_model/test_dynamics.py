"""Parts of the dynamics model against hand calculations, projections and other libraries."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.geometry import apply, invert, pinhole_matrix, project, transform
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses
from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics.core import (
    RecurrentCore,
    SceneStart,
    _ending_features,
    direction_free_inputs,
)
from services.world_model.dynamics.features import (
    NUM_POINTS,
    SAMPLE_OFFSETS,
    Commands,
    DynamicsConfig,
    ObjectPoses,
    TouchCodec,
    compressed,
    hand_motion,
    objects_from_poses,
    poses_from_objects,
    rotations,
    slot_features,
)
from services.world_model.dynamics.model import (
    REST_LATENTS,
    DynamicsModel,
    batched,
    mean_poses,
    memory_arrays,
    memory_from_arrays,
    memory_of,
)
from services.world_model.dynamics.start_reader import FirstStep, ray_at_height
from services.world_model.dynamics.tensor_trees import mapped, stacked

CONFIG = DynamicsConfig(tasks=("one", "two"), num_objects=(1, 2), image_px=32, width=16)


def anchor_at(*translations_m, turn=None):
    R = np.eye(3) if turn is None else Rotation.from_rotvec(turn).as_matrix()
    return AnchorPoses(*(transform(R, np.array(t)) for t in translations_m))


def still_actions(num_steps):
    actions = np.zeros((num_steps, 67))
    for part in POSE_SLICES:
        actions[:, part] = IDENTITY_POSE_9D
    return actions


def objects(batch=1, **changed):
    parts = {
        "position_m": torch.zeros(batch, MAX_OBJECTS, 3),
        "axes": torch.tensor([[0.0, 0, 1], [1, 0, 0]]).expand(batch, MAX_OBJECTS, 2, 3).clone(),
        "present": torch.ones(batch, MAX_OBJECTS),
    }
    return ObjectPoses(**{**parts, **changed})


def test_hands_stand_where_the_anchor_is_and_turn_with_it():
    straight = hand_motion(still_actions(3), anchor_at((0.1, 0, 0), (0, 0.2, 0), (0, 0, 1)))
    np.testing.assert_allclose(straight.points_m[:, 0, 0], [[0.1, 0, 0]] * 3)
    np.testing.assert_allclose(straight.points_m[:, 1, 0], [[0, 0.2, 0]] * 3)
    quarter = [0, 0, np.pi / 2]
    turned = hand_motion(
        still_actions(3), anchor_at((0.1, 0, 0), (0, 0.2, 0), (0, 0, 1), turn=quarter)
    )
    fingers = straight.points_m[0, 1, 1:] - straight.points_m[0, 1, 0]
    expected = np.stack([-fingers[:, 1], fingers[:, 0], fingers[:, 2]], axis=1)
    np.testing.assert_allclose(
        turned.points_m[0, 1, 1:] - turned.points_m[0, 1, 0], expected, atol=1e-6
    )


def test_a_pixel_at_a_height_is_the_point_that_projects_there():
    K = pinhole_matrix(width_px=64, height_px=64, fovy_rad=0.8)
    R = Rotation.from_euler("xyz", [-2.4, 0.1, 0.2]).as_matrix()
    T_world_camera = transform(R, np.array([0.02, -0.5, 0.55]))
    points = np.array([[0.05, 0.02, 0.03], [-0.1, 0.1, 0.0], [0.0, 0.0, 0.15]])
    pixels, in_front = project(K, apply(invert(T_world_camera), points))
    assert in_front.all()
    found = ray_at_height(
        torch.tensor(pixels, dtype=torch.float32)[None],
        torch.tensor(points[:, 2], dtype=torch.float32)[None],
        torch.tensor(K, dtype=torch.float32)[None],
        torch.tensor(T_world_camera, dtype=torch.float32)[None],
    )
    np.testing.assert_allclose(found[0].numpy(), points, atol=2e-5)


def test_pixels_of_the_sky_stay_within_reach():
    T = torch.as_tensor(transform(Rotation.from_euler("x", 90, degrees=True).as_matrix(),
        np.array([0.0, 0.0, 0.5]))).float()[None]  # fmt: skip
    K = torch.tensor(pinhole_matrix(width_px=64, height_px=64, fovy_rad=0.8)).float()[None]
    found = ray_at_height(torch.tensor([[[32.0, 60.0], [32.0, 2.0]]]), torch.zeros(1, 2), K, T)
    assert torch.isfinite(found).all()
    assert found.abs().max() <= 1.0


def random_points(*batch, seed=0, scale_m=0.1):
    generator = torch.Generator().manual_seed(seed)
    return scale_m * torch.randn(*batch, len(SAMPLE_OFFSETS), 2, NUM_POINTS, 3, generator=generator)


def matrix(turn):
    return torch.tensor(turn.as_matrix(), dtype=torch.float32)


def test_distances_to_a_box_are_those_of_another_library():
    """Outside against a bounded minimizer, inside against the nearest face."""
    half = np.array([0.03, 0.02, 0.05])
    middle = np.array([0.01, -0.02, 0.03])
    rotation = Rotation.random(random_state=3)
    place = np.array([0.2, 0.1, 0.05])
    points = random_points(1, seed=4, scale_m=0.04) + torch.tensor(place, dtype=torch.float32)
    found = slot_features(
        points,
        torch.tensor(place, dtype=torch.float32)[None, None],
        matrix(rotation)[None, None],
        torch.tensor(np.concatenate([middle, half]), dtype=torch.float32)[None, None],
    )
    each = found.reshape(2, len(SAMPLE_OFFSETS), NUM_POINTS - 1, 7)
    distance_m = 0.01 * torch.sinh(2 * each[..., 0])
    inside = 0
    for hand, look, point in np.ndindex(*each.shape[:3]):
        own = rotation.inv().apply(points[0, look, hand, point + 1].numpy() - place) - middle
        nearest = minimize(lambda x, own=own: ((x - own) ** 2).sum(), np.zeros(3),
            bounds=list(zip(-half, half, strict=True)))  # fmt: skip
        expected = np.sqrt(nearest.fun)
        if (np.abs(own) < half).all():
            inside += 1
            expected = -(half - np.abs(own)).min()
        assert float(distance_m[hand, look, point]) == pytest.approx(expected, abs=2e-5)
    assert inside >= 2


def test_features_of_a_scene_that_is_moved_and_turned_are_the_same():
    """Those in the object's frame: the last three of each point are in the world's."""
    rotation, shift = Rotation.from_rotvec([0.3, -0.5, 1.0]), np.array([0.3, -0.2, 0.1])
    points = random_points(1)
    moved = torch.tensor(rotation.apply(points.reshape(-1, 3).numpy()) + shift).float()
    boxes = torch.tensor([0.0, 0.0, 0.01, 0.02, 0.03, 0.04]).expand(1, 2, 6)
    unit = Rotation.identity()
    places = torch.tensor([[[0.05, 0.0, 0.02], [-0.1, 0.1, 0.0]]])
    here = slot_features(points, places, matrix(unit).expand(1, 2, 3, 3), boxes)
    there = slot_features(
        moved.reshape(points.shape),
        torch.tensor(rotation.apply(places[0].numpy()) + shift).float()[None],
        matrix(rotation).expand(1, 2, 3, 3),
        boxes,
    )
    parts = [one.reshape(2, 2, -1, 7)[..., :4] for one in (here, there)]
    torch.testing.assert_close(*parts, atol=1e-4, rtol=0)


def test_features_hold_a_millimetre_near_an_object():
    points = torch.zeros(1, len(SAMPLE_OFFSETS), 2, NUM_POINTS, 3)
    points[..., 0] = 0.02
    moved = points.clone()
    moved[0, 1, 1, 3, 0] += 0.001
    about = (torch.zeros(1, 1, 3), matrix(Rotation.identity()).expand(1, 1, 3, 3),
             torch.tensor([0.0, 0, 0, 0.02, 0.02, 0.02]).expand(1, 1, 6))  # fmt: skip
    change = slot_features(moved, *about) - slot_features(points, *about)
    each = change.reshape(2, len(SAMPLE_OFFSETS), NUM_POINTS - 1, 7)[1, 1, 2]
    # Outside the box by a millimetre: the distance to it changes most.
    np.testing.assert_allclose(each[0], np.arcsinh(0.1) / 2, rtol=1e-4)
    assert change.count_nonzero() == 3


def test_rotations_are_those_of_poses():
    generator = torch.Generator().manual_seed(0)
    axes = torch.randn(40, 2, 3, generator=generator)
    axes[:3, 1] = axes[:3, 0]
    axes[3] = 0.0
    R = rotations(axes)
    poses = poses_from_objects(ObjectPoses(torch.zeros(40, 3), axes, torch.ones(40)))
    expected = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()
    np.testing.assert_allclose(R[4:].numpy(), expected[4:], atol=1e-5)
    identity = R.transpose(-1, -2) @ R
    torch.testing.assert_close(identity, torch.eye(3).expand(40, 3, 3), atol=1e-5, rtol=0)


def test_distances_are_compressed_as_written():
    assert float(compressed(torch.tensor(0.0))) == 0.0
    np.testing.assert_allclose(float(compressed(torch.tensor(0.01))), np.log(1 + np.sqrt(2)) / 2)


def test_poses_go_through_position_and_axes_and_back():
    turns = Rotation.random(20, random_state=1)
    poses = np.concatenate(
        [np.linspace(-0.3, 0.3, 60).reshape(20, 3), turns.as_quat(scalar_first=True)], axis=1
    )[:, None]
    slots = objects_from_poses(poses)
    assert slots.present.tolist() == [[1.0, 0.0, 0.0]] * 20
    back = poses_from_objects(slots)[:, 0]
    np.testing.assert_allclose(back[:, :3], poses[:, 0, :3], atol=1e-6)
    turned = Rotation.from_quat(back[:, 3:], scalar_first=True) * turns.inv()
    assert turned.magnitude().max() < 1e-5


def test_an_axis_nobody_knows_still_gives_a_rigid_pose():
    axes = torch.tensor([[[[0.0, 0.0, 0.5], [0, 0, 0]]], [[[0.0, 0, 0], [0, 0, 0]]]])
    poses = poses_from_objects(ObjectPoses(torch.zeros(2, 1, 3), axes, torch.ones(2, 1)))
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0)
    z = Rotation.from_quat(poses[:, 0, 3:], scalar_first=True).apply([0, 0, 1])
    np.testing.assert_allclose(z, [[0, 0, 1]] * 2, atol=1e-9)


def test_what_left_the_table_is_not_there():
    poses = np.tile([0.0, -3.0, 0, 1, 0, 0, 0], (1, 1))
    assert objects_from_poses(poses).present.sum() == 0


def test_touch_latents_are_the_best_linear_ones():
    rng = np.random.default_rng(0)
    touch = np.maximum(rng.normal(size=(400, 6)) @ rng.normal(size=(6, 320)), 0) ** 2
    codec = TouchCodec(12)
    codec.fit(torch.tensor(touch, dtype=torch.float32))
    roots = np.sqrt(touch)
    _, _, directions = np.linalg.svd(roots, full_matrices=False)
    best = roots @ directions[:12].T @ directions[:12]
    ours = (codec.encode(torch.tensor(touch, dtype=torch.float32)) * codec.scale) @ codec.basis.T
    np.testing.assert_allclose(ours.numpy(), best, atol=2e-3)


def test_saturated_touch_stays_bounded_and_no_touch_is_none():
    codec = TouchCodec(8)
    codec.fit(40 * torch.rand(100, 320, generator=torch.Generator().manual_seed(0)))
    loud = codec.decode(codec.encode(torch.full((1, 320), 650.0)))
    assert loud.max() <= codec.peak_kpa
    assert codec.decode(codec.encode(torch.zeros(1, 320))).count_nonzero() == 0


def start(batch=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return SceneStart(
        objects(batch, position_m=0.1 * torch.randn(batch, MAX_OBJECTS, 3, generator=generator)),
        0.005 * torch.rand(batch, MAX_OBJECTS, generator=generator),
        1 + 0.1 * torch.rand(batch, MAX_OBJECTS, 2, generator=generator),
        torch.randn(batch, 2, CONFIG.touch_channels, generator=generator),
        torch.rand(batch, 12, generator=generator),
        torch.arange(batch) % 2,
        torch.ones(batch),
        torch.zeros(batch, 0),
    )


@pytest.fixture
def core():
    torch.manual_seed(0)
    return RecurrentCore(CONFIG).eval()


def random_commands(batch, latents, seed=1, scale_m=0.1):
    """Points anywhere, wrists turned anyhow, any joint angles."""
    generator = torch.Generator().manual_seed(seed)
    R = Rotation.random(batch * latents * 2, random_state=seed).as_matrix()
    columns = np.concatenate([R[..., 0], R[..., 1]], axis=-1)
    return Commands(
        random_points(batch, latents, seed=seed, scale_m=scale_m),
        torch.tensor(columns, dtype=torch.float32).reshape(batch, latents, 2, 6),
        torch.randn(batch, latents, 2, 20, generator=generator),
    )


def first_of(core, start, commands):
    return core.first_state(start, commands[:1])


@torch.no_grad()
def test_chunks_one_after_another_are_the_whole(core):
    commands = random_commands(2, 20)
    whole, end = core(commands, start(), first_of(core, start(), commands))
    state, parts = first_of(core, start(), commands), []
    for first in range(0, 20, 4):
        future, state = core(commands[first : first + 4], start(), state)
        parts.append(future.objects.position_m)
    torch.testing.assert_close(torch.cat(parts, dim=1), whole.objects.position_m)
    for one in dataclasses.fields(end):
        torch.testing.assert_close(getattr(state, one.name), getattr(end, one.name))


@pytest.mark.long
@torch.no_grad()
def test_a_state_is_bounded_whatever_comes(core):
    core.movable.fill_(1.0)
    wild = random_commands(2, 1000, scale_m=1e6)
    future, state = core(wild, start(), first_of(core, start(), wild))
    assert state.hidden.abs().max() <= 1.0
    assert state.position_m.abs().max() <= 1.0
    assert state.axes.abs().max() <= 1.0 + 1e-5
    assert torch.isfinite(future.touch).all()


@torch.no_grad()
def test_one_at_a_time_is_as_a_batch(core):
    """The second entry has more objects than the first."""
    commands, both = random_commands(2, 5), start()
    together, _ = core(commands, both, first_of(core, both, commands))
    one = mapped(both, lambda values: values[:1])
    first = mapped(commands, lambda values: values[:1])
    alone, _ = core(first, one, first_of(core, one, first))
    torch.testing.assert_close(alone.touch, together.touch[:1], atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("hand", [0, 1])
def test_what_a_hand_holds_moves_rigidly_with_it(core, hand):
    """With the gate of one hand open, against scipy's composition of rigid motions."""
    core.movable.fill_(1.0)
    core.motion.bias.zero_()
    core.motion.bias[0, hand] = 50.0
    commands, begun_at = random_commands(1, 6), start(1)
    future, _ = core(commands, begun_at, first_of(core, begun_at, commands))
    columns = commands.axes[0, :, hand].double().numpy()
    x, y = columns[:, :3], columns[:, 3:]
    wrist = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))
    wrist_m = commands.points_m[0, :, -1, hand, 0].double().numpy()
    from_wrist = wrist[0].inv().apply(begun_at.objects.position_m[0, 0].numpy() - wrist_m[0])
    expected = wrist.apply(from_wrist) + wrist_m
    np.testing.assert_allclose(future.objects.position_m[0, :, 0], expected.clip(-1, 1), atol=2e-4)
    z = wrist.apply(wrist[0].inv().apply([0, 0, 1.0]))
    np.testing.assert_allclose(future.objects.axes[0, :, 0, 0], z, atol=1e-3)


@torch.no_grad()
def test_fixed_objects_stay_whatever_the_gates_say(core):
    commands, begun_at = random_commands(2, 6), start()
    core.motion.bias.fill_(1.0)
    future, _ = core(commands, begun_at, first_of(core, begun_at, commands))
    still = begun_at.objects.position_m[1, :2].expand(6, 2, 3)
    torch.testing.assert_close(future.objects.position_m[1, :, :2], still)


@pytest.fixture
def model():
    torch.manual_seed(0)
    return DynamicsModel(CONFIG, num_members=2).eval()


ANCHOR = anchor_at((-0.1, 0, 0.1), (0.1, 0, 0.1), (0, -0.5, 0.5))


def begun(model, tasks=(0, 1)):
    motion = hand_motion(still_actions(1), ANCHOR)
    batch = len(tasks)
    first = FirstStep(
        torch.randint(0, 255, (batch, 32, 32, 3), dtype=torch.uint8,
            generator=torch.Generator().manual_seed(0)),
        torch.tensor(pinhole_matrix(width_px=32, height_px=32, fovy_rad=0.8)).float().expand(
            batch, 3, 3),
        torch.tensor(motion.Ts_world_camera).float().expand(batch, 4, 4),
        torch.tensor(motion.points_m).expand(batch, 2, NUM_POINTS, 3),
        torch.zeros(batch, 12),
        torch.tensor(tasks),
    )  # fmt: skip
    touch = 5 * torch.rand(batch, 2, 320, generator=torch.Generator().manual_seed(3))
    return model.begin(
        first, touch, Commands.holding([motion] * batch), torch.ones(batch), torch.zeros(batch, 0)
    )


def lifted(num_steps):
    actions = still_actions(num_steps)
    actions[:, 2] = np.linspace(0.001, 0.05, num_steps)
    return hand_motion(actions, ANCHOR)


def same_state(one, other):
    return all(
        torch.equal(getattr(one, part.name), getattr(other, part.name))
        for part in dataclasses.fields(one)
    )


def test_slots_a_task_has_not_are_empty(model):
    memory = begun(model)
    assert memory.poses.present[0, 1:].sum() == 0
    assert memory.poses.present[1, 2:].sum() == 0


def test_a_taxel_in_contact_feels_at_least_what_counts_as_contact(model):
    touch = torch.zeros(1, 2, model.config.touch_channels)
    # sigmoid(-0.6) = 0.354 and sigmoid(-0.65) = 0.343.
    taxels = torch.full((1, 2, 320), -0.65)
    taxels[0, 1, 319] = -0.6
    pressure = model.decode_touch(touch, taxels)
    assert np.argwhere(pressure.numpy() > 0).tolist() == [[0, 1, 319]]
    assert pressure[0, 1, 319] == 2.0


def test_steps_lie_on_the_line_between_latents(model):
    memory = begun(model)
    _, imagined = model.advance(memory, Commands.of([lifted(8)] * 2))
    position = imagined.poses.position_m
    assert position.shape == (2, 8, MAX_OBJECTS, 3)
    before = torch.cat([memory.poses.position_m[:, None], position[:, 3:4]], dim=1)
    for index in range(2):
        ends = before[:, index], position[:, 4 * index + 3]
        quarter = ends[0] + 0.25 * (ends[1] - ends[0])
        torch.testing.assert_close(position[:, 4 * index], quarter, atol=1e-6, rtol=0)


def test_hands_that_stand_for_two_seconds_bring_everything_to_rest(model):
    memory = begun(model)
    still = Commands.of([hand_motion(still_actions(16), ANCHOR)] * 2)
    for _ in range(REST_LATENTS // 4):
        memory, _ = model.advance(memory, still)
    rested, imagined = model.advance(memory, still)
    assert same_state(rested.state, memory.state)
    assert (imagined.tactile_kpa == memory.tactile_kpa[:, None]).all()
    for _ in range(60):
        rested, imagined = model.advance(rested, still)
    assert (imagined.tactile_kpa == memory.tactile_kpa[:, None]).all()
    moving, _ = model.advance(rested, Commands.of([lifted(16)] * 2))
    hidden = zip(moving.state.hidden, rested.state.hidden, strict=True)
    assert not any(torch.equal(*pair) for pair in hidden)


@pytest.mark.long
def test_hands_that_creep_do_not_stand_still(model):
    memory, path = begun(model), still_actions(16 * 20)
    path[:, 2] = 2e-5 * np.arange(1, len(path) + 1)
    total = 0
    for first in range(0, len(path), 16):
        motion = hand_motion(path[first : first + 16], ANCHOR)
        memory, imagined = model.advance(memory, Commands.of([motion] * 2))
        total += int(imagined.moves[0].sum())
    # 6.4 mm at 0.08 mm a latent step: every second step has left the last place by 0.1 mm.
    assert total == 40
    assert memory.num_still.max() < REST_LATENTS


def test_members_that_see_nothing_have_no_say_about_the_place(model):
    seen = objects(position_m=torch.full((1, MAX_OBJECTS, 3), 0.2))
    blind = objects(
        position_m=torch.full((1, MAX_OBJECTS, 3), 0.9), present=torch.zeros(1, MAX_OBJECTS)
    )
    starts = [dataclasses.replace(start(1), objects=each) for each in (seen, seen, blind)]
    memory = dataclasses.replace(begun(model), start=stacked(starts))
    mean = mean_poses(memory.start.objects)
    torch.testing.assert_close(mean.position_m, torch.full((1, MAX_OBJECTS, 3), 0.2))
    torch.testing.assert_close(mean.present, torch.full((1, MAX_OBJECTS), 2 / 3))


def test_rollouts_of_a_batch_share_no_memory(model):
    both = begun(model)
    one = memory_of(both, 0)
    before = both.tactile_kpa.clone()
    one.tactile_kpa.add_(1.0)
    one.state.hidden.add_(1.0)
    assert (both.tactile_kpa == before).all()
    assert one.tactile_kpa.untyped_storage().nbytes() == 2 * 320 * 4


def test_chunks_in_turn_imagine_what_one_long_chunk_does(model):
    memory = begun(model)
    _, whole = model.advance(memory, Commands.of([lifted(16)] * 2))
    halves = []
    for steps in (slice(0, 8), slice(8, 16)):
        memory, imagined = model.advance(memory, Commands.of([lifted(16)[steps]] * 2))
        halves.append(imagined)
    for name, dim in (("success", 2), ("tactile_kpa", 1)):
        parts = torch.cat([getattr(half, name) for half in halves], dim=dim)
        torch.testing.assert_close(parts, getattr(whole, name))
    positions = torch.cat([half.poses.position_m for half in halves], dim=1)
    torch.testing.assert_close(positions, whole.poses.position_m)


def test_members_that_agree_do_not_disagree(model):
    model.eyes[1].load_state_dict(model.eyes[0].state_dict())
    for weight in model.core.parameters():
        weight.data[1] = weight.data[0]
    _, imagined = model.advance(begun(model), Commands.of([lifted(8)] * 2))
    torch.testing.assert_close(imagined.disagreement_m, torch.zeros(2, 2), atol=1e-6, rtol=0)


def test_a_memory_survives_its_arrays(model):
    memory = begun(model)
    one = memory_of(memory, 1)
    arrays = memory_arrays(one)
    back = memory_from_arrays(arrays, CONFIG, 2)
    command = Commands.of([lifted(4)])
    expected, got = model.advance(one, command)[1], model.advance(back, command)[1]
    assert (expected.tactile_kpa == got.tactile_kpa).all()
    both = batched([memory_of(memory, 0), one])
    assert same_state(both.state, memory.state)


@pytest.mark.parametrize("damage", ["missing", "shape", "nan", "task"])
def test_damaged_memories_are_refused(model, damage):
    arrays = memory_arrays(memory_of(begun(model), 0))
    if damage == "missing":
        del arrays["state.hidden"]
    elif damage == "shape":
        arrays["poses.axes"] = arrays["poses.axes"][:, :1]
    elif damage == "nan":
        arrays["poses.position_m"] = arrays["poses.position_m"] * np.float32(np.nan)
    else:
        arrays["start.task"] = np.array([[7], [7]])
    with pytest.raises((InvalidInputError, NonFiniteError)):
        memory_from_arrays(arrays, CONFIG, 2)


def test_success_is_estimated_from_distances_and_angles_between_objects():
    rng = np.random.default_rng(4)
    Ts = [transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-0.2, 0.2, 3)) for _ in "ab"]
    # The third slot is empty.
    Ts.append(np.eye(4))
    position = torch.tensor(np.stack([T[:3, 3] for T in Ts])).float()[None, None]
    axes = torch.tensor(np.stack([[T[:3, 2], T[:3, 0]] for T in Ts])).float()[None, None]
    present = torch.tensor([1.0, 1.0, 0.0])[None, None]
    way = torch.tensor([[0.03, 0.04, 0.1], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])[None, None]
    about = torch.zeros(1, 1, 3, 13)
    found = _ending_features(position, axes, about, present, way)[0, 0].numpy()

    def scaled(*distances_m):
        return np.arcsinh(np.array(distances_m) / 0.01) / 2

    each = found[:72].reshape(3, 24)
    np.testing.assert_allclose(each[0, 22:], scaled(0.05, 0.1), rtol=1e-6)
    assert not each[2].any()
    T_a_b = invert(Ts[0]) @ Ts[1]
    apart, from_a = Ts[1][:3, 3] - Ts[0][:3, 3], T_a_b[:3, 3]
    from_b = invert(T_a_b)[:3, 3]
    expected = [
        *scaled(*apart, np.hypot(*apart[:2])),
        *scaled(*from_a, np.hypot(*from_a[:2])),
        *scaled(*from_b),
        T_a_b[2, 2],
        T_a_b[0, 0],
    ]
    np.testing.assert_allclose(found[72 : 72 + 13], expected, atol=1e-5)
    assert not found[72 + 13 :].any()


def test_some_inputs_of_the_estimate_do_not_depend_on_directions():
    rng = np.random.default_rng(5)
    Rs = Rotation.random(3, rng=rng).as_matrix()
    position, way = rng.uniform(-0.2, 0.2, (2, 3, 3))
    turn = Rotation.from_euler("z", 1.1).as_matrix()

    def features(R):
        axes = np.stack([(R @ Rs)[..., 2], (R @ Rs)[..., 0]], axis=1)
        moved = [torch.tensor(a).float()[None, None] for a in (position @ R.T, axes, way @ R.T)]
        about, present = torch.zeros(1, 1, 3, 13), torch.ones(1, 1, 3)
        return _ending_features(moved[0], moved[1], about, present, moved[2])[0, 0]

    one, turned = features(np.eye(3)), features(turn)
    free = direction_free_inputs(0)
    torch.testing.assert_close(one[free], turned[free], atol=1e-5, rtol=0)
    assert len(free) == 24
    assert (one - turned).abs().gt(1e-2).sum() > 20
