"""State models of robots and people: what they share, what is drawn, and what a run holds out."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore, scene_fraction
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.serving import load_settings
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.world_model import command_line
from services.world_model.checkpoints import (
    StateMetadata,
    read_state_checkpoint,
    write_state_checkpoint,
)
from services.world_model.dynamics.core import RecurrentCore
from services.world_model.dynamics.features import DynamicsConfig, TouchCodec
from services.world_model.paper_settings import AdaptCommand, TrainCommand
from services.world_model.settings import (
    AdaptStateCommand,
    CoreSettings,
    ReaderSettings,
    StateTrainSettings,
    TrainStateCommand,
)
from services.world_model.training.member_training import CoreData, _draw, core_loss, touch_latents
from services.world_model.training.scene_table import scene_table
from services.world_model.training.state_data import StateData, configured, load_state_data
from services.world_model.training.state_trainer import _command, train_state
from services.world_model.training.transfer import Base
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.world_model.conftest import checkpoint  # noqa: F401 (fixture)
from tests.unit.world_model.test_dynamics import random_commands, start
from tests.unit.world_model.test_state_training import PX, episode
from tests.unit.world_model.toy_grid import changed

pytestmark = pytest.mark.long

BOTH = DynamicsConfig(
    tasks=("press", "squeeze"), num_objects=(1, 1), image_px=PX, width=32, touch_channels=8,
    domains=("robot", "human"),
)  # fmt: skip
OPTIONS = TakeOptions(images=("camera_head",), image_every=8, streams="training")


def person(seed, task="squeeze"):
    return changed(episode(seed), domain="human", task=task, episode_id=f"person-{seed}")


def toy_core(domains=("robot", "human"), seed=0):
    torch.manual_seed(seed)
    config = DynamicsConfig(tasks=("a", "b"), num_objects=(2, 1), width=32, domains=domains)
    return RecurrentCore(config).eval()


def imagined(core, human=None):
    commands, begun = random_commands(2, 3), start()
    state = core.first_state(begun, commands[:1], human)
    return core(commands, begun, state, human)[0]


def test_a_person_is_another_input_with_a_skin_of_its_own():
    core = toy_core()
    robots, people = imagined(core), imagined(core, torch.tensor([0.0, 1.0]))
    for name in ("touch", "contact", "pattern", "success"):
        assert torch.equal(getattr(robots, name)[0], getattr(people, name)[0]), name
        assert not torch.equal(getattr(robots, name)[1], getattr(people, name)[1]), name
    # Touch of a person trains neither the touch of robots nor the other way round.
    for of_person, names in ((1.0, ("touch", "pattern")), (0.0, ("human.touch", "human.pattern"))):
        core.zero_grad()
        felt = imagined(core, torch.full((2,), of_person))
        (felt.touch.sum() + felt.pattern.sum() + felt.contact.sum()).backward()
        for name in names:
            assert not core.get_parameter(f"{name}.weight").grad.any(), name
        assert core.get_parameter("contact.weight").grad.any()


def test_a_model_of_robots_alone_has_no_weights_of_people():
    names = {name for name, _ in toy_core(("robot",)).named_parameters()}
    assert not {name for name in names if name.startswith("human")}
    alone = DynamicsConfig(tasks=("a",), num_objects=(1,))
    # As in the files of older releases.
    assert "domains" not in alone.model_dump(mode="json")


def test_a_share_of_what_is_drawn_is_human():
    episodes = [*(episode(seed) for seed in range(4)), *(person(seed) for seed in range(10, 22))]
    generator = torch.Generator().manual_seed(0)
    able = torch.arange(2, len(episodes))
    table = scene_table(episodes, BOTH, human_share=0.25)
    drawn = table.drawn(able, 8000, generator)
    assert set(drawn.tolist()) == set(able.tolist())
    # Two of the four robots are able; their share stays that of robots.
    assert table.human[drawn].float().mean() == pytest.approx(0.25, abs=0.02)
    plain = scene_table(episodes, BOTH)
    drawn = plain.drawn(able, 8000, generator)
    assert plain.human[drawn].float().mean() == pytest.approx(12 / 14, abs=0.02)
    # Without a share, batches are those of a model that does not tell domains apart.
    same = torch.Generator().manual_seed(3)
    expected = able[torch.randint(len(able), (5,), generator=torch.Generator().manual_seed(3))]
    assert torch.equal(plain.drawn(able, 5, same), expected)


def test_a_core_is_trained_on_both():
    episodes = [*(episode(seed) for seed in range(4)), *(person(seed) for seed in range(4))]
    table = scene_table(episodes, BOTH, human_share=0.5)
    torch.manual_seed(0)
    core, settings = RecurrentCore(BOTH), CoreSettings(batch=16)
    codec = TouchCodec(8)
    codec.fit(table.tactile_kpa[:, ::4].float().flatten(0, 2))
    data = CoreData(table, touch_latents(codec, table), {})
    batch = _draw(data, settings, torch.Generator().manual_seed(0), np.random.default_rng(0))
    assert 0 < int(table.human[batch.rows].sum()) < 16
    core_loss(core, data, batch, settings).backward()
    for name in ("touch", "human.touch", "pattern", "human.pattern"):
        assert core.get_parameter(f"{name}.weight").grad.any(), name


def test_of_both_domains_robots_are_held_out():
    data = StateData([episode(0), person(1)], [episode(2)])
    settings = StateTrainSettings(episodes=("takes",))
    assert configured(data, settings).domains == ("robot", "human")
    assert configured(StateData([person(1)], [person(2)]), settings).domains == ("robot",)
    with pytest.raises(InvalidInputError, match=r"tasks \['press'\] are held out and not trained"):
        configured(StateData([person(1)], [episode(2)]), settings)


@pytest.fixture
def stores(tmp_path):
    """Robots that stand a bottle, people that stack bowls."""
    for name, task, domain, seeds in (
        ("robot", "stand_bottle", "robot", range(4)),
        ("more", "stand_bottle", "robot", range(50, 52)),
        ("human", "stack_bowls", "human", range(3)),
    ):
        store, stage = EpisodeStore(tmp_path / name), Stage(task, domain, TwinSettings())
        for seed in seeds:
            taken = record(stage, seed, OPTIONS)
            # Actions of a person's take are the robot's once it was retargeted.
            about = taken.attributes.model_copy(update={"episode_id": f"{name}-{seed}"})
            write_episode(store, dataclasses.replace(taken, attributes=about))
    return tmp_path


def settings_of(stores, **changes):
    given = {
        "episodes": (str(stores / "robot"),),
        "human": (str(stores / "human"),),
        "heldout": str(stores / "more"),
        "image_px": PX,
    }
    return StateTrainSettings(**given | changes)


def ids(episodes):
    return [one.episode_id for one in episodes]


def test_subsets_of_both_domains_leave_what_is_held_out(stores):
    data = load_state_data(settings_of(stores, robot_episodes=3, human_episodes=2))
    assert ids(data.heldout) == ["more-50", "more-51"]
    assert [one.domain for one in data.training] == ["robot"] * 3 + ["human"] * 2
    more = load_state_data(settings_of(stores, human_episodes=3))
    assert set(ids(data.training)) < set(ids(more.training))
    none = load_state_data(settings_of(stores, human_episodes=0))
    assert {one.domain for one in none.training} == {"robot"}
    with pytest.raises(InvalidInputError, match="got 9 as the number of human"):
        load_state_data(settings_of(stores, human_episodes=9))
    # A store of both domains: people are neither trained on nor held out, unless from --human.
    with pytest.raises(NotFoundError, match="no robot episode"):
        load_state_data(settings_of(stores, episodes=(str(stores / "human"),)))
    with pytest.raises(InvalidInputError, match=r"stand_bottle/0.*trained on and held out"):
        load_state_data(settings_of(stores, heldout=str(stores / "robot")))


def test_people_of_held_out_scenes_are_left_out(stores):
    # The same seeds in both domains, of one task.
    stage = Stage("stand_bottle", "human", TwinSettings())
    store = EpisodeStore(stores / "same")
    for seed in range(4):
        write_episode(store, record(stage, seed, OPTIONS))
    given = {"human": (str(store.root),), "heldout": None, "heldout_share": 0.4}
    data = load_state_data(settings_of(stores, **given))
    held_out = {one.scene for one in data.heldout}
    assert held_out
    people = [one.scene for one in data.training if one.domain == "human"]
    assert set(people) == {f"stand_bottle/{seed}" for seed in range(4)} - held_out


def test_each_episode_counts_once(stores):
    for name in ("human", "more"):
        if name == "human":
            taken = record(Stage("stack_bowls", "human", TwinSettings()), 9, OPTIONS)
            about = taken.attributes.model_copy(update={"episode_id": "robot-1"})
            write_episode(EpisodeStore(stores / name), dataclasses.replace(taken, attributes=about))
    with pytest.raises(ConflictError, match=r"\['robot-1'\] are in two stores"):
        load_state_data(settings_of(stores))


def test_an_adaptation_can_be_repeated_by_its_command():
    given = {"episodes": ("new",), "init": Path("/models/both.safetensors")}
    settings = AdaptStateCommand(**given, seed=3)
    command = _command(settings)
    assert command.startswith("dextouch train adapt --episodes=new --init=both.safetensors")
    again = load_settings(AdaptStateCommand, command.split()[3:])
    given["init"] = Path("both.safetensors")
    assert again == AdaptStateCommand(**given, seed=3)


def test_known_tasks_keep_their_rows(base):
    own = base.checkpoint.metadata.dynamics
    wider = own.model_copy(update={"tasks": ("press", *own.tasks), "num_objects": (1, 1)})
    reader = base.reader(wider, 1, seed=0)
    known = base.checkpoint.dynamics.readers()[1]
    assert torch.equal(reader.task.weight[1], known.task.weight[0])
    assert not torch.equal(reader.task.weight[0], known.task.weight[0])


def test_a_share_that_is_held_out_by_hash_is_known(base):
    about = base.checkpoint.metadata
    seeds = {"training_seeds": {"stand_bottle": (0, 99)}, "heldout_share": 0.3}
    one = about.model_copy(update=seeds)
    unseen = [seed for seed in range(100) if not one.may_have_seen("stand_bottle", seed)]
    expected = [n for n in range(100) if scene_fraction(f"stand_bottle/{n}") < 0.3]
    assert unseen == expected
    assert 15 < len(unseen) < 45


def test_a_model_of_both_domains_is_trained_adapted_and_read(stores, tmp_path):
    small = {
        "num_members": 1,
        "width": 32,
        "jobs": 1,
        "reader": ReaderSettings(num_steps=2, batch=4, bfloat16=False),
        "core": CoreSettings(num_steps=2, batch=4),
        "drawing": {"max_steps": 1},
    }
    output = tmp_path / "both.safetensors"
    report = train_state(settings_of(stores, output=output, **small))
    assert (report.num_training_episodes, report.num_heldout_episodes) == (7, 2)
    about = read_state_checkpoint(output).metadata
    assert about.dynamics.domains == ("robot", "human")
    assert [(s.domain, s.heldout, s.tasks, s.window_share) for s in about.sets] == [
        ("human", False, {"stack_bowls": 3}, 0.5),
        ("robot", False, {"stand_bottle": 4}, 0.5),
        ("robot", True, {"stand_bottle": 2}, None),
    ]
    assert "--human=human --heldout=more" in about.command
    for tasks, new in ((("stand_bottle",), True), ((), True)):
        given = {"init": output, "new_tasks": new, "human": (), "tasks": tasks}
        with pytest.raises(InvalidInputError, match=r"trained on tasks \['stand_bottle'\]"):
            train_state(settings_of(stores, **given, **small))
    again = {"init": output, "human": (), "heldout": None, "heldout_share": 0.5}
    with pytest.raises(InvalidInputError, match=r"may have been trained on \d of the held-out"):
        train_state(settings_of(stores, **again, **small))
    people = {"init": output, "episodes": (str(stores / "human"),), "human": (), "heldout": None}
    with pytest.raises(InvalidInputError, match="there are no robots among the episodes"):
        train_state(settings_of(stores, **people, heldout_share=0.5, **small))
    again = tmp_path / "again.safetensors"
    changes = {"init": output, "output": again, "human": ()}
    train_state(settings_of(stores, **changes, **small, learn="success"))
    adapted = read_state_checkpoint(again).metadata
    assert adapted.dynamics.domains == ("robot", "human")
    # Of the tasks of the base, the robots have one.
    assert adapted.dynamics.tasks == ("stack_bowls", "stand_bottle")
    assert adapted.object_boxes_m == about.object_boxes_m
    for name in ("boxes_m", "movable"):
        old, new = (
            getattr(read_state_checkpoint(path).dynamics.core, name) for path in (output, again)
        )
        assert torch.equal(old, new), name
    inherited = [one for one in adapted.sets if one.checkpoint]
    assert len(inherited) == 3
    assert len({one.checkpoint for one in inherited}) == 1
    assert StateMetadata.model_validate_json(adapted.model_dump_json()) == adapted


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    one = untrained_state_checkpoint()
    path = tmp_path_factory.mktemp("base") / "base.safetensors"
    write_state_checkpoint(path, one.dynamics, one.renderer, one.metadata)
    return Base(path)


def test_a_core_that_learns_of_people_begins_as_it_was(base):
    own = base.checkpoint.metadata.dynamics
    both = own.model_copy(update={"domains": ("robot", "human")})
    config = base.configured(both, keeps_tasks=False)
    assert config.has_humans
    core = base.core(config, 1, seed=0, learns_all=True).eval()
    assert all(weight.requires_grad for weight in core.parameters())
    alone = base.core(own, 1, seed=0, learns_all=True).eval()
    begun = dataclasses.replace(
        start(1), task=torch.zeros(1, dtype=torch.int64), touch=torch.randn(1, 2, 96)
    )
    commands = random_commands(1, 3)

    def said(one, *human):
        return one(commands, begun, one.first_state(begun, commands[:1], *human), *human)[0]

    before = said(alone)
    for human in ((), (torch.ones(1),)):
        now = said(core, *human)
        for name in ("touch", "contact", "pattern", "success"):
            assert torch.allclose(getattr(now, name), getattr(before, name), atol=1e-6), name
    # Estimates of success are kept, and only with all of the model.
    fresh = base.core(config, 1, seed=0, learns_all=False)
    last = base.checkpoint.dynamics.core.success[-1].weight[1:2]
    assert torch.equal(core.success[-1].weight, last)
    assert not torch.equal(fresh.success[-1].weight, last)


@pytest.fixture
def loaded(monkeypatch):
    """Settings classes that commands load, without running them."""
    found = []

    def load(kind, arguments):
        found.append(kind)
        raise KeyboardInterrupt

    monkeypatch.setattr(command_line, "load_settings", load)

    def run(command, *arguments):
        with pytest.raises(KeyboardInterrupt):
            command(list(arguments))
        return found[-1]

    return run


def test_the_preset_names_the_form(loaded, monkeypatch, tmp_path):
    train = command_line.run_train
    assert loaded(train, "--episodes", "takes") is TrainStateCommand
    assert loaded(train, "--preset=state", "--width", "64") is TrainStateCommand
    assert loaded(train, "--episodes=takes", "--preset", "paper") is TrainCommand
    monkeypatch.setenv("DEXTOUCH_WORLD_MODEL_TRAIN_PRESET", "tiny")
    assert loaded(train, "--episodes", "takes") is TrainCommand
    assert loaded(train, "--preset", "state") is TrainStateCommand
    monkeypatch.delenv("DEXTOUCH_WORLD_MODEL_TRAIN_PRESET")
    with pytest.raises(UnknownNameError, match="paper-video-only, state, tiny"):
        train(["--preset", "foo"])
    path = tmp_path / "dextouch.toml"
    monkeypatch.setenv("DEXTOUCH_CONFIG", str(path))
    path.write_text("[world_model_train]\nseed = 3\n")
    with pytest.raises(InvalidInputError, match="no preset of it is named"):
        train(["--episodes", "takes"])
    path.write_text('[world_model_train]\nseed = 3\npreset = "tiny"\n')
    assert loaded(train, "--episodes", "takes") is TrainCommand


@pytest.mark.usefixtures("checkpoint")
def test_the_checkpoint_names_the_form_that_is_adapted(loaded, base, tmp_path, monkeypatch):
    adapt = command_line.run_adapt
    assert loaded(adapt, "--init", str(base._path)) is AdaptStateCommand
    assert loaded(adapt, "--help") is AdaptStateCommand
    paper = str(tmp_path / "untrained.safetensors")
    assert loaded(adapt, f"--init={paper}") is AdaptCommand
    monkeypatch.setenv("DEXTOUCH_WORLD_MODEL_ADAPT_INIT", paper)
    assert loaded(adapt, "--episodes", "new") is AdaptCommand
