"""Training with clicks and touch: the twin's takes as a lab has them, without objects' poses."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.geometry import invert, transform_from_pose
from dextouch.schemas import EpisodeClicks, LineageEntry, ObjectClicks
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from services.world_model.checkpoints import (
    StateBounds,
    read_state_checkpoint,
    write_state_checkpoint,
)
from services.world_model.dynamics.features import TouchCodec
from services.world_model.settings import CoreSettings, ReaderSettings, StateTrainSettings
from services.world_model.training import state_data, state_trainer
from services.world_model.training.member_training import (
    CoreData,
    _read_start,
    read_step,
    start_steps,
    train_reader,
)
from services.world_model.training.scene_table import SceneTable, scene_table
from services.world_model.training.state_data import (
    StateData,
    check_drawable,
    check_new,
    configured,
    drawn_episodes,
    has_poses,
    labelled_episodes,
    load_scene_episodes,
    load_state_data,
)
from services.world_model.training.state_trainer import train_state
from services.world_model.training.transfer import Base
from tests.contracts.test_world import untrained_state_checkpoint
from tests.unit.world_model.test_state_training import (  # noqa: F401 (fixture)
    PX,
    config,
    episode,
    touch_latents,
)
from tests.unit.world_model.toy_grid import changed

pytestmark = pytest.mark.long

OPTIONS = TakeOptions(images=("camera_head",), image_every=4, streams="training")
NUM_TAKES = 6


@pytest.fixture(scope="module")
def truths():
    stage = Stage("stand_bottle", "robot", TwinSettings())
    return [record(stage, seed, OPTIONS) for seed in range(NUM_TAKES)]


def name_of(number):
    return f"take-{number}"


def as_a_lab_has_it(truth, number, **changes):
    """A take without anything that only a simulation knows."""
    hidden = {"object_names": (), "object_boxes_m": (), "seed": None, "event_times_s": {}}
    about = {"episode_id": name_of(number), "origin": "recorded", **hidden} | changes
    streams = {name: one for name, one in truth.streams.items() if name != "object_poses"}
    return dataclasses.replace(
        truth, attributes=truth.attributes.model_copy(update=about), streams=streams
    )


@pytest.fixture
def store(truths, tmp_path):
    store = EpisodeStore(tmp_path / "takes")
    for number, truth in enumerate(truths):
        write_episode(store, as_a_lab_has_it(truth, number))
    return store


def true_pose(truth):
    return truth.streams["object_poses"].values[0, 0]


def clicks_on(truth):
    """Where OpenCV's camera shows the middle of the lying bottle's top, and its head."""
    about = truth.attributes
    T = transform_from_pose(true_pose(truth))
    box_m = np.array(about.object_boxes_m[0])
    middle = T[:3, :3] @ box_m[:3] + T[:3, 3] + [0, 0, box_m[3]]
    points = np.stack([middle, middle + 0.1 * T[:3, 2]])
    T_camera = invert(about.anchor.to_poses().T_world_camera_head)
    seen = points @ T_camera[:3, :3].T + T_camera[:3, 3]
    pixels, _ = cv2.projectPoints(
        seen, np.zeros(3), np.zeros(3), about.K_head_matrix(), np.zeros(5)
    )
    point_px, heading_px = pixels.reshape(2, 2).tolist()
    clicked = {"bottle": {"point_px": point_px, "heading_px": heading_px}}
    return EpisodeClicks.model_validate({"objects": clicked})


def clicks_file(truths, numbers):
    box_m = truths[0].attributes.object_boxes_m[0]
    bottle = {"name": "bottle", "box_m": box_m, "click": {"up": "x", "heading": "z"}}
    return ObjectClicks.model_validate(
        {
            "tasks": {"stand_bottle": [bottle]},
            "episodes": {name_of(n): clicks_on(truths[n]) for n in numbers},
        }
    )


def test_clicks_are_poses_of_the_first_step_alone(store, truths):
    store.set_clicks(name_of(1), clicks_on(truths[1]))
    loaded = load_scene_episodes(str(store.root), clicks=clicks_file(truths, [0]))
    assert [one.objects.sources for one in loaded] == [("clicks",)] * 2 + [("none",)] * 4
    for number, one in enumerate(loaded):
        assert one.object_names == ("bottle",)
        np.testing.assert_array_equal(one.boxes_m, truths[0].attributes.object_boxes_m)
        assert one.objects.known[0, 0] == (number < 2)
        assert not one.objects.known[1:].any()
    for truth, one in zip(truths[:2], loaded[:2], strict=True):
        np.testing.assert_allclose(one.objects.poses[0, 0, :3], true_pose(truth)[:3], atol=5e-4)
        turn = transform_from_pose(one.objects.poses[0, 0]) @ invert(
            transform_from_pose(true_pose(truth))
        )
        np.testing.assert_allclose(turn[:3, :3], np.eye(3), atol=5e-3)
    # 3 px of 64 are some 3 cm at 0.75 m, and more along the view.
    assert 0.02 < loaded[0].objects.sd_m[0] < 0.06
    assert loaded[0].objects.is_measured


def test_streams_count_more_than_clicks(truths, tmp_path):
    store = EpisodeStore(tmp_path)
    write_episode(store, truths[0])
    name = truths[0].attributes.episode_id
    given = clicks_file(truths, []).model_copy(update={"episodes": {name: clicks_on(truths[1])}})
    (one,) = load_scene_episodes(str(store.root), clicks=given)
    assert one.objects.sources == ("twin",)
    assert one.objects.known.all()
    assert one.objects.sd_m.tolist() == [0.0]
    np.testing.assert_array_equal(one.objects.poses[0, 0], true_pose(truths[0]).astype(np.float32))


def test_takes_without_poses_need_others_with_poses(store, truths):
    for given in (None, clicks_file(truths, [])):
        with pytest.raises(NotFoundError, match="only 6 without poses of their objects"):
            load_scene_episodes(str(store.root), clicks=given)
    # Others may be in another store.
    more = EpisodeStore(store.root / "more")
    write_episode(more, as_a_lab_has_it(truths[0], 9))
    of_other = {"episodes": {name_of(9): clicks_on(truths[0])}}
    given = clicks_file(truths, []).model_copy(update=of_other)
    loaded = load_scene_episodes(str(store.root), str(more.root), clicks=given)
    assert len(loaded) == 7


def test_clicks_on_unknown_takes_are_refused(store, truths, tmp_path):
    given = clicks_file(truths, [0])
    given = given.model_copy(update={"episodes": {"gone": clicks_on(truths[0])}})
    path = tmp_path / "clicks.json"
    path.write_text(given.model_dump_json())
    with pytest.raises(NotFoundError, match="'gone'"):
        load_state_data(StateTrainSettings(episodes=(str(store.root),), clicks=path, image_px=PX))


def test_unfinished_clicks_of_a_file_are_refused_and_those_of_the_page_wait(store, truths):
    whole = clicks_on(truths[1]).objects["bottle"]
    half = EpisodeClicks(objects={"bottle": whole.model_copy(update={"heading_px": None})})
    store.set_clicks(name_of(1), half)
    loaded = load_scene_episodes(str(store.root), clicks=clicks_file(truths, [0]))
    assert [has_poses(one) for one in loaded] == [True] + [False] * 5
    given = clicks_file(truths, [0])
    given = given.model_copy(update={"episodes": {name_of(1): half}})
    with pytest.raises(InvalidInputError, match="has no heading_px"):
        load_scene_episodes(str(store.root), clicks=given)


def test_of_two_alignments_of_a_take_that_with_poses_is_taken(store, truths):
    source = (LineageEntry(kind="recording", id="rec", sha256="a" * 64),)
    for name in (7, 8):
        write_episode(store, as_a_lab_has_it(truths[0], name, lineage=source))
    given = clicks_file(truths, [0])
    with pytest.raises(ConflictError, match="are of one recording"):
        load_scene_episodes(str(store.root), clicks=given)
    given = given.model_copy(update={"episodes": {name_of(8): clicks_on(truths[0])}})
    loaded = load_scene_episodes(str(store.root), clicks=given)
    assert [one.episode_id for one in loaded] == [*map(name_of, range(6)), name_of(8)]


def clicked(seed, **changes):
    """A toy episode whose block is known at its first step alone, with an error of 8 mm."""
    one = episode(seed)
    known = np.zeros_like(one.objects.known)
    known[0] = True
    track = {"known": known, "sources": ("clicks",), "sd_m": np.float32([0.008])}
    return changed(one, **track | changes)


def unposed(seed):
    one = episode(seed)
    away = np.full_like(one.objects.poses, 0.3)
    return changed(one, known=np.zeros_like(one.objects.known), poses=away, sources=("none",))


def test_readers_are_trained_on_what_is_known(config, monkeypatch):  # noqa: F811
    late = episode(10)
    known = late.objects.known.copy()
    known[:5] = False
    late = changed(late, known=known)
    takes = [clicked(0), *(unposed(seed) for seed in range(1, 9)), episode(9), late]
    table = scene_table(takes, config, labelled=[has_poses(one) for one in takes])
    seen = []
    first_steps = SceneTable.first_steps

    def spied(self, rows, steps):
        seen.append((rows.clone(), steps.clone()))
        return first_steps(self, rows, steps)

    monkeypatch.setattr(SceneTable, "first_steps", spied)
    train_reader(table, config, ReaderSettings(num_steps=8, batch=16, bfloat16=False), seed=0)
    rows, steps = (torch.cat(parts) for parts in zip(*seen, strict=True))
    assert set(rows.tolist()) == {0, 9, 10}
    assert set(steps[rows == 0].tolist()) == {0}
    assert set(steps[rows == 9].tolist()) == {0, 4, 8, 12, 16}
    assert set(steps[rows == 10].tolist()) == {8, 12, 16}


def test_cores_start_from_clicks_and_know_their_error(config):  # noqa: F811
    takes = [clicked(0), unposed(1)]
    table = scene_table(takes, config, labelled=[True, False])
    torch.manual_seed(0)
    reader = train_reader(
        table, config, ReaderSettings(num_steps=1, batch=2, bfloat16=False), seed=0
    )
    readings = {step: read_step(reader, table, step) for step in start_steps(table)}
    data = CoreData(table, touch_latents(TouchCodec(8), table), readings)
    rows = torch.tensor([0, 1])
    settings = CoreSettings(pose_noise_m=0.006)
    start = _read_start(data, rows, 0, settings, torch.Generator().manual_seed(0))
    assert 0.008 <= float(start.sd_m[0, 0]) <= 0.01
    assert (start.objects.position_m[0, 0] - table.objects.position_m[0, 0, 0]).norm() < 0.05
    torch.testing.assert_close(start.objects.position_m[1], readings[0].objects.position_m[1])
    later = _read_start(data, rows, 8, settings, torch.Generator().manual_seed(0))
    torch.testing.assert_close(later.objects.position_m, readings[8].objects.position_m)


def test_touch_gives_poses_of_takes_that_succeeded(store, truths):
    box_m = truths[0].attributes.object_boxes_m[0]
    touch = {"hand": "right", "closing_deg": -150.0}
    bottle = {
        "name": "bottle",
        "box_m": box_m,
        "click": {"up": "x", "heading": "z"},
        "touch": touch,
    }
    given = ObjectClicks.model_validate({"tasks": {"stand_bottle": [bottle]}})
    given = given.model_copy(update={"episodes": {name_of(0): clicks_on(truths[0])}})
    loaded = load_scene_episodes(str(store.root), clicks=given)
    succeeded = [truth.attributes.success for truth in truths]
    assert sum(succeeded) >= 3
    for number, (one, truth) in enumerate(zip(loaded, truths, strict=True)):
        source = "touch" if succeeded[number] else "clicks" if number == 0 else "none"
        assert one.objects.sources == (source,)
        if source == "touch":
            assert one.objects.known.all()
            off_m = one.objects.poses[0, 0, :3] - true_pose(truth)[:3]
            # Where it was clicked, too, it moves from there.
            assert np.linalg.norm(off_m) < (0.001 if number == 0 else 0.02)
            assert one.content_sha256 != one.reader.content_sha256
    check_drawable(loaded)


def test_clicks_correct_what_a_grip_is_stated_to_be(store, truths, tmp_path, monkeypatch):
    monkeypatch.setattr(state_data, "_LEAST_GRIPS", 2)
    succeeded = [n for n, truth in enumerate(truths) if truth.attributes.success]
    clicked, others = succeeded[:2], succeeded[2:]
    assert others
    given = json.loads(clicks_file(truths, clicked).model_dump_json())
    # Held 4 cm from the middle of the bottle, and 30° from its axis, as it never is.
    touch = {"hand": "right", "closing_deg": -120.0, "point_m": [0.0, 0.0, 0.05]}
    given["tasks"]["stand_bottle"][0]["touch"] = touch
    path = tmp_path / "clicks.json"
    path.write_text(json.dumps(given))
    data = load_state_data(
        StateTrainSettings(episodes=(str(store.root),), clicks=path, image_px=PX, heldout_share=0.3)
    )
    by_name = {one.episode_id: one for one in data.episodes}
    for number in others:
        one, true = by_name[name_of(number)], transform_from_pose(true_pose(truths[number]))
        assert one.objects.sources == ("touch",)
        found = transform_from_pose(one.objects.poses[0, 0].astype(float))
        assert np.linalg.norm(found[:2, 3] - true[:2, 3]) < 0.015
        turned_rad = np.arccos(np.clip(found[:3, 2] @ true[:3, 2], -1, 1))
        assert np.rad2deg(turned_rad) < 6.0
    for number in clicked:
        poses = by_name[name_of(number)].objects.poses[0, 0]
        np.testing.assert_allclose(poses[:3], true_pose(truths[number])[:3], atol=1e-3)


def test_clicks_on_absent_objects_correct_no_grip(store, truths, tmp_path, monkeypatch):
    monkeypatch.setattr(state_data, "_LEAST_GRIPS", 2)
    succeeded = [n for n, truth in enumerate(truths) if truth.attributes.success]
    given = json.loads(clicks_file(truths, []).model_dump_json())
    given["tasks"]["stand_bottle"][0]["touch"] = {"hand": "right", "closing_deg": -150.0}
    given["episodes"] = {
        name_of(n): {"objects": {"bottle": {"state": "absent"}}} for n in succeeded[:2]
    }
    loaded = load_scene_episodes(str(store.root), clicks=ObjectClicks.model_validate(given))
    before = [one.objects.poses.copy() for one in loaded]
    state_data._correct_grips(loaded)
    for one, poses in zip(loaded, before, strict=True):
        np.testing.assert_array_equal(one.objects.poses, poses)


def test_cores_start_from_readings_where_touch_gives_poses(config):  # noqa: F811
    """Touch gives those of takes that succeeded: any other start would tell the outcome."""
    takes = [changed(episode(0), sources=("touch",)), clicked(1), unposed(2)]
    table = scene_table(takes, config, labelled=[has_poses(one) for one in takes])
    assert table.touched.all()
    torch.manual_seed(0)
    reader = train_reader(
        table, config, ReaderSettings(num_steps=1, batch=2, bfloat16=False), seed=0
    )
    readings = {step: read_step(reader, table, step) for step in start_steps(table)}
    data = CoreData(table, touch_latents(TouchCodec(8), table), readings)
    for step in (0, 8):
        start = _read_start(
            data, torch.arange(3), step, CoreSettings(), torch.Generator().manual_seed(0)
        )
        torch.testing.assert_close(start.objects.position_m, readings[step].objects.position_m)


def test_what_is_known_at_single_steps_counts_as_moving(config):  # noqa: F811
    assert scene_table([clicked(0), unposed(1)], config).movable().tolist() == [[1.0, 0.0, 0.0]]
    fixed = changed(clicked(0), known=np.ones_like(clicked(0).objects.known))
    assert scene_table([fixed, clicked(1)], config).movable().tolist() == [[0.0, 0.0, 0.0]]


def test_takes_without_poses_are_notlabelled_episodes():
    settings = StateTrainSettings(episodes=("takes",))
    assert labelled_episodes([clicked(0), unposed(1)], settings) == [True, False]
    with pytest.raises(InvalidInputError, match="no scene with known objects of press"):
        labelled_episodes([unposed(1)], settings)


def test_renderers_see_robots_with_poses_though_those_of_a_task_have_none():
    people = [changed(clicked(n), domain="human") for n in range(2)]
    other = changed(episode(7), task="lift")
    data = StateData([*people, unposed(3), other], [episode(8)])
    assert drawn_episodes(data, StateTrainSettings(episodes=("takes",))) == [other]


def test_objects_of_unknown_size_are_refused():
    boxless = [changed(episode(seed), boxes_m=np.zeros((0, 6))) for seed in range(2)]
    data = StateData(boxless[:1], boxless[1:])
    with pytest.raises(InvalidInputError, match=r"sizes of the objects of tasks \['press'\]"):
        configured(data, StateTrainSettings(episodes=("takes",)))


def test_a_model_has_the_rate_of_its_episodes(tmp_path):
    fast = [changed(episode(seed), model_rate_hz=30.0) for seed in range(2)]
    data = StateData(fast[:1], fast[1:])
    settings = StateTrainSettings(episodes=("takes",), num_members=1)
    work = state_trainer._Work(
        settings, configured(data, settings), tmp_path, "", reads_starts=False
    )
    about = state_trainer._metadata(work, data, StateBounds(), {}, command="", cpu_s=0.0)
    assert about.model_rate_hz == 30.0
    base, path = untrained_state_checkpoint(), tmp_path / "base.safetensors"
    write_state_checkpoint(path, base.dynamics, base.renderer, base.metadata)
    with pytest.raises(InvalidInputError, match="steps at 15 Hz, the episodes at 30 Hz"):
        check_new(data, settings, Base(path))


def test_held_out_takes_below_a_chunk_are_refused_before_training(monkeypatch, tmp_path):
    data = StateData([episode(0), episode(1)], [episode(2, 13)])
    monkeypatch.setattr(state_data, "load_state_data", lambda _: data)
    monkeypatch.setattr(state_trainer, "_train_parts", lambda _: pytest.fail("trained"))
    settings = StateTrainSettings(episodes=("takes",), output=tmp_path / "model.safetensors")
    with pytest.raises(InvalidInputError, match="longest held-out episode has 13 steps"):
        train_state(settings)


def test_clicks_alone_need_a_base():
    check_drawable([clicked(0), episode(1)])
    with pytest.raises(InvalidInputError, match="add --init"):
        check_drawable([clicked(0), unposed(1)])


def test_other_clicks_are_other_data(store, truths):
    def digests(given):
        return [one.content_sha256 for one in load_scene_episodes(str(store.root), clicks=given)]

    given = clicks_file(truths, [0])
    x_px, y_px = clicks_on(truths[0]).objects["bottle"].point_px
    beside = (
        clicks_on(truths[0]).objects["bottle"].model_copy(update={"point_px": (x_px + 1.0, y_px)})
    )
    other = {"episodes": {name_of(0): EpisodeClicks(objects={"bottle": beside})}}
    ours, theirs = digests(given), digests(given.model_copy(update=other))
    assert ours == digests(given)
    assert ours[0] != theirs[0]
    assert ours[1:] == theirs[1:]


def test_poses_of_the_twin_are_part_of_the_content(truths, tmp_path):
    store = EpisodeStore(tmp_path)
    write_episode(store, truths[0])
    (one,) = load_scene_episodes(str(store.root))
    assert one.content_sha256 == one.reader.content_sha256


@pytest.mark.slow
def test_a_lab_trains_with_a_base_and_clicks(store, truths, tmp_path):
    base = untrained_state_checkpoint()
    place = tmp_path / "base.safetensors"
    write_state_checkpoint(place, base.dynamics, base.renderer, base.metadata)
    path = tmp_path / "clicks.json"
    path.write_text(clicks_file(truths, [0, 1, 2, 3]).model_dump_json())
    settings = StateTrainSettings(
        episodes=(str(store.root),),
        clicks=path,
        init=place,
        learn="readers",
        output=tmp_path / "lab.safetensors",
        image_px=PX,
        heldout_share=0.3,
        jobs=1,
        reader=ReaderSettings(num_steps=4, batch=4, bfloat16=False),
        core=CoreSettings(num_steps=3, batch=4),
    )
    report = train_state(settings)
    about = read_state_checkpoint(settings.output).metadata
    assert about.dynamics.tasks == ("stand_bottle",)
    assert set(about.object_sources) == {"clicks", "none"}
    assert sum(about.object_sources.values()) == report.num_training_episodes
    assert "--clicks=clicks.json" in about.command
    assert report.num_training_episodes + report.num_heldout_episodes == NUM_TAKES
    assert json.loads(about.model_dump_json())["object_sources"] == about.object_sources
