"""Which episodes are fit to be learned from, and that their arrays are what was recorded."""

from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    data_hash,
    needs,
    select_episodes,
    split_of_scene,
)
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import Review
from services.twin.demonstrators import Motion
from services.twin.episodes import record
from services.twin.episodes import write_episode as write_truth
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions
from tests.unit.episode_store.episodes import write_episode, write_take

REJECTED = Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
HEAD = ("camera_head",)
LEAN = TakeOptions(images=HEAD, image_every=4, streams="training")
SHOWN = [*range(0, 77, 4), 78, 79, 80]


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def chosen(*stores, **wanted):
    return [reader.item_id for reader in select_episodes(stores, **wanted)]


def test_episodes_are_selected_by_what_they_are_in_the_order_of_their_ids(store):
    write_episode(store, "c", seed=3)
    write_episode(store, "b", domain="human", task="stir", seed=4)
    write_episode(store, "a", origin="recorded")
    write_episode(store, "dream", origin="imagined", task="stir", seed=3)
    assert chosen(store) == ["a", "b", "c"]
    assert chosen(store, origins=()) == ["a", "b", "c", "dream"]
    assert chosen(store, origins=("imagined",)) == ["dream"]
    assert chosen(store, domain="robot") == ["a", "c"]
    assert chosen(store, tasks=["stir"]) == ["b"]
    assert chosen(store, splits=[split_of_scene("stir", 4)], tasks=["stir"]) == ["b"]
    own = split_of_scene("stir", 4)
    others = sorted({"A", "B", "C"} - {own})
    with pytest.raises(NotFoundError, match=f"no human episode of stir .*1 of split {own}"):
        chosen(store, splits=others, tasks=["stir"], domain="human")
    with pytest.raises(NotFoundError, match="2 of task 'stand_bottle', 2 of task 'stir'"):
        chosen(store, tasks=["juggle"], domain=None, origins=())


LACKING = {
    "EVERY_PART": ({"absent": ("head",)}, "head camera .*track both hands"),
    "WHOLE": ({"recovered": True}, "cut short"),
    "OUTCOME": ({"success": None}, "1 of unknown outcome .*docs/dashboard.md"),
    "SUCCESS": ({"success": False}, "that failed"),
    "TOUCH": ({}, "without touch of both hands"),
    "OBJECTS": ({}, "without poses of their objects .*docs/objects.md"),
}


@pytest.mark.parametrize("name", LACKING)
def test_what_is_lacking_is_named_with_its_remedy(store, name):
    changes, message = LACKING[name]
    write_episode(store, "unfit", **changes)
    with pytest.raises(NotFoundError, match=message):
        chosen(store, needs=[getattr(needs, name)])
    assert chosen(store) == ["unfit"]


def test_images_are_needed_at_some_steps_or_all(make_episode, store):
    def shown_by(name, keep):
        made = make_episode(17)
        made.values["camera_head"] = made.values["camera_head"][keep]
        made.stamps_ns["camera_head"] = made.stamps_ns["camera_head"][keep]
        made.write(store, episode_id=name, seed=len(store.list()))

    # 33 images at 30 Hz: image 2n is that of step n.
    shown_by("all", slice(None, None, 2))
    shown_by("eighth", slice(None, None, 16))
    shown_by("late", slice(16, None, 2))
    write_blind(store)
    every = ["all", "blind", "eighth", "late"]
    assert chosen(store) == every
    for need, fit in (
        (needs.IMAGES, ["all", "eighth", "late"]),
        (needs.FIRST_IMAGE, ["all", "eighth"]),
        (needs.image_every(8), ["all", "eighth"]),
        (needs.image_every(4), ["all"]),
        (needs.EVERY_IMAGE, ["all"]),
        (needs.longer_than(9), ["all", "eighth", "late"]),
    ):
        assert chosen(store, needs=[need]) == fit
    with pytest.raises(NotFoundError, match=r"3 without an image of every 4th step .*--images 4"):
        chosen(store, needs=[needs.image_every(4), needs.longer_than(99)])


def write_blind(store):
    """Touch and actions, and a camera that never gave an image."""
    made = write_episode(store, "seeing")
    attributes = made.attributes.model_copy(update={"episode_id": "blind", "streams": ()})
    with store.writer(attributes=attributes) as writer:
        for stream in made.streams.values():
            writer.add_stream(stream)
            if stream.kind != "image":
                data = made.read(stream.name)
                writer.append(stream.name, values=data.values, t_ref_ns=data.t_ref_ns)
    store.delete("seeing", for_good=True)


def test_what_a_learner_does_without_is_logged_and_what_it_does_not_want_is_not(store, capsys):
    for name, changes in {"fit": {}, "failed": {"success": False}, "a": {"success": None}}.items():
        write_episode(store, name, **changes)
    assert chosen(store, needs=[needs.OUTCOME, needs.SUCCESS]) == ["fit"]
    logged = capsys.readouterr().out
    assert "of unknown outcome" in logged
    assert "that failed" not in logged


def test_rejected_episodes_and_what_was_imagined_from_them_are_left_out(store, tmp_path):
    imagined = EpisodeStore(tmp_path / "imagined")
    for name in ("good", "bad"):
        write_episode(store, name)
        lineage = [{"kind": "episode", "id": name}]
        write_episode(imagined, f"dream-{name}", origin="imagined", lineage=lineage)
    store.set_review("bad", REJECTED)
    assert chosen(store) == ["good"]
    assert chosen(store, imagined, origins=()) == ["good", "dream-good"]
    # Alone, the other store does not say what was rejected.
    assert chosen(imagined, origins=()) == ["dream-bad", "dream-good"]
    store.set_review("good", REJECTED)
    with pytest.raises(NotFoundError, match="2 rejected in review"):
        chosen(store)


def test_no_episode_counts_twice(store, tmp_path):
    write_episode(store, "one")
    more = EpisodeStore(tmp_path / "more")
    write_episode(more, "two")
    assert chosen(more, store) == ["two", "one"]
    with pytest.raises(ConflictError, match="'one': in two stores"):
        chosen(store, EpisodeStore(store.root))
    with pytest.raises(NotFoundError, match=r"store 2 of 2, .*typo, has none"):
        chosen(store, EpisodeStore(tmp_path / "typo"))


def test_a_recording_counts_once(store):
    write_take(store, "take")
    again = store.open("take-aligned").attributes
    assert again.origin == "recorded"
    lineage = [entry.model_dump() for entry in again.lineage]
    write_episode(store, "take-measured", origin="recorded", lineage=lineage)
    with pytest.raises(ConflictError, match=r"'take-aligned' and 'take-measured': are of one rec"):
        chosen(store)


def test_episodes_of_two_rates_do_not_go_together(store):
    write_episode(store, "a")
    write_episode(store, "b", model_rate_hz=30.0)
    with pytest.raises(ConflictError, match="'a' and 'b': have model rates of 15 and 30 Hz"):
        chosen(store)


def test_the_hash_of_a_set_is_of_contents_and_options_in_any_order():
    # printf 'a\nb' | sha256sum
    plain = "7e18f737311b2dc3b2f269dd78396b0351f14fb66efa879f768cb23181883c78"
    assert data_hash(["b", "a"]) == data_hash(["a", "b"], image_px=None) == plain
    # printf 'a\nb\nancestor=c\nimage_px=32' | sha256sum
    assert data_hash(["a", "b"], image_px=32, ancestor="c") == (
        "034897c53e5da341a3dd89dd598abeae422423ffac903bd41000c294391d7d6c"
    )


def test_the_hash_knows_the_outcome_and_the_arrays(store):
    contents = [
        write_episode(store, name, **changes).content_sha256
        for name, changes in {
            "a": {}, "b": {"success": False}, "c": {"event_times_s": {"up": 1.0}}
        }.items()
    ]  # fmt: skip
    assert len({data_hash([one]) for one in contents}) == 3


@pytest.fixture(scope="module")
def truths():
    bottle = Stage("stand_bottle", "robot", TwinSettings())
    bowls = Stage("stack_bowls", "human", TwinSettings())
    return {
        "script": record(bottle, 3, replace(LEAN, noise_m=0.005)),
        "push": record(bottle, 4, replace(LEAN, motion=Motion("push", 0))),
        "human": record(bowls, 3, LEAN),
        "whole": record(bottle, 5, TakeOptions(images=HEAD, miss=True)),
    }


@pytest.fixture(scope="module")
def readers(truths, tmp_path_factory):
    store = EpisodeStore(tmp_path_factory.mktemp("twin"))
    for truth in truths.values():
        write_truth(store, truth)
    return {name: store.open(truth.attributes.episode_id) for name, truth in truths.items()}


@pytest.mark.long
@pytest.mark.parametrize("name", ["script", "push", "human"])
def test_arrays_are_what_the_twin_recorded(truths, readers, name):
    truth, grid = truths[name].streams, EpisodeGrid(readers[name])
    is_robot = name != "human"
    sent = truth["action_commanded" if is_robot else "action"].values
    assert grid.action_kind == ("commanded" if is_robot else "measured")
    np.testing.assert_allclose(grid.sent, sent, atol=1e-9)
    np.testing.assert_allclose(grid.measured, truth["action"].values, atol=1e-9)
    poses = truth["object_poses"].values
    np.testing.assert_array_equal(grid.objects.poses, poses.astype(np.float32))
    assert grid.image_steps.tolist() == SHOWN
    np.testing.assert_array_equal(grid.images(SHOWN), truth["camera_head"].values)
    # Four samples of 60 Hz a step; those of step 1 are samples 1 … 4.
    tactile_kpa, valid = grid.touch()
    assert valid.all()
    for index, side in enumerate(("left", "right")):
        means = truth[f"tactile_{side}"].values[1:].reshape(80, 4, 320).mean(axis=1)
        np.testing.assert_allclose(tactile_kpa[1:, index], means, rtol=1e-6)
    facts = truths[name].attributes
    assert (grid.task, grid.success) == (facts.task, facts.success)
    assert grid.scene == f"{facts.task}/{facts.seed}"
    np.testing.assert_array_equal(grid.boxes_m, np.array(facts.object_boxes_m))


@pytest.mark.long
def test_streams_at_their_own_rates_are_brought_to_the_grid(truths, readers):
    truth, grid = truths["whole"].streams, EpisodeGrid(readers["whole"])
    # 30 Hz images: every second one. 100 Hz poses: every 20th is on every third step.
    np.testing.assert_array_equal(grid.images(range(81)), truth["camera_head"].values[::2])
    poses = truth["object_poses"].values
    np.testing.assert_allclose(grid.objects.poses[:80:3], poses[:534:20], atol=1e-6)
    # Step 1 is at 66.67 ms, two thirds of the way from sample 6 to sample 7.
    between = poses[6, :, :3] / 3 + poses[7, :, :3] * 2 / 3
    np.testing.assert_allclose(grid.objects.poses[1, :, :3], between, atol=1e-6)


def test_an_image_of_another_step_is_none_of_its_own(truths, readers):
    grid, images = EpisodeGrid(readers["script"]), truths["script"].streams["camera_head"].values
    np.testing.assert_array_equal(grid.own_images([78, 79, 80]), images[-3:])
    assert grid.own_images([4, 5]) is None
    # The nearest one is that of step 4.
    np.testing.assert_array_equal(grid.images([5]), images[1:2])


def test_only_images_that_are_asked_for_are_decoded(readers, monkeypatch):
    grid, decoded = EpisodeGrid(readers["whole"]), []
    images_at = type(readers["whole"]).images_at

    def noted(reader, name, indices, **options):
        decoded.extend((name, int(index)) for index in indices)
        return images_at(reader, name, indices, **options)

    monkeypatch.setattr("dextouch.episodes.EpisodeReader.images_at", noted)
    grid.touch()
    assert len(grid.image_steps) == len(grid.measured) == 81
    assert decoded == []
    grid.images([3, 5])
    assert decoded == [("camera_head", 6), ("camera_head", 10)]


def test_images_and_their_camera_are_scaled_together(readers):
    reader = readers["script"]
    small, whole = EpisodeGrid(reader, 32), EpisodeGrid(reader, 99)
    assert small.images([0]).shape == (1, 32, 32, 3)
    assert (small.image_size_px, whole.image_size_px) == ((32, 32), (64, 64))
    np.testing.assert_allclose(small.K_head[:2], whole.K_head[:2] / 2)
    means = whole.images([0])[0].reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(small.images([0])[0] - means).max() <= 0.5


def test_images_of_a_lens_are_read_without_its_distortion(truths, store):
    """The twin's pinhole images, as a lens would have taken them, come back as they were."""
    truth = truths["script"]
    stream, K = truth.streams["camera_head"], truth.attributes.K_head_matrix()
    height, width = stream.values.shape[1:3]
    lens = np.array([-0.6, 0.2, 0.001, -0.001, 0.0])
    # Smooth, so that interpolating them twice costs less than the distortion.
    pinhole = np.stack([cv2.GaussianBlur(one, (0, 0), 2.0) for one in stream.values])
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    seen = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    flat = cv2.undistortPoints(seen[:, None], K, lens, P=K).reshape(height, width, 2) - 0.5
    taken = np.stack(
        [
            cv2.remap(
                one, *np.moveaxis(flat.astype(np.float32), -1, 0), cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for one in pinhole
        ]
    )  # fmt: skip
    calibration = truth.attributes.calibration | {"distortion_head": (tuple(lens.tolist()),)}
    recorded = replace(
        truth,
        attributes=truth.attributes.model_copy(update={"calibration": calibration}),
        streams=truth.streams | {"camera_head": replace(stream, values=taken)},
    )
    write_truth(store, recorded)
    grid = EpisodeGrid(store.open(truth.attributes.episode_id))
    steps = [0, 40]
    inside = np.s_[:, 6:-6, 6:-6]
    truly = pinhole[[0, 10]][inside].astype(float)
    error = np.abs(grid.images(steps)[inside] - truly).mean()
    assert error < 0.4 * np.abs(taken[[0, 10]][inside] - truly).mean()
    np.testing.assert_allclose(grid.K_head, K)


def test_the_first_observation_is_that_of_its_step(truths, readers):
    first = EpisodeGrid(readers["script"]).observation(8)
    truth = truths["script"].streams
    np.testing.assert_array_equal(first.images["camera_head"][0], truth["camera_head"].values[2])
    means = truth["tactile_right"].values[29:33].mean(axis=0)
    np.testing.assert_allclose(first.tactile_kpa[0, 1], means, rtol=1e-6)
    assert (first.first_step, len(first), first.reached_is_measured) == (0, 1, True)
    # Actions are relative to the poses of that step.
    np.testing.assert_allclose(first.action_reached[0, :3], 0.0, atol=1e-12)


def test_an_unknown_outcome_is_no_failure(store):
    write_episode(store, "unknown", success=None)
    with pytest.raises(InvalidInputError, match="'unknown': is of unknown outcome"):
        assert EpisodeGrid(store.open("unknown")).success
