"""Edited items against the arrays that their sources were written from."""

import shlex
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeStore,
    interpolated_spans,
    is_rejected,
    maintenance,
)
from dextouch.episodes.editing import (
    EditOptions,
    relabel_item,
    steps_between,
    trim_episode,
    trim_recording,
)
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import EpisodeClicks, ItemNotes, Review, TimedNote
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take
from tests.unit.episodes.conftest import chosen, episode_of

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
KEPT = EditOptions(keep=True)
REJECTED = Review(verdict="rejected", reviewed_at=NOON)
NUM_STEPS = 60
# Of the camera's images nothing may be lost, of touch and poses nothing but the mean at the cut.
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
SETTINGS = settings(max_examples=12, deadline=None)


@pytest.fixture(scope="module", params=["rgb8", "jpeg", "h264"])
def long_take(request, tmp_path_factory):
    """An episode of 4 s with stamps that lie off the grid, as those of real devices do."""
    store = EpisodeStore(tmp_path_factory.mktemp("store") / "store")
    made = episode_of(NUM_STEPS, camera_unit=request.param)
    for number, name in enumerate(made.stamps_ns):
        if not name.startswith("action"):
            made.stamps_ns[name] = made.stamps_ns[name] + 1_700_000 * number
    made.write(store, event_times_s={"grasp": 1.0, "stand": 3.0})
    return LongTake(store, made)


class LongTake:
    """A store and what is in it, of which failures print nothing."""

    def __init__(self, store, made):
        self.both = store, made


def spans():
    steps = st.integers(0, NUM_STEPS)
    return st.tuples(steps, steps).map(sorted).filter(lambda span: span[1] - span[0] > 1).map(tuple)


def check_window(ours, theirs, first, num_steps, zero_ns):
    got = ours.window(0, num_steps, cameras=CAMERAS, action_kind="commanded")
    want = theirs.window(first, num_steps, cameras=CAMERAS, action_kind="commanded")
    np.testing.assert_array_equal(got.t_ref_ns, want.t_ref_ns - zero_ns)
    for name in CAMERAS:
        np.testing.assert_array_equal(got.images[name], want.images[name])
        np.testing.assert_array_equal(got.image_dt_ns[name], want.image_dt_ns[name])
    # The first step of an episode has one sample of touch, not the mean of a step.
    np.testing.assert_array_equal(got.tactile_kpa[1:], want.tactile_kpa[1:])
    np.testing.assert_array_equal(got.tactile_valid, want.tactile_valid)
    np.testing.assert_allclose(got.actions, want.actions, atol=1e-12)
    for mine, other in zip(got.anchor.as_tuple(), want.anchor.as_tuple(), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-12)


@given(span=spans(), exact=st.booleans())
@SETTINGS
def test_windows_of_a_trim_are_slices_of_the_source(long_take, span, exact):
    store, made = long_take.both
    is_lossy = exact and made.descriptors[3].unit == "h264"
    first, stop = span
    outcome = "failure" if stop < NUM_STEPS else None
    result = trim_episode(
        store, made.attributes.episode_id, span, outcome=outcome, exact=exact, options=KEPT
    )
    ours, theirs = store.open(result.id), store.open(made.attributes.episode_id)
    grid_ns = made.stamps_ns["action"]
    zero_ns = int(grid_ns[first])
    ours.verify()
    assert ours.num_steps == stop - first
    if not is_lossy:
        check_window(ours, theirs, first, stop - first, zero_ns)
    # Every stream at its own rate, against what was written.
    for name in made.stamps_ns:
        if name.startswith("action"):
            continue
        stamps_ns = made.stamps_ns[name]
        inside = (stamps_ns >= grid_ns[first]) & (stamps_ns <= grid_ns[stop - 1])
        data = ours.read(name, 0, int(grid_ns[stop - 1]) - zero_ns + 1)
        np.testing.assert_array_equal(data.t_ref_ns, stamps_ns[inside] - zero_ns)
        if name not in CAMERAS or made.descriptors[3].unit == "rgb8":
            np.testing.assert_array_equal(data.values, made.values[name][inside])
        elif is_lossy:
            assert np.abs(data.values.astype(int) - made.values[name][inside]).mean() < 12
        num_beside = ours.num_samples(name) - int(inside.sum())
        most = 2 if exact or made.descriptors[3].unit != "h264" else 9
        assert first == 0 or stop == NUM_STEPS or num_beside <= most
    about = ours.attributes
    assert about.success is (outcome is None)
    events = {"grasp": 1.0, "stand": 3.0}
    left = {
        name: at_s - first / 15
        for name, at_s in events.items()
        if first / 15 <= at_s + 1e-6 and at_s <= (stop - 1) / 15 + 1e-6
    }
    assert about.event_times_s == pytest.approx(left, abs=1e-8)
    assert about.lineage[-1].id == theirs.item_id
    assert about.lineage[-1].sha256 == theirs.content_sha256
    assert about.lineage[-1].operation.startswith(f"trim --steps {first} {stop}")
    store.delete(result.id, for_good=True)


def test_encoded_images_keep_their_bytes(long_take):
    store, made = long_take.both
    if made.descriptors[3].unit == "rgb8":
        pytest.skip("raw images have no encoded bytes")
    source = store.open(made.attributes.episode_id)
    result = trim_episode(store, source.item_id, (17, 41), outcome="keep", options=KEPT)
    ours = store.open(result.id)
    all_bytes = source.encoded_images("camera_head", 0, source.num_samples("camera_head"))
    got = ours.encoded_images("camera_head", 0, ours.num_samples("camera_head"))
    place = all_bytes.index(got[0])
    assert got == all_bytes[place : place + len(got)]
    assert made.descriptors[3].unit == "jpeg" or place % 8 == 0
    store.delete(result.id, for_good=True)


def test_a_trim_that_keeps_all_has_the_same_arrays(long_take):
    store, made = long_take.both
    source = store.open(made.attributes.episode_id)
    result = trim_episode(store, source.item_id, (0, NUM_STEPS), options=KEPT)
    assert arrays_of(store, result.id) == arrays_of(store, source.item_id)
    ours, theirs = store.open(result.id).attributes, source.attributes
    changed = {"episode_id", "lineage", "generator_command"}
    assert ours.model_dump(exclude=changed) == theirs.model_dump(exclude=changed)
    store.delete(result.id, for_good=True)


def arrays_of(store, name, kind="episode"):
    contents = maintenance.open_contents(store.files(name, kind=kind), kind)
    return {array: (entry.sha256, entry.shape) for array, entry in contents.entries.items()}


def test_damaged_images_beside_the_cut_are_shown_as_before(store):
    made = episode_of(30, camera_unit="jpeg")
    images = [bytes(one) for one in encoded(made.values["camera_head"])]
    # Truncated scan data: libjpeg warns, and the format calls such an image damaged.
    damaged = [19, 20, 21, 36, 37, 38, 39]
    for bad in damaged:
        images[bad] = images[bad][: len(images[bad]) // 2] + b"\xff\xd9"
    made.values["camera_head"] = np.array([*images, None], dtype=object)[:-1]
    source = made.write(store)
    assert source.damaged_images("camera_head").tolist() == damaged
    result = trim_episode(store, source.item_id, (10, 20), outcome="keep", options=KEPT)
    # At the first step image 18 is shown for image 20, at the last one 40 for 38.
    check_head = store.open(result.id).window(0, 10), source.window(10, 10)
    np.testing.assert_array_equal(*(one.images["camera_head"] for one in check_head))
    np.testing.assert_array_equal(*(one.image_dt_ns["camera_head"] for one in check_head))


def encoded(images):
    from dextouch.images import encode_jpeg

    return [encode_jpeg(image) for image in images]


# Of steps 6 … 8 and 15 … 17, or where step 0 is 10 ms before 0, of 6 … 9 and 16 … 18.
@pytest.mark.parametrize(("zero_ns", "num_interpolated"), [(0, 6.0), (-10_000_000, 7.0)])
def test_interpolated_spans_figures_and_the_origin_move_with_the_cut(
    store, zero_ns, num_interpolated
):
    calibration = {
        "interpolated_wrist_left_s": ((0.2, 0.6), (1.0, 1.2)),
        "interpolated_fingers_right_s": ((0.1, 0.3, 1.0),),
        "T_x": ((1.0,),),
    }
    figures = {
        "origin_after_start_ns": 5e8,
        "num_steps_interpolated": 9.0,
        "tactile_left_num_refused_taxels": 2.0,
        "wrist_left_jerk": 3.0,
        **{f"figure_{index}": 0.0 for index in range(7)},
    }
    source = write_take(store, "take", num_steps=30, quality=figures)
    changed = source.attributes.model_copy(
        update={"episode_id": "marked", "calibration": calibration, "streams": ()}
    )
    source = rewritten(store, source, changed, zero_ns)
    store.delete("take-aligned")
    result = trim_episode(store, "marked", (6, 30), options=KEPT)
    ours = store.open(result.id)
    got = interpolated_spans(ours.attributes.calibration)
    want = [("wrist_left", zero_ns, 200_000_000), ("wrist_left", 600_000_000, 800_000_000)]
    assert got == want
    np.testing.assert_array_equal(
        EpisodeGrid(ours).measured_columns, EpisodeGrid(source).measured_columns[6:]
    )
    assert ours.attributes.quality == {
        "origin_after_start_ns": 9e8,
        "num_steps_interpolated": num_interpolated,
        "tactile_left_num_refused_taxels": 2.0,
    }
    shown = ", ".join(f"figure_{index}" for index in range(6))
    assert f"figures of the whole are left out: {shown}, and 2 more" in result.messages


def rewritten(store, reader, attributes, zero_ns=0):
    with store.writer(attributes=attributes) as writer:
        for descriptor in reader.attributes.streams:
            writer.add_stream(descriptor)
            count = reader.num_samples(descriptor.name)
            writer.append(
                descriptor.name,
                values=reader.values(descriptor.name, 0, count),
                t_ref_ns=reader.stamps_ns(descriptor.name) + zero_ns,
            )
    return store.open(attributes.episode_id)


def test_seconds_are_those_after_step_0(store):
    reader = write_episode(store, "a", num_steps=31)
    assert steps_between(reader, None, None) == (0, 31)
    assert steps_between(reader, 1.0, None) == (15, 31)
    assert steps_between(reader, None, 1.0) == (0, 15)
    # Step 1 is at 66 666 667 ns, which nobody types.
    assert steps_between(reader, 0.0666667, 0.2) == (1, 3)
    for from_s, to_s in [(1.0, 1.0), (2.0, 1.0), (-0.1, 1.0), (0.0, 2.2), (3.0, None)]:
        with pytest.raises(InvalidInputError, match=r"within 0 … 2\.067 s"):
            steps_between(reader, from_s, to_s)
    with pytest.raises(InvalidInputError, match=r"fewer than two steps .*66\.7 ms apart"):
        steps_between(reader, 0.01, 0.05)


@pytest.mark.parametrize("steps", [(5, 5), (5, 6), (6, 5), (-1, 4), (0, 10)])
def test_spans_outside_and_empty_ones_are_refused(store, steps):
    write_episode(store, "a")
    with pytest.raises(
        InvalidInputError, match="expected a span of two or more within its 9 steps"
    ):
        trim_episode(store, "a", steps)
    assert store.list() == ["a"]
    assert store.review("a") is None


def test_an_outcome_whose_end_is_cut_off_must_be_said(store):
    write_episode(store, "a")
    with pytest.raises(InvalidInputError, match=r"end is cut off.*\(success\).*--outcome keep"):
        trim_episode(store, "a", (0, 5))
    assert trim_episode(store, "a", (2, 9), options=KEPT).messages == ()
    result = trim_episode(store, "a", (0, 5), outcome="unknown")
    assert store.open(result.id).attributes.success is None


def test_unknown_ids_taken_ids_and_held_items_are_named(store):
    write_episode(store, "a")
    write_episode(store, "b")
    with pytest.raises(NotFoundError, match="'nobody'"):
        trim_episode(store, "nobody", (0, 1))
    with pytest.raises(ConflictError, match="'b' exists already; choose another id with --as"):
        trim_episode(store, "a", (1, 9), options=EditOptions(new_id="b"))
    other = EpisodeStore(store.root)
    with other.held("a"), pytest.raises(UnavailableError, match="another program is changing it"):
        trim_episode(store, "a", (1, 9))
    assert store.list() == ["a", "b"]


def test_a_store_that_cannot_be_written_is_left_as_it_is(store):
    write_episode(store, "a")
    staging = store.root / ".staging"
    staging.rmdir()
    staging.write_text("in the way")
    with pytest.raises(StorageError, match=r"create .*\.staging"):
        trim_episode(store, "a", (1, 9))
    staging.unlink()
    assert store.list() == ["a"]
    assert not is_rejected(store, store.open("a").attributes)


def test_a_dry_run_writes_nothing(store):
    write_episode(store, "a")
    before = sorted(path for path in store.root.rglob("*"))
    options = EditOptions(dry_run=True)
    trimmed = trim_episode(store, "a", (1, 9), options=options)
    assert (trimmed.id, trimmed.sha256) == ("a-trimmed-1", None)
    assert trimmed.num_samples == {"action": 8, "camera_head": 8, "tactile_left": 8}
    relabel_item(store, "a", {"task": "stir"}, outcome="failure", options=options)
    assert sorted(path for path in store.root.rglob("*")) == before


def note(start_ns, stop_ns, number=1):
    return TimedNote(
        number=number, start_ns=start_ns, stop_ns=stop_ns, text="slips", written_at=NOON
    )


CLICKS = EpisodeClicks.model_validate({"objects": {"cup": {"state": "absent"}}})


def test_notes_move_with_the_cut_and_clicks_stay_with_the_first_image(store):
    write_episode(store, "a", num_steps=30)
    store.set_clicks("a", CLICKS)
    notes = [note(0, 10**8), note(5 * 10**8, 15 * 10**8, 2)]
    store.change_notes("a", lambda _: ItemNotes(notes=tuple(notes)))
    late = trim_episode(store, "a", (15, 30), options=KEPT)
    assert [(n.start_ns, n.stop_ns) for n in store.notes(late.id).notes] == [(0, 5 * 10**8)]
    assert store.clicks(late.id) is None
    assert {m.split(",")[0] for m in late.messages} >= {
        "1 notes lie outside and are left out",
        "the clicks are on another first image and are left out",
    }
    early = trim_episode(store, "a", (0, 12), outcome="keep", options=KEPT)
    assert store.clicks(early.id) == CLICKS
    stops = [(n.start_ns, n.stop_ns) for n in store.notes(early.id).notes]
    assert stops == [(0, 10**8), (5 * 10**8, 733_333_333)]


# Relabels


def test_a_relabel_shares_the_arrays_and_changes_attributes(store):
    source = write_episode(store, "a", event_times_s={"stand": 0.2})
    store.set_clicks("a", CLICKS)
    options = EditOptions(new_id="b", keep=True)
    result = relabel_item(
        store, "a", {"instruction": "it's up"}, outcome="failure", options=options
    )
    ours = store.open("b")
    ours.verify()
    assert arrays_of(store, "b") == arrays_of(store, "a")
    assert (ours.attributes.instruction, ours.attributes.success) == ("it's up", False)
    assert ours.attributes.event_times_s == {"stand": 0.2}
    assert ours.attributes.lineage[-1].operation == (
        """relabel --instruction 'it'"'"'s up' --outcome failure"""
    )
    assert ours.content_sha256 == result.sha256 != source.content_sha256
    shards = [store.root / "episodes" / name / "action" / "c" / "0" / "0" for name in ("a", "b")]
    assert shards[0].samefile(shards[1])
    assert store.clicks("b") == CLICKS
    assert chosen(store) == ["b"]
    # They are apart for all that: what is left of one is whole.
    store.delete("a", for_good=True)
    store.open("b").verify()
    assert not maintenance.inspect_group(store.files("b"), "episode").damaged


def test_another_task_needs_an_outcome_and_drops_the_events(store):
    write_episode(store, "a", event_times_s={"stand": 0.2})
    with pytest.raises(InvalidInputError, match=r"becomes one of 'stir'.*--outcome"):
        relabel_item(store, "a", {"task": "stir"})
    result = relabel_item(store, "a", {"task": "stir"}, outcome="unknown")
    about = store.open(result.id).attributes
    assert (about.task, about.success, about.event_times_s) == ("stir", None, {})
    assert result.messages == ("events of 'stand_bottle' are left out",)


def test_a_relabel_must_change_something_and_names_no_operator(store):
    write_recording(store, "take", operator="p-1")
    for changes in ({}, {"operator": "p-1"}):
        with pytest.raises(InvalidInputError, match="nothing changes"):
            relabel_item(store, "take", changes, kind="recording")
    result = relabel_item(store, "take", {"operator": "p-2"}, kind="recording")
    about = store.recording(result.id).attributes
    assert about.operator == "p-2"
    assert "p-2" not in about.lineage[-1].operation
    assert store.list(kind="recording") == ["take-relabelled-1"]


def test_a_relabel_to_another_operator_is_another_one(store, tmp_path):
    write_recording(store, "take", operator="p-1")
    for operator in ("p-2", "p-3", "p-2"):
        change = {"operator": operator}
        result = relabel_item(store, "take", change, kind="recording", options=KEPT)
        assert store.recording(result.id).attributes.operator == operator
    assert len(store.list(kind="recording")) == 3
    write_recording(store, "other", operator="p-4")
    request = maintenance.DeletionRequest(operator="p-4")
    maintenance.delete_for_good(store.root, request, tmp_path / "receipt.json")
    with pytest.raises(InvalidInputError, match="permanently deleted"):
        relabel_item(store, "take", {"operator": "p-4"}, kind="recording")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"operator": ""}, "operator: .* at least 1"),
        ({"operator": "p" * 129}, "operator: .* at most 128"),
        ({"instruction": "x" * 9000}, "instruction: .* at most 2000"),
    ],
)
def test_labels_have_the_limits_of_requests(store, changes, message):
    write_recording(store, "take", operator="p-1")
    with pytest.raises(InvalidInputError, match=message):
        relabel_item(store, "take", changes, kind="recording")
    assert store.list(kind="recording") == ["take"]


def test_the_longest_labels_fit_into_the_lineage(store):
    write_recording(store, "take")
    changes = {"task": "'" * 128, "instruction": "'" * 2000}
    result = relabel_item(store, "take", changes, kind="recording", outcome="unknown")
    (source,) = store.recording(result.id).attributes.lineage
    assert shlex.split(source.operation)[2::2] == [*changes.values(), "unknown"]


def test_an_edit_takes_only_the_files_of_arrays(store):
    write_episode(store, "a")
    (store.root / "episodes/a/backup.bin").write_bytes(b"x")
    shard = store.root / "episodes/a/action/c/0/0"
    result = relabel_item(store, "a", {"instruction": "up"}, options=KEPT)
    assert "backup.bin" not in store.files(result.id).names()
    shard.rename(store.root / "moved")
    shard.symlink_to(store.root / "moved")
    with pytest.raises(StorageError, match="symbolic link"):
        relabel_item(store, "a", {"instruction": "down"})


def test_deleting_an_operator_deletes_what_was_relabelled_from_another(store, tmp_path):
    write_recording(store, "take", operator="p-1")
    relabel_item(store, "take", {"operator": "p-2"}, kind="recording")
    request = maintenance.DeletionRequest(operator="p-2")
    receipt = maintenance.delete_for_good(store.root, request, tmp_path / "receipt.json")
    # The source shows the same person under a wrong pseudonym.
    assert {victim.id for victim in receipt.deleted} == {"take", "take-relabelled-1"}
    assert receipt.complete


# Recordings


def test_a_trimmed_recording_has_its_samples_as_they_were(store):
    source = write_recording(store, "take", num_samples=90)
    result = trim_recording(store, "take", 0.5, 2.0, options=KEPT)
    ours, theirs = store.recording(result.id), source
    ours.verify()
    got = ours.read("wrist_left")
    stamps_ns = np.arange(90) * 33_333_333
    inside = (stamps_ns >= 5 * 10**8) & (stamps_ns < 2 * 10**9)
    np.testing.assert_array_equal(got.t_host_ns, stamps_ns[inside])
    np.testing.assert_array_equal(got.sequence, np.arange(90)[inside])
    np.testing.assert_array_equal(got.t_device_ns, theirs.read("wrist_left").t_device_ns[inside])
    assert ours.attributes.lineage[-1].operation == "trim --from 0.5 --to 2.0"
    for span in [(4.0, None), (1.0, 1.0), (-1.0, 1.0)]:
        with pytest.raises(InvalidInputError, match="expected one within 0 … "):
            trim_recording(store, "take", *span)


@pytest.mark.parametrize("changes", [{"keep": "yes"}, {"outcome": "failure"}])
def test_only_texts_of_three_attributes_are_relabelled(store, changes):
    write_episode(store, "a")
    with pytest.raises(InvalidInputError, match="expected texts of task, instruction or operator"):
        relabel_item(store, "a", changes)
    assert store.list() == ["a"]
