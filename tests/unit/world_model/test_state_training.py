"""Start readers and cores learn a toy scene: a bright block that a descending hand presses."""

import dataclasses
import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from dextouch.episodes import ObjectTrack, split_by_scene
from dextouch.errors import InvalidInputError
from dextouch.geometry import apply, invert, pinhole_matrix, project, transform
from dextouch.hands.actions import IDENTITY_POSE_9D, POSE_SLICES, AnchorPoses
from dextouch.schemas import MAX_OBJECTS, EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.serving import load_settings
from services.world_model.dynamics.core import RecurrentCore, SceneStart
from services.world_model.dynamics.features import SLOT_SIZE, DynamicsConfig, TouchCodec
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.dynamics.start_reader import StartReader
from services.world_model.settings import (
    CoreLossWeights,
    CoreSettings,
    ReaderSettings,
    TrainStateCommand,
)
from services.world_model.training.evaluation import evaluate_dynamics
from services.world_model.training.member_training import (
    CoreData,
    _draw,
    _is_settled,
    _later_start,
    _read_start,
    core_loss,
    describe,
    read_step,
    reader_errors,
    start_steps,
    touch_latents,
    train_core,
    train_reader,
)
from services.world_model.training.scene_table import (
    SceneTable,
    scene_table,
    vocabulary,
)
from services.world_model.training.state_data import labelled_episodes
from services.world_model.training.state_trainer import _command
from tests.unit.world_model.toy_grid import ToyGrid, changed

PX, NUM_STEPS = 32, 17
K_HEAD = pinhole_matrix(width_px=PX, height_px=PX, fovy_rad=np.deg2rad(60))
CAMERA = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.5]))
BLOCK_HEIGHT_M = 0.03


def episode(seed, num_steps=NUM_STEPS):
    """The right hand comes down at its own place; it presses only if the block is under it."""
    rng = np.random.default_rng(seed)
    block_m = np.array([*rng.uniform(-0.1, 0.1, 2), BLOCK_HEIGHT_M])
    hits = seed % 2 == 0
    hand_m = block_m + ([0.0, 0.0, 0.2] if hits else [0.12, 0.12, 0.2])
    left_m = np.array([-0.3, 0.0, 0.2])
    anchor = AnchorPoses(transform(np.eye(3), left_m), transform(np.eye(3), hand_m), CAMERA)
    actions = np.zeros((num_steps, 67))
    for part in POSE_SLICES:
        actions[:, part] = IDENTITY_POSE_9D
    down = np.clip(np.arange(num_steps) / 10, 0, 1)
    actions[:, 11] = -0.2 * down
    tactile = np.zeros((num_steps, 2, 320), dtype=np.float32)
    tactile[down >= 0.8, 1, 80:] = 20.0 if hits else 0.0
    poses = np.zeros((num_steps, 1, 7), dtype=np.float32)
    poses[:, 0, :3], poses[:, 0, 3] = block_m, 1.0
    steps = np.arange(0, num_steps, 4)
    about = EpisodeAttributes(
        episode_id=f"toy-{seed}", task="press", instruction="press it", domain="robot",
        origin="twin", seed=seed, success=hits, object_names=("block",), K_head=matrix_rows(K_HEAD),
        anchor=StoredAnchor.from_poses(anchor),
    )  # fmt: skip
    known = np.ones(poses.shape[:2], dtype=bool)
    return ToyGrid(
        about=about, anchor=anchor, measured=actions, sent=actions, K_head=K_HEAD,
        tactile_kpa=tactile, objects=ObjectTrack.of_one_source("twin", poses, known),
        boxes_m=np.array([[0, 0, 0, 0.02, 0.02, 0.03]]),
        pictures=np.repeat(picture(block_m)[None], len(steps), axis=0), image_steps=steps,
    )  # fmt: skip


def picture(block_m):
    pixels, _ = project(K_HEAD, apply(invert(CAMERA), block_m[None]))
    rows, columns = np.mgrid[0:PX, 0:PX] + 0.5
    near = np.hypot(columns - pixels[0, 0], rows - pixels[0, 1]) < 2.5
    image = np.full((PX, PX, 3), 90, dtype=np.uint8)
    image[near] = (240, 60, 40)
    return image


@pytest.fixture(scope="module")
def config():
    return DynamicsConfig(
        tasks=("press",), num_objects=(1,), image_px=PX, width=32, reader_channels=16,
        reader_keypoints=8, touch_channels=8,
    )  # fmt: skip


@pytest.fixture(scope="module")
def table(config):
    return scene_table([episode(seed) for seed in range(48)], config)


@pytest.fixture(scope="module")
def held_out(config):
    return scene_table([episode(seed) for seed in range(1000, 1016)], config)


@pytest.fixture(scope="module")
def reader(table, config):
    torch.set_num_threads(1)
    settings = ReaderSettings(num_steps=250, batch=16, bfloat16=False)
    return train_reader(table, config, settings, seed=0)


@pytest.mark.long
def test_a_reader_finds_held_out_blocks(reader, held_out):
    # The mean place of all blocks is about 75 mm off.
    assert reader_errors(reader, held_out)["start_lateral_mm_press"] < 20


@pytest.mark.long
def test_the_same_seed_gives_the_same_reader(table, config):
    settings = ReaderSettings(num_steps=3, batch=4, bfloat16=False)
    one = train_reader(table, config, settings, seed=5).state_dict()
    other = train_reader(table, config, settings, seed=5).state_dict()
    assert all((one[name] == other[name]).all() for name in one)


@pytest.mark.long
def test_a_core_feels_what_it_touches_and_nothing_elsewhere(reader, table, held_out, config):
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(table.tactile_kpa.float().flatten(0, 2))
    data = CoreData(table, touch_latents(dynamics.codec, table), {})
    settings = CoreSettings(num_steps=250, batch=16)
    dynamics.eyes[0] = reader
    dynamics.core = train_core(data, config, settings, seed=0)
    figures, bounds = evaluate_dynamics(dynamics.eval(), held_out)
    assert figures["contact_f1_chunk_1"] > 0.8
    assert figures["contact_f1_chunk_1_of_copy"] == 0.0
    assert figures["final_object_mm_press"] < 25
    assert bounds.disagreement_m == 0.0
    assert figures["object_mm_chunk_1"] < 25
    assert bounds.distance > 0


@pytest.mark.long
def test_object_poses_without_labels_are_never_looked_at(config):
    episodes = [episode(seed) for seed in range(8)]
    lies = [changed(e, poses=e.objects.poses + 0.07) for e in episodes]
    known = [seed < 4 for seed in range(8)]
    settings = CoreSettings(num_steps=12, batch=8, held_fraction=0.5)
    trained = []
    for few in (episodes, episodes[:4] + lies[4:], lies):
        table = scene_table(few, config, labelled=known)
        reader = train_reader(
            table, config, ReaderSettings(num_steps=5, batch=8, bfloat16=False), seed=0
        )
        readings = {step: read_step(reader, table, step) for step in start_steps(table)}
        data = CoreData(table, touch_latents(TouchCodec(8), table), readings)
        core = train_core(data, config, settings, seed=0)
        trained.append([*reader.state_dict().values(), *core.state_dict().values()])
    assert all(torch.equal(a, b) for a, b in zip(trained[0], trained[1], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(trained[0], trained[2], strict=True))


def test_all_takes_of_a_scene_are_labelled_or_none():
    takes = [
        changed(episode(seed), episode_id=f"{take}-{seed}", task="stand_bottle")
        for seed in range(100)
        for take in "ab"
    ]
    settings = TrainStateCommand(episodes=("takes",), labelled_share=0.3)
    training, _ = split_by_scene(takes, held_out_share=settings.heldout_share)
    known = labelled_episodes(training, settings)
    chosen = {e.scene for e, one in zip(training, known, strict=True) if one}
    assert sum(known) == 2 * len(chosen)
    assert 0.15 < len(chosen) / len({e.scene for e in training}) < 0.45
    with pytest.raises(InvalidInputError, match="--labelled-share"):
        labelled_episodes(training, settings.model_copy(update={"labelled_share": 1e-6}))


@pytest.mark.slow
def test_cores_begin_anywhere_up_to_the_last_latent_step(config):
    table = scene_table([episode(seed, 81) for seed in range(2)], config)
    starts = start_steps(table)
    assert starts == [0, 8, 16, 24, 32, 40, 48, 56, 64, 72, 76]
    torch.manual_seed(0)
    blank = {step: read_step(StartReader(config), table, step) for step in starts}
    data = CoreData(table, touch_latents(TouchCodec(8), table), blank)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    settings = CoreSettings(batch=2, first_fraction=0.5)
    drawn = [_draw(data, settings, generator, rng) for _ in range(600)]
    counts = Counter(batch.start_step for batch in drawn)
    assert set(counts) == set(starts)
    # sqrt(18) : 1, within what 600 draws leave open.
    assert 2 < counts[8] / counts[76] < 9
    core = RecurrentCore(config)
    latest = next(batch for batch in drawn if batch.start_step == 76)
    assert len(latest.commands) == 2
    assert torch.isfinite(core_loss(core, data, latest, settings))


def test_a_core_knows_the_boxes_of_its_tasks_and_what_moves():
    config = DynamicsConfig(tasks=("lift", "press"), num_objects=(1, 1), image_px=PX, width=32)
    episodes = [changed(episode(seed), task=("press", "lift")[seed % 2]) for seed in range(8)]
    box = np.array([[0, 0, 0.01, 0.04, 0.02, 0.03]])
    episodes[1] = changed(episodes[1], boxes_m=box)
    episodes[1].objects.poses[4:, 0, 2] += 0.003
    lifts = [one for one in episodes if one.task == "lift"]
    episodes = [one for one in episodes if one.task == "press"] + [
        changed(one, boxes_m=box) for one in lifts
    ]
    table = scene_table(episodes, config)
    core = RecurrentCore(config)
    describe(core, table)
    assert core.movable.tolist() == [[1, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(core.boxes_m[0, 0], box[0], rtol=1e-6)
    np.testing.assert_allclose(core.boxes_m[1, 0], episodes[0].boxes_m[0], rtol=1e-6)
    assert core.boxes_m[:, 1:].count_nonzero() == 0


def test_distance_is_none_in_training_and_grows_beyond_it(config, table):
    core = RecurrentCore(config)
    describe(core, table)
    commands = table.commands(torch.arange(8), 0, torch.zeros(8, dtype=torch.bool))
    here_m = commands.points_m[:, 0, -1, :, 0]
    assert core.distance(commands, here_m).max() == 0
    far = dataclasses.replace(commands, joints_rad=commands.joints_rad + 1.0)
    farther = dataclasses.replace(commands, joints_rad=commands.joints_rad + 2.0)
    assert 0 < core.distance(far, here_m).min() < core.distance(farther, here_m).min()
    # A jump of the wrists is a speed that no take has.
    assert core.distance(commands, here_m + 1.0)[:, 0].min() > 0


def test_hands_are_held_still_only_where_nothing_would_happen(config):
    table = scene_table([episode(seed, 49) for seed in range(4)], config)
    # The hand of even seeds presses from step 8 on; one block of an odd seed slides at step 24.
    table.objects.position_m[3, 24:, 0, 0] += 0.01
    rows = torch.arange(4)
    assert _is_settled(table, rows, 0).all()
    assert _is_settled(table, rows, 16).tolist() == [False, True, False, True]
    assert _is_settled(table, rows, 24).tolist() == [False, True, False, False]
    assert _is_settled(table, rows, 32).tolist() == [False, True, False, True]


def test_rollouts_from_the_middle_are_measured_with_true_context(config):
    held_out = scene_table([episode(seed, 49) for seed in range(1000, 1008)], config)
    torch.manual_seed(0)
    dynamics = DynamicsModel(config, num_members=2).eval()
    measured, _ = evaluate_dynamics(dynamics, held_out)
    chunks = {0: 3, 16: 2, 32: 1}
    for start, count in chunks.items():
        place = f"from_{start}_" if start else ""
        for chunk in range(1, count + 1):
            assert 0 <= measured[f"contact_f1_{place}chunk_{chunk}"] <= 1
            assert measured[f"object_mm_{place}chunk_{chunk}"] > 0
        assert f"object_mm_{place}chunk_{count + 1}" not in measured
    # The block never moves: what is wrong is what an untrained reader saw and the core adds.
    true = held_out.objects_at(torch.arange(8), 32).position_m[:, 0]
    rows = torch.arange(8)
    commands = held_out.commands(rows, 32, torch.zeros(8, dtype=torch.bool))
    first = held_out.first_steps(rows, torch.full((8,), 32))
    touch = held_out.tactile_kpa[:, 32].float()
    memory = dynamics.begin(first, touch, commands[:1], torch.ones(8), torch.zeros(8, 0))
    _, imagined = dynamics.advance(memory, commands[1:])
    off_mm = 1e3 * (imagined.poses.position_m[:, -1, 0] - true).norm(dim=-1)
    np.testing.assert_allclose(measured["object_mm_from_32_chunk_1"], off_mm.median(), atol=1e-3)


def test_a_table_survives_its_tensors(table):
    back = SceneTable.from_tensors(table.tensors())
    assert back.image_steps == table.image_steps
    for name, tensor in table.tensors().items():
        assert torch.allclose(back.tensors()[name], tensor, rtol=0, atol=0, equal_nan=True)


def test_commands_begin_where_hands_are_measured(config):
    one = episode(0)
    lagging = one.measured.copy()
    lagging[:, 9] += 0.01
    late = scene_table([changed(one, measured=lagging)], config)
    rows = torch.tensor([0])
    sent = late.commands(rows, 4, torch.tensor([False]))
    reached = late.commands(rows, 4, torch.tensor([True]))
    torch.testing.assert_close(sent.points_m[:, 0], reached.points_m[:, 0])
    shift = reached.points_m[:, 1:, :, 1, :, 0] - sent.points_m[:, 1:, :, 1, :, 0]
    torch.testing.assert_close(shift, torch.full_like(shift, 0.01), atol=1e-6, rtol=0)
    assert len(sent) == 1 + (NUM_STEPS - 1 - 4) // 4


def shortened(one, num_steps):
    """The first steps of an episode."""
    shown = one.image_steps < num_steps
    return changed(
        one,
        sent=one.sent[:num_steps],
        measured=one.measured[:num_steps],
        tactile_kpa=one.tactile_kpa[:num_steps],
        poses=one.objects.poses[:num_steps],
        known=one.objects.known[:num_steps],
        pictures=one.pictures[shown],
        image_steps=one.image_steps[shown],
    )


def test_shorter_episodes_are_filled_by_their_last_step(config):
    long, short = episode(0), shortened(episode(1), NUM_STEPS - 6)
    both = scene_table([long, short], config)
    # Of NUM_STEPS - 6 steps, what is left over of a latent step is cut off.
    assert both.length.tolist() == [NUM_STEPS, NUM_STEPS - 8]
    last = NUM_STEPS - 9
    assert not both.objects_known[1, last + 1 :, 0].any()
    assert both.objects_known[1, : last + 1].all()
    touch = both.tactile_kpa[1, last:]
    assert (touch == touch[:1]).all()
    assert both.starts_at(last - 4).tolist() == [0, 1]
    assert both.starts_at(last).tolist() == [0]
    assert both.within(torch.arange(2), 0).sum(1).tolist() == [
        (NUM_STEPS - 1) // 4,
        (NUM_STEPS - 9) // 4,
    ]


def test_a_core_learns_nothing_from_behind_an_episodes_end(config):
    """Other touch, hands and poses there change neither the loss nor its gradient."""
    table = scene_table([episode(0), shortened(episode(1), NUM_STEPS - 8)], config)
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(table.tactile_kpa.float().flatten(0, 2))
    behind = slice(NUM_STEPS - 8, None)
    other = dataclasses.replace(
        table,
        tactile_kpa=_changed(table.tactile_kpa, behind, value=9.0),
        in_contact=_changed(table.in_contact, behind, value=True),
        objects=dataclasses.replace(
            table.objects, position_m=_changed(table.objects.position_m, behind, value=0.4)
        ),
    )
    settings = CoreSettings(batch=8)
    losses = [_loss_of(core_data(dynamics, one), config, settings) for one in (table, other)]
    assert losses[0] == losses[1]
    inside = dataclasses.replace(
        table, tactile_kpa=_changed(table.tactile_kpa, slice(NUM_STEPS - 12, None), value=9.0)
    )
    assert _loss_of(core_data(dynamics, inside), config, settings) != losses[0]


def test_a_core_learns_nothing_at_interpolated_steps(config):
    table = scene_table([episode(0), episode(1)], config)
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(table.tactile_kpa.float().flatten(0, 2))
    # One step of a latent spoils all four, of which the last is where poses count.
    given = dataclasses.replace(
        table, interpolated=_changed(table.interpolated, slice(6, 7), value=True)
    )
    latent = slice(5, 9)
    other = dataclasses.replace(
        given,
        tactile_kpa=_changed(table.tactile_kpa, latent, value=9.0),
        in_contact=_changed(table.in_contact, latent, value=True),
        objects=dataclasses.replace(
            table.objects, position_m=_changed(table.objects.position_m, latent, value=0.4)
        ),
    )
    settings = CoreSettings(batch=8, first_fraction=1.0)

    def loss(one):
        # What moves in a task is told by all steps.
        return _loss_of(core_data(dynamics, one), config, settings, described=table)

    losses = [loss(one) for one in (given, other)]
    assert losses[0] == losses[1]
    measured = dataclasses.replace(other, interpolated=table.interpolated)
    assert loss(measured) != losses[0]
    step = table.image_steps[1]
    late = dataclasses.replace(
        table, interpolated=_changed(table.interpolated, slice(step, step + 1), value=True)
    )
    assert table.starts_at(step).tolist() == [0, 1]
    assert late.starts_at(step).tolist() == [0]


def test_a_core_learns_nothing_from_taxels_that_were_not_measured(config):
    # A fingertip and half of another one of the left hand; of the right hand no sample late on.
    states = np.zeros(320)
    states[:24] = 2
    calibration = {"tactile_left_refused_taxels": (tuple(states.tolist()),)}
    settings = CoreSettings(batch=8, first_fraction=1.0)
    scenes = [changed(episode(seed), calibration=calibration) for seed in (0, 1)]
    tables = []
    for wrong_kpa in (0.0, 30.0):
        astray = []
        for one in scenes:
            touch_kpa = one.tactile_kpa.copy()
            touch_kpa[:, 0, :24] = wrong_kpa
            astray.append(dataclasses.replace(one, tactile_kpa=touch_kpa))
        tables.append(scene_table(astray, config))
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(tables[0].tactile_kpa.float().flatten(0, 2))
    losses = [_loss_of(core_data(dynamics, table), config, settings) for table in tables]
    assert losses[0] == losses[1]
    # The nearest taxel of the pad that was measured stands for one that was not.
    tips = scenes[0].tactile_kpa[:, 0, :80].reshape(-1, 5, 4, 4)
    filled = tables[1].tactile_kpa[0, :, 0, :80].reshape(-1, 5, 4, 4).numpy()
    np.testing.assert_allclose(filled[:, 1, 0], tips[: len(filled), 1, 2].astype(np.float16))
    assert (filled[:, 0] == 0.0).all()
    # Nor does what stands for it: it is an input alone.
    stood_in = dataclasses.replace(tables[0], tactile_kpa=tables[0].tactile_kpa.clone())
    stood_in.tactile_kpa[:, 1:, 0, :24] = 30.0
    latents = touch_latents(dynamics.codec, tables[0])
    losses = [_loss_of(CoreData(t, latents, {}), config, settings) for t in (tables[0], stood_in)]
    assert losses[0] == losses[1]
    unfelt = dataclasses.replace(tables[0], felt=tables[0].felt.clone())
    unfelt.felt[:, 9:, 1] = False
    other = dataclasses.replace(unfelt, tactile_kpa=unfelt.tactile_kpa.clone())
    other.tactile_kpa[:, 9:, 1] = 30.0
    other.in_contact[:, 9:, 6:] = True
    losses = [_loss_of(core_data(dynamics, table), config, settings) for table in (unfelt, other)]
    assert losses[0] == losses[1]


def _changed(values, steps, *, value):
    changed = values.clone()
    changed[1, steps] = value
    return changed


def core_data(dynamics, table):
    return CoreData(table, touch_latents(dynamics.codec, table), {})


def _loss_of(data, config, settings, described=None):
    torch.manual_seed(0)
    core = RecurrentCore(config)
    describe(core, described or data.table)
    batch = _draw(data, settings, torch.Generator().manual_seed(1), np.random.default_rng(1))
    return float(core_loss(core, data, batch, settings).detach())


def test_unknown_poses_train_neither_readers_nor_cores(config):
    one = episode(0)
    hidden = one.objects.known.copy()
    hidden[4:12] = False
    astray = one.objects.poses.copy()
    astray[4:12, 0, :3] = [0.3, 0.3, 0.3]
    tables = [
        scene_table([changed(one, known=hidden, poses=poses)], config)
        for poses in (one.objects.poses, astray)
    ]
    settings = ReaderSettings(num_steps=4, batch=8, bfloat16=False)
    readers = [train_reader(table, config, settings, seed=0).state_dict() for table in tables]
    assert all((readers[0][name] == readers[1][name]).all() for name in readers[0])
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(tables[0].tactile_kpa.float().flatten(0, 2))
    first = CoreSettings(batch=8, first_fraction=1.0)
    losses = [_loss_of(core_data(dynamics, table), config, first) for table in tables]
    assert losses[0] == losses[1]
    assert [bool(tables[0].knows_all(step).all()) for step in (0, 4, 8, 12)] == [
        True, False, False, True,
    ]  # fmt: skip


@pytest.mark.long
def test_a_core_starts_where_objects_are_unknown_from_what_the_reader_sees(reader, config):
    one = episode(0)
    hidden = one.objects.known.copy()
    hidden[8] = False
    table = scene_table([changed(one, known=hidden)], config)
    dynamics = DynamicsModel(config)
    dynamics.codec.fit(table.tactile_kpa.float().flatten(0, 2))
    readings = {step: read_step(reader, table, step) for step in start_steps(table)}
    data = CoreData(table, touch_latents(dynamics.codec, table), readings)
    rows = torch.zeros(3, dtype=torch.long)
    read = _read_start(data, rows, 8, CoreSettings(), torch.Generator().manual_seed(0))
    torch.testing.assert_close(read.objects.position_m[0], readings[8].objects.position_m[0])
    known = _read_start(data, rows, 0, CoreSettings(), torch.Generator().manual_seed(0))
    off_m = (known.objects.position_m[:, 0] - table.objects.position_m[0, 0, 0]).norm(dim=-1)
    assert 0 < float(off_m.max()) < 0.1


def test_measured_objects_move_when_they_move_by_more_than_their_error(config):
    still, noisy = episode(0), episode(1)
    shaken = noisy.objects.poses.copy()
    shaken[1::2, 0, 0] += 0.006
    measured = changed(noisy, poses=shaken, sources=("markers",))
    assert scene_table([still, measured], config).movable().tolist() == [[0.0] * MAX_OBJECTS]
    carried = noisy.objects.poses.copy()
    carried[8:, 0, 0] += 0.05
    moved = changed(measured, poses=carried)
    assert scene_table([still, moved], config).movable()[0, 0] == 1.0


@pytest.mark.parametrize("fault", ["size", "short", "task"])
def test_episodes_that_do_not_fit_are_refused(config, fault):
    wrong = episode(1)
    if fault == "size":
        wrong = changed(wrong, pictures=wrong.pictures[:, :16])
    elif fault == "short":
        wrong = shortened(wrong, 4)
    else:
        wrong = changed(wrong, task="juggle")
    with pytest.raises(InvalidInputError, match="toy-1"):
        scene_table([episode(0), wrong], config)


def test_steps_count_with_images_in_half_of_the_episodes(config):
    sparse = episode(1)
    sparse = changed(sparse, pictures=sparse.pictures[::2], image_steps=sparse.image_steps[::2])
    table = scene_table([episode(0), episode(2), sparse], config)
    assert list(table.image_steps) == episode(0).image_steps.tolist()
    assert table.shown[2].tolist() == [step in sparse.image_steps for step in table.image_steps]
    assert table.starts_at(4).tolist() == [0, 1]
    mostly = scene_table([episode(0), *[changed(sparse) for _ in range(2)]], config)
    assert list(mostly.image_steps) == sparse.image_steps.tolist()
    late = changed(sparse, image_steps=sparse.image_steps + 1)
    with pytest.raises(InvalidInputError, match=r"toy-1.*expected step 0"):
        scene_table([episode(0), late], config)


def test_starts_that_few_episodes_reach_are_rare(config):
    short = [shortened(episode(seed), 9) for seed in range(1, 20)]
    table = scene_table([episode(0), *short], config)
    rng = np.random.default_rng(0)
    drawn = Counter(_later_start([4, 8], table, rng) for _ in range(400))
    # Step 4 has 20 episodes and 12 steps left, step 8 one episode and 8 steps.
    assert drawn[8] / 400 == pytest.approx(np.sqrt(8) / (np.sqrt(8) + 20 * np.sqrt(12)), abs=0.03)


def test_a_task_has_one_number_of_objects():
    one = episode(1)
    two = changed(one, object_names=("block", "lid"))
    with pytest.raises(InvalidInputError, match="press"):
        vocabulary([episode(0), two])
    assert vocabulary([episode(0), episode(2)]) == (("press",), (1,))


def test_the_command_in_a_checkpoint_can_be_typed_again():
    settings = TrainStateCommand(
        episodes=("file:///data/takes", "more"),
        tasks=("press",),
        init=Path("/models/cores.safetensors"),
        core=CoreSettings(num_steps=7, weights=CoreLossWeights(touch=0.0)),
        name="first try",
        json=Path("/somewhere/figures.json"),
    )
    command = _command(settings)
    assert command.startswith("dextouch train world-model --episodes=takes --episodes=more ")
    assert "/" not in command
    again = load_settings(TrainStateCommand, shlex.split(command)[3:])
    assert again.name == "first try"
    assert again.core.num_steps == 7
    assert again.init == Path("cores.safetensors")
    assert again.core.weights.touch == 0.0
    assert again.tasks == ("press",)


def test_sizes_are_factors_of_the_usual_boxes():
    config = DynamicsConfig(tasks=("press",), num_objects=(1,), image_px=PX, width=32)
    episodes = [episode(seed) for seed in range(5)]
    box = episodes[0].boxes_m * [[1, 1, 1, 1.25, 1.25, 0.9]]
    episodes[3] = changed(episodes[3], boxes_m=box)
    table = scene_table(episodes, config)
    np.testing.assert_allclose(table.boxes_m[0, 0], episodes[0].boxes_m[0], rtol=1e-6)
    expected = np.ones((5, 3, 2))
    expected[3, 0] = 1.25, 0.9
    np.testing.assert_allclose(table.size, expected, rtol=1e-5)


@torch.no_grad()
def test_a_core_feels_the_size_that_was_read(config, table):
    """A hand beside a block of twice the width is inside it."""
    core = RecurrentCore(config).eval()
    describe(core, table)
    rows = torch.arange(2)
    commands = table.commands(rows, 0, torch.zeros(2, dtype=torch.bool))
    start = SceneStart(
        table.objects_at(rows, 0), torch.zeros(2, 3), torch.ones(2, 3, 2),
        torch.zeros(2, 2, 8), table.pads_kpa[rows, 0], table.task[rows], torch.ones(2),
        torch.zeros(2, 0),
    )  # fmt: skip
    boxes = []
    core.slot.register_forward_pre_hook(lambda _, inputs: boxes.append(inputs[0]))
    for factor in (1.0, 2.0):
        core(commands, dataclasses.replace(start, size=start.size * factor),
             core.first_state(start, commands[:1]))  # fmt: skip
    usual, doubled = boxes[0], boxes[len(boxes) // 2]
    # The box among the inputs, in decimetres.
    at = SLOT_SIZE
    torch.testing.assert_close(doubled[..., at : at + 6], 2 * usual[..., at : at + 6])
    # The first point's distance to it.
    assert (doubled[..., 0, 0] < usual[..., 0, 0]).all()
