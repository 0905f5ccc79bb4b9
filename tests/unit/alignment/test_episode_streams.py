"""Images go from recording to episode as the bytes they are, groups of pictures as a whole."""

import numpy as np
import pytest

from dextouch import images
from dextouch.episodes import GOP_IMAGES, EpisodeStore
from dextouch.episodes.image_codecs import ImageForm, ImageGroups
from dextouch.errors import NotFoundError
from dextouch.streams import StreamDescriptor
from services.alignment import jobs
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization import recorded_streams
from tests.system.long_take import encode_images
from tests.unit.alignment.recordings import POSE, START_NS, write_recording

IMAGES = encode_images()
OPTIONS = AlignmentOptions()
ROBOT = ("wrist_left", "wrist_right", "head", "joints_measured")


def add_camera(store, recording_id, unit, t_ns, values):
    """The same recording with a camera, under another id."""
    old = store.recording(recording_id)
    K_head = ((60.0, 0.0, 160.0), (0.0, 60.0, 120.0), (0.0, 0.0, 1.0))
    attributes = old.attributes.model_copy(
        update={
            "recording_id": f"{recording_id}-camera",
            "streams": (),
            "calibration": {"K_head": K_head},
        }
    )
    camera = StreamDescriptor(
        name="camera_head",
        kind="image",
        shape=(240, 320, 3),
        dtype="uint8",
        unit=unit,
        nominal_rate_hz=30,
    )
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, stream in old.streams.items():
            batch = old.read(name)
            writer.add_stream(stream)
            writer.append(
                name,
                values=batch.values,
                t_host_ns=batch.t_host_ns,
                t_device_ns=batch.t_device_ns,
            )
        writer.add_stream(camera)
        writer.append(
            "camera_head", values=values, t_host_ns=t_ns, t_device_ns=t_ns - START_NS + 10**6
        )
    return f"{recording_id}-camera"


def camera_times_ns(num):
    return np.rint(np.arange(num) * (1e9 / 30)).astype(np.int64) + START_NS


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path)
    # The head is late, so the episode begins in the middle of a group of pictures.
    write_recording(store, "take", seconds=3.0, lost=(("head", 0, 50),))
    return store


@pytest.fixture
def no_decoding(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("an image was decoded or encoded")

    decode = ImageGroups.decode

    def decode_small(self, images, number, places, form, out):
        # Alignment looks at small gray copies, of which nothing is written.
        assert form == ImageForm(half_size=True, gray=True)
        decode(self, images, number, places, form, out)

    monkeypatch.setattr(ImageGroups, "decode", decode_small)
    monkeypatch.setattr(images, "encode_jpeg", refuse)
    monkeypatch.setattr("dextouch.episodes.writer.encode_jpeg", refuse)
    monkeypatch.setattr("dextouch.episodes.writer.GopEncoder", refuse)


@pytest.mark.parametrize("unit", ["jpeg", "h264"])
def test_encoded_images_are_copied_byte_for_byte(store, unit, no_decoding):
    t_ns = camera_times_ns(90)
    name = add_camera(store, "take", unit, t_ns, IMAGES[unit][:90])
    episode = store.open(align_recording(store, name, OPTIONS).episode_id)
    assert episode.streams["camera_head"].unit == unit
    num = episode.num_samples("camera_head")
    copied = episode.encoded_images("camera_head", 0, num)
    origin_ns = START_NS + round(episode.attributes.quality["origin_after_start_ns"])
    numbers = np.rint((episode.stamps_ns("camera_head") + origin_ns - START_NS) * 30e-9)
    original = list(IMAGES[unit][:90])
    assert copied == [original[int(number)] for number in numbers]
    # From the group that the first needed image is in.
    first_needed = round((origin_ns - START_NS) * 30e-9) - 1
    assert "camera_head_num_repeated_images" not in episode.attributes.quality
    expected = first_needed // GOP_IMAGES * GOP_IMAGES if unit == "h264" else first_needed
    assert int(numbers[0]) == expected
    assert int(numbers[-1]) == 89


def test_a_group_with_an_image_that_has_no_time_is_encoded_anew(store):
    t_ns = camera_times_ns(90)
    # One or two in a row would be dated by their neighbours.
    t_ns[40:43] = t_ns[39]
    name = add_camera(store, "take", "h264", t_ns, IMAGES["h264"][:90])
    report = align_recording(store, name, OPTIONS)
    episode = store.open(report.episode_id)
    assert report.quality["camera_head_num_images_encoded_anew"] == report.streams["camera_head"]
    stamps = episode.stamps_ns("camera_head")
    assert len(stamps) > 70
    # Still the right pictures at the right times, a generation of coding later.
    origin_ns = START_NS + round(report.quality["origin_after_start_ns"])
    number = round((int(stamps[-1]) + origin_ns - START_NS) * 30e-9)
    before = store.recording(name).images("camera_head", number, number + 1)
    after = episode.images("camera_head", len(stamps) - 1)
    assert np.abs(before.astype(float) - after).mean() < 4


def moving_stripes(shape, dtype, level):
    """90 images whose upper rows change at once in every third one."""
    rows = level + 0.2 * level * np.sin(np.arange(shape[0])[:, None] + np.arange(90)[:, None, None])
    rows[::3, :80] = 0.4 * level
    return np.broadcast_to(rows, (90, *shape)).astype(dtype)


@pytest.mark.parametrize(
    ("kind", "unit", "values"),
    [
        ("image", "mono8", moving_stripes((240, 320), "uint8", 100)),
        ("image", "mono16", moving_stripes((240, 320), "uint16", 800)),
        ("image", "m", moving_stripes((240, 320), "float32", 0.8)),
        ("pose", "pose_m_wxyz", np.tile(POSE, (90, 1, 1))),
        ("pose", "pose_m_wxyz", np.tile(POSE, (90, 5, 1))),
    ],
    ids=["gray", "depth in mm", "depth in m", "one pose in a list", "poses"],
)
def test_streams_of_other_programs_are_taken_over_as_they_are(tmp_path, kind, unit, values):
    store = EpisodeStore(tmp_path)
    write_recording(store, "take", seconds=3.0)
    stream = StreamDescriptor(
        name="more", kind=kind, shape=values.shape[1:], dtype=values.dtype.name, unit=unit,
        nominal_rate_hz=30,
    )  # fmt: skip
    old = store.recording("take")
    attributes = old.attributes.model_copy(update={"recording_id": "foreign", "streams": ()})
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, one in old.streams.items():
            writer.add_stream(one)
            writer.append(name, values=old.read(name).values, t_host_ns=old.read(name).t_host_ns)
        writer.add_stream(stream)
        writer.append("more", values=values, t_host_ns=camera_times_ns(90))
    episode = store.open(align_recording(store, "foreign", OPTIONS).episode_id)
    np.testing.assert_array_equal(episode.read("more").values, values)


def test_pieces_of_any_size_give_the_same_episode(tmp_path, monkeypatch):
    store = EpisodeStore(tmp_path)
    write_recording(store, "take", seconds=3.0, lost=(("head", 0, 50),))
    hashes = []
    for number, (num_bytes, num_images) in enumerate([(16 << 20, 64), (3000, 8)]):
        monkeypatch.setattr(recorded_streams, "PIECE_BYTES", num_bytes)
        monkeypatch.setattr(recorded_streams, "IMAGES_AT_ONCE", num_images)
        report = align_recording(store, "take", OPTIONS)
        episode = store.open(report.episode_id)
        hashes.append({name: episode._contents.entries[name].sha256 for name in (*ROBOT, "action")})
        assert report.created, number
        store.delete(report.episode_id, for_good=True)
    assert hashes[0] == hashes[1]


def test_missing_values_are_left_out_and_counted(tmp_path):
    store = EpisodeStore(tmp_path)
    write_recording(store, "take", seconds=3.0)
    old = store.recording("take")
    attributes = old.attributes.model_copy(update={"recording_id": "holes", "streams": ()})
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, stream in old.streams.items():
            batch = old.read(name)
            values = batch.values.copy()
            if name == "head":
                values[[0, 100, 101]] = np.nan
            writer.add_stream(stream)
            writer.append(
                name,
                values=values,
                t_host_ns=batch.t_host_ns,
                t_device_ns=batch.t_device_ns,
            )
    report = align_recording(store, "holes", OPTIONS)
    assert report.quality["head_num_incomplete"] == 3
    assert report.streams["head"] == report.streams["wrist_left"] - 3


def test_a_sample_without_a_time_of_its_own_takes_no_other_along(store):
    old = store.recording("take")
    attributes = old.attributes.model_copy(update={"recording_id": "repeat", "streams": ()})
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, stream in old.streams.items():
            batch = old.read(name)
            values, t_device_ns = batch.values.copy(), batch.t_device_ns.copy()
            if name == "joints_measured":
                values += np.arange(len(values))[:, None] * 1e-3
                t_device_ns[150:153] = t_device_ns[149]
                t_device_ns[200] = t_device_ns[199]
            writer.add_stream(stream)
            writer.append(name, values=values, t_host_ns=batch.t_host_ns, t_device_ns=t_device_ns)
    episode = store.open(align_recording(store, "repeat", OPTIONS).episode_id)
    origin_ns = START_NS + round(episode.attributes.quality["origin_after_start_ns"])
    data = episode.read("joints_measured")
    numbers = np.rint((data.t_ref_ns + origin_ns - START_NS) * 1e-7)
    assert not {150, 151, 152} & set(numbers)
    # A single one is dated by its neighbours.
    assert 200 in numbers
    np.testing.assert_allclose(data.values[:, 0], 0.25 + numbers * 1e-3, atol=1e-9)


def test_a_recording_that_is_deleted_while_it_is_aligned_leaves_no_episode(tmp_path, monkeypatch):
    store = EpisodeStore(tmp_path / "store")
    write_recording(store, "take")
    build = jobs.build_episode

    def build_and_delete(*args, **options):
        built = build(*args, **options)
        store.delete("take", kind="recording", for_good=True)
        return built

    monkeypatch.setattr(jobs, "build_episode", build_and_delete)
    with pytest.raises(NotFoundError, match="deleted while it was aligned"):
        align_recording(store, "take", OPTIONS)
    assert store.list() == []
    assert list((store.root / ".staging").glob("*")) == []


def test_images_that_come_twice_are_counted(store):
    values = np.empty(60, dtype=object)
    values[:] = [IMAGES["jpeg"][number // 2] for number in range(60)]
    name = add_camera(store, "take", "jpeg", camera_times_ns(60), values)
    report = align_recording(store, name, OPTIONS)
    num = report.streams["camera_head"]
    assert report.quality["camera_head_num_repeated_images"] in {num // 2, num // 2 - 1}
