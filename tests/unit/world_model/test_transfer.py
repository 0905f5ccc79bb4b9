"""A state model that starts from another one keeps its cores and learns the outcomes of a task."""

import dataclasses

import pytest
import torch

from dextouch.episodes import split_of_scene
from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import write_state_checkpoint
from services.world_model.dynamics.core import direction_free_inputs
from services.world_model.dynamics.features import DynamicsConfig, TouchCodec
from services.world_model.settings import CoreSettings, ReaderSettings, StateTrainSettings
from services.world_model.training.member_training import (
    CoreData,
    _read_start,
    read_step,
    touch_latents,
    train_core,
    train_reader,
)
from services.world_model.training.scene_table import scene_table
from services.world_model.training.state_data import seed_ranges, splits_by_task, trained_splits
from services.world_model.training.state_trainer import (
    _assembled,
    _keep,
    _with_base,
    _Work,
    train_state,
)
from services.world_model.training.transfer import _OF_TASKS, Base
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.world_model.test_state_training import PX, episode

NEW = DynamicsConfig(tasks=("press",), num_objects=(1,), image_px=PX)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    one = untrained_state_checkpoint()
    path = tmp_path_factory.mktemp("base") / "base.safetensors"
    write_state_checkpoint(path, one.dynamics, one.renderer, one.metadata)
    return Base(path)


@pytest.fixture(scope="module")
def config(base):
    return base.configured(NEW, keeps_tasks=False)


@pytest.fixture(scope="module")
def table(config):
    return scene_table([episode(seed) for seed in range(8)], config)


def test_shapes_are_the_bases_and_tasks_the_new_ones(base, config):
    own = base.checkpoint.metadata.dynamics
    assert (config.width, config.tasks) == (own.width, ("press",))
    with pytest.raises(InvalidInputError, match="images of 32 px"):
        base.configured(NEW.model_copy(update={"image_px": 48}), keeps_tasks=False)


def test_only_the_estimate_of_success_of_a_core_changes(base, config, table):
    data = CoreData(table, touch_latents(TouchCodec(config.touch_channels), table), {})
    core = base.core(config, 1, seed=0, learns_all=False)
    trained = train_core(
        data, config, CoreSettings(num_steps=5, batch=4), seed=0, initial=core
    ).state_dict()
    known = base.checkpoint.dynamics.core.named_parameters()
    changed = {
        name.partition(".")[0] for name, value in known if not torch.equal(trained[name], value[1:])
    }
    assert changed == {"success"}
    # The estimate depends on distances and angles between predicted poses, not on the hidden state.
    uses = trained["success.0.weight"].any(-1)[0]
    assert uses.nonzero()[:, 0].tolist() == direction_free_inputs(config.width)
    torch.testing.assert_close(trained["boxes_m"][0, 0], table.boxes_m[0, 0])


def test_a_reader_starts_from_the_member_it_replaces(base, config, table):
    settings = ReaderSettings(num_steps=1, batch=4, learning_rate=1e-9, bfloat16=False)
    for member, old in enumerate(base.checkpoint.dynamics.readers()):
        initial = base.reader(config, member, seed=0)
        reader = train_reader(table, config, settings, seed=0, initial=initial)
        for name, value in reader.named_parameters():
            if name != "task.weight":
                torch.testing.assert_close(value, dict(old.named_parameters())[name])


def test_new_weights_of_tasks_are_drawn_from_the_seed(base, config):
    cores = [base.core(config, 0, seed=seed, learns_all=False) for seed in (1, 1, 2)]
    success = [core.success[-1].weight for core in cores]
    assert torch.equal(success[0], success[1])
    assert not torch.equal(success[0], success[2])
    one, same, other = (base.reader(config, 0, seed=seed).task.weight for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_of_the_same_tasks_the_estimate_sees_the_hidden_state_too(base):
    own = base.checkpoint.metadata.dynamics
    assert base.has_tasks_of(own)
    core = base.core(own, 0, seed=0, learns_all=False)
    assert core.success[0].weight[:, : own.width].any()
    assert [name for name, one in core.named_parameters() if one.requires_grad] == [
        name for name, _ in core.named_parameters() if name.startswith("success.")
    ]


def test_readers_of_the_base_can_be_kept(base, config, tmp_path):
    given = StateTrainSettings(episodes=("takes",), init=base._path, learn="success")
    with pytest.raises(InvalidInputError, match="have tasks press, expected some of --init, s"):
        _with_base(base, config, given)
    own = base.checkpoint.metadata.dynamics
    settings = _with_base(base, own, given)
    weights = settings.core.weights
    assert (weights.objects, weights.touch, weights.contact, weights.taxels) == (0, 0, 0, 0)
    assert (weights.success, settings.num_members) == (1, 2)
    work = _Work(settings, own, tmp_path, "hash", reads_starts=False)
    for member in range(2):
        _keep(base.core(own, member, seed=7, learns_all=False), work.core_file(member), 1.5)
    dynamics, _, cpu_s = _assembled(work, TouchCodec(own.touch_channels))
    assert cpu_s == 3.0
    for old, new in zip(base.checkpoint.dynamics.readers(), dynamics.readers(), strict=True):
        for name, value in old.state_dict().items():
            assert torch.equal(new.state_dict()[name], value), name


def test_without_a_base_no_readers_can_be_kept(tmp_path):
    settings = StateTrainSettings(episodes=(str(tmp_path),), learn="success")
    with pytest.raises(InvalidInputError, match="add --init PATH"):
        train_state(settings)


def test_seeds_of_the_base_remain_known(base):
    known = base.checkpoint.metadata.model_copy(update={"training_seeds": {"press": (3, 9)}})
    other = Base(base._path)
    other.checkpoint = dataclasses.replace(base.checkpoint, metadata=known)
    assert seed_ranges([episode(20), episode(21)], other) == {"press": (3, 21)}
    assert seed_ranges([episode(20), episode(21)], None) == {"press": (20, 21)}
    settings = StateTrainSettings(episodes=("takes",), splits=("C",))
    # The base was trained on all splits.
    assert (trained_splits(settings, other), trained_splits(settings, None)) == ((), ("C",))
    known = known.model_copy(update={"training_splits": ("A",)})
    other.checkpoint = dataclasses.replace(base.checkpoint, metadata=known)
    assert trained_splits(settings, other) == ("A", "C")


def test_splits_of_a_new_task_are_those_of_its_own_training(base):
    def after(seeds, **changes):
        known = base.checkpoint.metadata.model_copy(update={"training_seeds": seeds, **changes})
        other = Base(base._path)
        other.checkpoint = dataclasses.replace(base.checkpoint, metadata=known)
        found = splits_by_task([episode(20)], settings, other)
        usual = trained_splits(settings, other)
        changes = {"task_splits": found, "training_splits": usual, "heldout_share": None}
        return known.model_copy(update=changes | {"training_seeds": {**seeds, "press": (0, 99)}})

    settings = StateTrainSettings(episodes=("takes",), splits=("A", "B"))
    assert splits_by_task([episode(20)], settings, None) == {}
    # The base was trained on all splits of another task.
    new = after({"push": (0, 99)})
    assert (new.splits_of("press"), new.splits_of("push")) == (("A", "B"), ())
    seen = [new.may_have_seen("press", seed) for seed in range(100)]
    assert seen == [split_of_scene("press", seed) != "C" for seed in range(100)]
    assert all(new.may_have_seen("push", seed) for seed in range(100))
    # What it had seen of the same task counts, too.
    assert after({"press": (0, 9)}).splits_of("press") == ()
    again = after({"press": (0, 9)}, task_splits={"press": ("C",)}, training_splits=("A",))
    assert again.splits_of("press") == ("A", "B", "C")


def test_the_estimate_alone_is_trained_from_what_a_reader_reads(base, table):
    reader = base.checkpoint.dynamics.readers()[0]
    read = read_step(reader, table, 0)
    touch = touch_latents(TouchCodec(base.checkpoint.metadata.dynamics.touch_channels), table)
    rows, settings = torch.tensor([5, 2]), CoreSettings()
    for starts_read in (True, False):
        data = CoreData(table, touch, {0: read}, starts_read)
        start = _read_start(data, rows, 0, settings, torch.Generator().manual_seed(0))
        given = reader(table.first_steps(rows, torch.zeros_like(rows)))
        is_read = torch.allclose(start.objects.position_m, given.objects.position_m)
        assert is_read is starts_read
        assert torch.allclose(start.sd_m, given.sd_m) is starts_read
        assert torch.allclose(start.size, given.size) is starts_read


def test_more_members_than_the_base_share_its_members(base, config):
    reader = base.checkpoint.dynamics.readers()[1].state_dict()
    taken = base.reader(config, 3, seed=0).state_dict()
    kept = [name for name in reader if name not in _OF_TASKS]
    assert kept
    assert all(torch.equal(taken[name], reader[name]) for name in kept)
    own = base.checkpoint.metadata.dynamics
    core, row = base.checkpoint.dynamics.core, base.core(own, 3, seed=0, learns_all=True)
    name = next(name for name, _ in row.named_parameters())
    assert torch.equal(row.get_parameter(name), core.get_parameter(name)[1:2])


@pytest.mark.parametrize(("flags", "expected"), [({}, 2), ({"num_members": 5}, 5)])
def test_the_number_of_members_is_the_bases_unless_it_is_chosen(base, config, flags, expected):
    settings = StateTrainSettings(episodes=("takes",), init=base._path, **flags)
    assert _with_base(base, config, settings).num_members == expected


def test_a_kept_ensemble_has_the_members_of_the_base(base, config):
    given = StateTrainSettings(episodes=("a",), init=base._path, learn="readers", num_members=3)
    with pytest.raises(InvalidInputError, match="--num-members: got 3, expected 2"):
        _with_base(base, config, given)
