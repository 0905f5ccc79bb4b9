"""Images whose bytes are intact but which are damaged: treated as images never recorded."""

import shutil

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, GopEncoder, VideoSettings, first_gap
from dextouch.episodes.maintenance import inspect_group, repair_group
from dextouch.errors import CorruptDataError, NotFoundError
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import encoded_values
from tests.unit.episodes.hostile_group import IMAGE_CHUNK

CAMERA = "camera_head"
NUM_STEPS = 41


def encoded(made, unit):
    images = made.values[CAMERA]
    if unit == "jpeg":
        return [encode_jpeg(image) for image in images]
    encoder = GopEncoder(64, 64, rate_hz=30.0, settings=VideoSettings())
    return [encoder.encode(image) for image in images]


def with_damage(make_episode, store, unit, damaged):
    """An episode of 81 images of which some are cut, and a reader of it."""
    made = make_episode(NUM_STEPS)
    names = {f"camera_{name}" for name in ("wrist_left", "wrist_right")}
    made.descriptors = [d for d in made.descriptors if d.name not in names]
    made.descriptors = [
        d.model_copy(update={"unit": unit}) if d.name == CAMERA else d for d in made.descriptors
    ]
    made.values = dict(made.values)
    images = encoded(made, unit)
    for index in damaged:
        images[index] = images[index][: len(images[index]) * 6 // 10]
    made.values[CAMERA] = encoded_values(images)
    return made.write(store)


def test_a_window_shows_the_nearest_whole_image_with_its_time(make_episode, store, tmp_path):
    whole = with_damage(make_episode, EpisodeStore(tmp_path / "whole"), "jpeg", ())
    reader = with_damage(make_episode, store, "jpeg", (20, 21))
    # Step 10 is at image 20; images 19 and 22 are the next that are left, 33 and 67 ms away.
    window, expected = reader.window(0, NUM_STEPS), whole.window(0, NUM_STEPS)
    dt_ns = window.image_dt_ns[CAMERA]
    assert dt_ns[10] == reader.stamps_ns(CAMERA)[19] - reader.stamps_ns(CAMERA)[20]
    np.testing.assert_array_equal(np.delete(dt_ns, 10), np.zeros(NUM_STEPS - 1))
    np.testing.assert_array_equal(
        np.delete(window.images[CAMERA], 10, axis=0),
        np.delete(expected.images[CAMERA], 10, axis=0),
    )
    np.testing.assert_array_equal(window.images[CAMERA][10], whole.images(CAMERA, 19, 20)[0])


@pytest.mark.parametrize(
    ("unit", "damaged", "lost"),
    [("jpeg", (20, 57), (20, 57)), ("h264", (18, 79), (*range(18, 24), 79)), ("h264", (8,),
      range(8, 16))],
)  # fmt: skip
def test_readers_by_time_leave_out_what_readers_by_index_refuse(
    make_episode, store, unit, damaged, lost
):
    reader = with_damage(make_episode, store, unit, damaged)
    np.testing.assert_array_equal(reader.damaged_images(CAMERA), lost)
    stamps = reader.stamps_ns(CAMERA)
    data = reader.read(CAMERA)
    np.testing.assert_array_equal(data.t_ref_ns, np.delete(stamps, lost))
    assert len(data.values) == 81 - len(lost)
    native = reader.window(0, NUM_STEPS, cameras=(CAMERA,), grid=False)
    np.testing.assert_array_equal(native.streams[CAMERA].t_ref_ns, data.t_ref_ns)
    with pytest.raises(CorruptDataError, match=f"image {damaged[0]}: "):
        reader.images(CAMERA)
    # Of a group, the images before the damage are whole.
    assert len(reader.images(CAMERA, 0, damaged[0])) == damaged[0]
    nearest = reader.nearest_images(CAMERA, stamps)
    assert set(nearest) == set(range(81)) - set(lost)


def test_steps_without_a_whole_image_of_their_own_are_not_shown(make_episode, store):
    reader = with_damage(make_episode, store, "h264", (17,))
    # Images 17 … 23 are lost, of which steps 9, 10 and 11 need 18, 20 and 22; of step 9, image 16
    # is a whole step away.
    steps, images = reader.shown_steps(CAMERA)
    assert sorted(set(range(NUM_STEPS)) - set(steps.tolist())) == [9, 10, 11]
    np.testing.assert_array_equal(images, 2 * steps)


def test_a_camera_without_a_whole_image_is_named(make_episode, store):
    reader = with_damage(make_episode, store, "jpeg", range(81))
    with pytest.raises(NotFoundError, match="no image that can be decoded"):
        reader.window(0, 3)


def recording_of(store, images, unit):
    attributes = RecordingAttributes(
        recording_id="take", task="t", instruction="", domain="human", station="s",
        started_t_host_ns=0,
    )  # fmt: skip
    with store.writer(kind="recording", attributes=attributes) as writer:
        writer.add_stream(images_stream(unit))
        stamps = np.arange(len(images)) * 33_333_333
        writer.append(CAMERA, values=encoded_values(images), t_host_ns=stamps)
    return store.recording("take")


def images_stream(unit):
    from tests.unit.episodes.conftest import episode_of

    (stream,) = (d for d in episode_of(3).descriptors if d.name == CAMERA)
    return stream.model_copy(update={"unit": unit})


@pytest.mark.parametrize(
    ("unit", "kept"), [("jpeg", np.delete(np.arange(24), [9, 20])), ("h264", np.arange(8))]
)
def test_verify_lists_every_damaged_image_and_repair_leaves_it_out(make_episode, store, unit, kept):
    images = encoded(make_episode(), unit)[:24]
    for index in (9, 20):
        images[index] = images[index][:-60]
    reader = recording_of(store, images, unit)
    report = inspect_group(store.files("take", kind="recording"), "recording")
    assert [finding.array for finding in report.findings] == [CAMERA, CAMERA]
    for index, finding in zip((9, 20), report.findings, strict=True):
        assert f"image {index}: " in finding.message
        assert "dextouch store repair" in finding.message
    with pytest.raises(CorruptDataError, match="image 9: "):
        reader.verify()
    batch = reader.read(CAMERA)
    assert len(batch.values) == 24 - (2 if unit == "jpeg" else 7 + 4)
    repaired = repair_group(store.root, "recording", "take")
    assert repaired.action == "salvaged"
    again = store.recording(repaired.new_id)
    again.verify()
    np.testing.assert_array_equal(again.stamps_ns(CAMERA), kept * 33_333_333)


def test_a_copy_with_the_same_damaged_image_still_mends_the_rest(make_episode, store, tmp_path):
    images = encoded(make_episode(), "jpeg")[:24]
    images[9] = images[9][:-60]
    recording_of(store, images, "jpeg")
    shutil.copytree(store.root, tmp_path / "copy")
    shard = store.root / "recordings/take" / CAMERA / "c/0"
    data = bytearray(shard.read_bytes())
    place = sum(map(len, images[:15])) + 100
    chunk = place // IMAGE_CHUNK
    data[place + 4 * chunk] ^= 1
    shard.write_bytes(data)
    findings = inspect_group(store.files("take", kind="recording"), "recording").findings
    assert {(finding.chunk, finding.image) for finding in findings} == {(None, 9), (chunk, None)}
    assert [f.message.split("; ")[-1] for f in findings if f.image is None] == [
        "damaged images: 15"
    ]
    copy = EpisodeStore(tmp_path / "copy").files("take", kind="recording")
    repaired = repair_group(store.root, "recording", "take", copy=copy)
    assert repaired.lost == {CAMERA: 1}
    again = store.recording(repaired.new_id).stamps_ns(CAMERA)
    np.testing.assert_array_equal(again, np.delete(np.arange(24), 9) * 33_333_333)


def test_a_missing_picture_is_found_by_the_numbers_of_its_neighbours(make_episode):
    units = encoded(make_episode(), "h264")[:8]
    assert first_gap(units) is None
    assert first_gap(units[:3] + units[4:]) == 3
    assert first_gap([units[0], *units[2:]]) == 1


def test_a_stored_group_that_lost_a_picture_is_damaged_from_there(make_episode, store):
    units = encoded(make_episode(), "h264")[:8]
    reader = recording_of(store, units[:5] + units[6:], "h264")
    np.testing.assert_array_equal(reader.damaged_images(CAMERA), [5, 6])
