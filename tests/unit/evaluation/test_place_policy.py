"""A policy that finds objects once and moves as in demonstrations of such places."""

import dataclasses

import numpy as np
import pytest
import torch

from dextouch.clients import PolicyStart
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES
from dextouch.schemas import Observation
from services.cli.main import run_command
from services.evaluation.bundled_policies import bundled_policy, trained_policy
from services.evaluation.policies.behaviour_cloning import action_weights
from services.evaluation.trained_networks import load_checkpoint
from services.pipelines.place_policy import (
    KIND,
    Demonstration,
    Motion,
    PlacePolicy,
    Places,
    _motion_of,
    read_places,
    train_place_policy,
)
from services.world_model.checkpoints import write_state_checkpoint
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.dynamics.start_reader import StartReader
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.other_gloves import small_layout

PX = 32
SEEDS = range(1, 13)


def motions_to(targets_m, num_steps=20):
    """The right wrist goes straight from the origin to each target."""
    actions = np.zeros((len(targets_m), num_steps, 67))
    for part in POSE_SLICES:
        actions[..., part] = IDENTITY_POSE_9D
    share = np.linspace(0, 1, num_steps)
    actions[..., 9:12] = targets_m[:, None] * share[:, None]
    return actions


def places_of(targets_m, axes):
    wrists = np.zeros((len(targets_m), 6))
    return Places(np.concatenate([targets_m, wrists], axis=1), axes)


def drawn(count, seed, noise_m=0.0):
    rng = np.random.default_rng(seed)
    targets = rng.normal(0, [0.02, 0.02, 0.0], (count, 3))
    axes = rng.normal(size=(count, 6))
    return targets, places_of(targets + rng.normal(0, noise_m, targets.shape), axes)


def test_a_new_place_is_reached_though_its_axes_are_noise():
    targets, places = drawn(30, seed=0)
    motion = Motion.fitted(places, motions_to(targets))
    assert not motion.turned
    wanted, new = drawn(1, seed=1)
    reached = motion.at(new)
    assert np.linalg.norm(reached[-1, 9:12] - wanted[0]) < 1e-3
    np.testing.assert_allclose(reached[:, 18:], motions_to(wanted)[0, :, 18:], atol=1e-6)
    # Without the regression, the mean of all demonstrations is far off.
    assert np.linalg.norm(targets.mean(axis=0) - wanted[0]) > 5e-3


def test_noisy_demonstrations_are_averaged():
    targets, places = drawn(60, seed=2)
    noisy = targets + np.random.default_rng(3).normal(0, 0.01, targets.shape)
    motion = Motion.fitted(places, motions_to(noisy))
    wanted, new = drawn(1, seed=4)
    assert np.linalg.norm(motion.at(new)[-1, 9:12] - wanted[0]) < 5e-3


def test_axes_are_inputs_where_motions_depend_on_them():
    targets, places = drawn(60, seed=5)
    moved = targets.copy()
    moved[:, 0] = 0.02 * places.axes[:, 0]
    motion = Motion.fitted(places, motions_to(moved))
    assert motion.turned
    # Independent of the formula: leaving out each demonstration and fitting the others.
    errors = {}
    for turned in (False, True):
        inputs = places.inputs(turned=turned)
        design = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
        found = []
        for left_out in range(len(inputs)):
            rest = np.arange(len(inputs)) != left_out
            fit = np.linalg.lstsq(design[rest], moved[rest, 0], rcond=None)[0]
            found.append(design[left_out] @ fit - moved[left_out, 0])
        errors[turned] = np.square(found).mean()
    assert errors[True] < errors[False]


def test_places_far_from_all_demonstrations_move_no_hand_far():
    targets, places = drawn(30, seed=0)
    motion = Motion.fitted(places, motions_to(targets))
    far = dataclasses.replace(places, points_m=places.points_m[:1] + 5.0, axes=places.axes[:1])
    assert np.abs(motion.at(far)[:, 9:12]).max() < 0.1
    assert np.isfinite(motion.at(far)).all()


def test_motions_survive_their_tensors_and_broken_ones_are_refused():
    targets, places = drawn(12, seed=0)
    motion = Motion.fitted(places, motions_to(targets))
    back = Motion.from_tensors(motion.tensors())
    near = Places(places.points_m[:1], places.axes[:1])
    off = (back.at(near) - motion.at(near)) * action_weights()
    assert np.abs(off).max() < 0.05  # 1 mm
    for name in motion.tensors():
        tensors = motion.tensors()
        tensors[name] = tensors[name][..., :-1]
        with pytest.raises(InvalidInputError, match="are no motion"):
            Motion.from_tensors(tensors)


def test_tasks_whose_names_have_dots_keep_their_own_motion():
    targets, places = drawn(12, seed=0)
    motions = {task: Motion.fitted(places, motions_to(targets, steps))
               for task, steps in (("pick", 20), ("pick.fast", 10))}  # fmt: skip
    tensors = {f"motion.{task}.{name}": one for task, motion in motions.items()
               for name, one in motion.tensors().items()}  # fmt: skip
    for task, motion in motions.items():
        assert len(_motion_of(task, tensors).mean_motion) == len(motion.mean_motion)


def test_places_are_read_with_any_glove():
    layout = small_layout()
    config = DynamicsConfig(
        tasks=("reach",), num_objects=(1,), image_px=PX, touch_channels=8, layout=layout
    )
    seen = Observation(
        first_step=0,
        images={"camera_head": np.zeros((1, PX, PX, 3), np.uint8)},
        tactile_kpa=np.zeros((1, 2, layout.num_taxels), np.float32),
        action_reached=motions_to(np.zeros((1, 3)))[0, :1],
        reached_is_measured=True,
    )
    readers = [StartReader(config).eval()]
    assert read_places(readers, config, "reach", seen, toy.ANCHOR, toy.K_HEAD).axes.shape == (1, 6)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A state model of random weights that knows the toy task."""
    one = untrained_state_checkpoint()
    torch.manual_seed(0)
    config = DynamicsConfig(tasks=("reach",), num_objects=(1,), image_px=PX, width=16)
    about = one.metadata.model_copy(
        update={
            "dynamics": config,
            "object_names": {"reach": ("spot",)},
            "object_boxes_m": {"reach": one.metadata.object_boxes_m["stand_bottle"]},
        }
    )
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    write_state_checkpoint(path, DynamicsModel(config, num_members=2), one.renderer, about)
    return path


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("places"))
    for seed in SEEDS:
        write(store, toy.demonstration("reach", seed), origin="recorded", seed=None)
    return store


@pytest.fixture(scope="module")
def policy_file(model, store, tmp_path_factory):
    output = tmp_path_factory.mktemp("policy") / "places.safetensors"
    flags = ["--episodes", str(store.root), "--places", str(model), "--output", str(output)]
    assert run_command(["train", "policy", *flags, "--image-px", str(PX)]) == 0
    return output


def started(policy, reader, seed=0):
    one = Demonstration.of(reader, PX)
    grid = one.grid
    policy.reset(PolicyStart(grid.task, "Touch it.", seed, grid.anchor, grid.K_head))
    return one


def test_the_file_is_loaded_as_any_trained_policy(policy_file, store):
    policy = bundled_policy("behaviour-cloning", policy_file)
    assert isinstance(policy, PlacePolicy)
    assert set(policy.metadata.training_episodes) == set(store.list())
    assert len(policy.metadata.training_starts) == len(SEEDS)
    assert policy.metadata.metrics == {"num_demonstrations_reach": len(SEEDS)}


def test_chunks_are_those_of_one_motion_and_the_end_is_held(policy_file, store):
    policy = trained_policy(policy_file)
    one = started(policy, store.open(store.list()[0]))
    first = policy.act(one.first)
    assert first.shape == (16, 67)
    later = dataclasses.replace(one.first, first_step=16, images={})
    second = policy.act(later)
    assert not np.array_equal(first, second)
    held = policy.act(dataclasses.replace(later, first_step=500))
    np.testing.assert_array_equal(held, np.repeat(held[-1:], 16, axis=0))
    # What it was shown once does not change by what it is shown later.
    np.testing.assert_array_equal(policy.act(later), second)


def test_what_it_cannot_do_is_refused(policy_file, model, store):
    policy = trained_policy(policy_file)
    reader = store.open(store.list()[0])
    one = Demonstration.of(reader, PX)
    with pytest.raises(InvalidInputError, match="act before reset"):
        policy.act(one.first)
    with pytest.raises(UnknownNameError, match="task of the place policy"):
        policy.reset(PolicyStart("juggle", "", 0, one.grid.anchor, one.grid.K_head))
    started(policy, reader)
    with pytest.raises(UnknownNameError, match="camera"):
        policy.act(dataclasses.replace(one.first, images={}))
    small = {"camera_head": one.first.images["camera_head"][:, :16, :16]}
    with pytest.raises(InvalidInputError, match="got an image"):
        policy.act(dataclasses.replace(one.first, images=small))
    with pytest.raises(InvalidInputError, match="expected at least 5; record more"):
        train_place_policy([one] * 4, model, command="test")
    config = DynamicsConfig(tasks=("other",), num_objects=(1,), image_px=PX)
    with pytest.raises(UnknownNameError, match="task of the place policy"):
        read_places([], config, "reach", one.first, one.grid.anchor, one.grid.K_head)
    flags = ["--episodes", str(store.root), "--places", str(model), "--early-at", "0.5"]
    flags += ["--training.batch-size", "8"]
    with pytest.raises(InvalidInputError, match="got --early-at and --training,"):
        run_command(["train", "policy", *flags])


def test_a_file_without_a_motion_is_refused(policy_file):
    checkpoint = load_checkpoint(policy_file, kind=KIND)
    kept = {n: t for n, t in checkpoint.tensors.items() if not n.endswith("weights")}
    with pytest.raises(InvalidInputError, match="are no motion"):
        PlacePolicy(dataclasses.replace(checkpoint, tensors=kept))
