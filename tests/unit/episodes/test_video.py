"""H.264 groups: what goes in comes out near, only what is asked is decoded, nothing is mixed up."""

import fcntl
import os

import numpy as np
import pytest

from dextouch.episodes import (
    GOP_IMAGES,
    EpisodeStore,
    GopEncoder,
    ImageForm,
    VideoSettings,
    is_keyframe,
)
from dextouch.episodes.files import make_held_folder
from dextouch.episodes.image_codecs import (
    GopDecoder,
    ImageGroups,
    pack_group,
    transform_pixels,
    unpack_group,
)
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    ShapeError,
    StorageFullError,
    UnknownNameError,
)
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor, encoded_values

HEIGHT, WIDTH, COUNT = 48, 64, 21
FULL = ImageForm()


def moving_images(count=COUNT, *, seed=5):
    """A smooth coloured scene that moves two pixels an image."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: HEIGHT + 16, : WIDTH + 48][..., None] / 12.0
    waves = [np.sin(rng.uniform(-1, 1) * x + rng.uniform(-1, 1) * y + [0, 1, 2]) for _ in range(4)]
    scene = 128 + 28 * np.sum(waves, axis=0)
    return np.stack(
        [scene[i % 16 : i % 16 + HEIGHT, 2 * i % 48 : 2 * i % 48 + WIDTH] for i in range(count)]
    ).astype(np.uint8)


def camera(name="camera_head", unit="h264", shape=(HEIGHT, WIDTH, 3)):
    return StreamDescriptor(
        name=name, kind="image", shape=shape, dtype="uint8", unit=unit, nominal_rate_hz=30
    )


def attributes(*streams, recording_id="take-1"):
    return RecordingAttributes(
        recording_id=recording_id,
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        streams=streams,
    )


def stamps(count, first=0):
    return np.arange(first, first + count, dtype=np.int64)


def write(store, images, *, unit="h264", block=1, recording_id="take-1"):
    take = attributes(camera(unit=unit), recording_id=recording_id)
    with store.writer(kind="recording", attributes=take) as writer:
        for start in range(0, len(images), block):
            values = images[start : start + block]
            writer.append("camera_head", values=values, t_host_ns=stamps(len(values), start))
    return store.recording(recording_id)


def psnr_db(got, true):
    return 10 * np.log10(255**2 / np.mean((got.astype(float) - true) ** 2))


@pytest.fixture
def encoder():
    return GopEncoder(HEIGHT, WIDTH, rate_hz=30.0, settings=VideoSettings())


def test_every_eighth_image_begins_a_group(encoder):
    kinds = [is_keyframe(encoder.encode(image)) for image in moving_images()]
    assert kinds == [index % GOP_IMAGES == 0 for index in range(COUNT)]
    assert not is_keyframe(b"")
    assert not is_keyframe(b"\x00\x00\x01")


@pytest.mark.parametrize("crf", [10, 26, 40])
def test_images_come_back_near(store, crf):
    images = moving_images()
    encoder = GopEncoder(HEIGHT, WIDTH, rate_hz=30.0, settings=VideoSettings(crf=crf))
    units = encoded_values([encoder.encode(image) for image in images])
    got = write(store, units).images("camera_head")
    near_db = psnr_db(got, images)
    assert near_db > {10: 38, 26: 33, 40: 25}[crf]
    # An image in its neighbour's place would be further off.
    assert psnr_db(got[1:], images[:-1]) < near_db - 0.5


def test_any_span_equals_the_whole(store):
    reader = write(store, moving_images())
    whole = reader.images("camera_head")
    for start in range(COUNT):
        for stop in range(start, COUNT + 1):
            np.testing.assert_array_equal(
                reader.images("camera_head", start, stop), whole[start:stop]
            )


@pytest.mark.parametrize("unit", ["h264", "jpeg", "rgb8"])
def test_forms_are_near_the_plain_way(store, unit):
    images = moving_images()
    reader = write(store, images, unit=unit)
    full = reader.images("camera_head", 3, 14)
    for form in (
        ImageForm(half_size=True),
        ImageForm(gray=True),
        ImageForm(half_size=True, gray=True),
    ):
        got = reader.images_at("camera_head", np.arange(3, 14), form=form)
        assert got.shape == (11, *form.shape((HEIGHT, WIDTH, 3)))
        assert abs(got.astype(int) - transform_pixels(full, form)).mean() < 2.5, form


def test_images_that_are_not_there_are_refused(store):
    reader = write(store, moving_images())
    with pytest.raises(InvalidInputError, match="within 0 … 21"):
        reader.images("camera_head", 6, 22)
    with pytest.raises(UnknownNameError, match="camera_head"):
        reader.images("camera")


def test_blocks_do_not_matter(store):
    images = moving_images(40)
    digests = set()
    for block in (1, 7, 40):
        reader = write(store, images, block=block, recording_id=f"take-{block}")
        digests.add(reader._contents.entries["camera_head"].sha256)
    assert len(digests) == 1


def test_the_writer_keeps_its_own_copy(store):
    images = moving_images(16)
    buffer = np.empty((1, HEIGHT, WIDTH, 3), np.uint8)
    with store.writer(kind="recording", attributes=attributes(camera())) as writer:
        for index, image in enumerate(images):
            buffer[0] = image
            writer.append("camera_head", values=buffer, t_host_ns=stamps(1, index))
            buffer[0] = 0
    assert psnr_db(store.recording("take-1").images("camera_head"), images) > 30


def test_access_units_are_kept_as_they_come(store, encoder):
    images = moving_images()
    units = [encoder.encode(image) for image in images]
    reader = write(store, encoded_values(units), block=5)
    for start, stop in [(0, COUNT), (0, 0), (7, 9), (20, 21)]:
        assert reader.encoded_images("camera_head", start, stop) == units[start:stop]
    assert psnr_db(reader.images("camera_head"), images) > 30


def test_groups_of_another_length_are_refused(store, encoder):
    units = [encoder.encode(image) for image in moving_images(9)]
    with store.writer(kind="recording", attributes=attributes(camera())) as writer:
        with pytest.raises(InvalidInputError, match="image 0: is no key frame"):
            writer.append("camera_head", values=encoded_values(units[1:2]), t_host_ns=stamps(1))
        writer.append("camera_head", values=encoded_values(units[:3]), t_host_ns=stamps(3))
        with pytest.raises(InvalidInputError, match="image 3: is a key frame"):
            writer.append("camera_head", values=encoded_values(units[:1]), t_host_ns=stamps(1, 3))
        with pytest.raises(InvalidInputError, match="start code"):
            writer.append("camera_head", values=encoded_values([b"abc"]), t_host_ns=stamps(1, 3))
        bad = np.array([None], dtype=object)
        with pytest.raises(ShapeError, match="expected bytes"):
            writer.append("camera_head", values=bad, t_host_ns=stamps(1, 3))
        writer.append("camera_head", values=encoded_values(units[3:]), t_host_ns=stamps(6, 3))
    assert store.recording("take-1").encoded_images("camera_head", 0, 9) == units


def test_plain_and_encoded_images_are_not_mixed(store, encoder):
    images = moving_images(8)
    unit = encoded_values([encoder.encode(images[0])])
    with store.writer(kind="recording", attributes=attributes(camera())) as writer:
        writer.append("camera_head", values=images, t_host_ns=stamps(8))
        with pytest.raises(InvalidInputError, match="got encoded images after plain ones"):
            writer.append("camera_head", values=unit, t_host_ns=stamps(1, 8))
    assert store.recording("take-1").num_samples("camera_head") == 8


@pytest.mark.parametrize("shape", [(47, 64, 3), (48, 63, 3)])
def test_odd_sizes_are_refused_at_once(store, shape):
    with pytest.raises(InvalidInputError, match="even"):
        store.writer(kind="recording", attributes=attributes(camera(shape=shape)))


def test_a_full_disk_in_the_encoders_thread_is_said(store, file_size_limit):
    noise = np.random.default_rng(1).integers(0, 255, (64, HEIGHT, WIDTH, 3), dtype=np.uint8)
    with file_size_limit(8192), pytest.raises(StorageFullError, match="no space left"):
        write(store, noise)
    assert store.list(kind="recording") == []


def test_a_forged_size_is_refused_before_it_is_decoded():
    large = GopEncoder(4096, 4096, rate_hz=30.0, settings=VideoSettings())
    unit = large.encode(np.zeros((4096, 4096, 3), np.uint8))
    groups = ImageGroups("h264", (HEIGHT, WIDTH, 3), "camera")
    out = np.empty((1, HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(CorruptDataError, match="camera: image 32: "):
        groups.decode([unit], 4, [0], FULL, out)
    jpeg = ImageGroups("jpeg", (HEIGHT, WIDTH, 3), "camera")
    with pytest.raises(CorruptDataError, match="expected"):
        jpeg.decode([encode_jpeg(np.zeros((8, 8, 3), np.uint8))], 0, [0], FULL, out)


def test_bytes_that_are_no_group_are_refused(encoder):
    units = [encoder.encode(image) for image in moving_images(8)]
    out = np.empty((1, HEIGHT, WIDTH, 3), np.uint8)
    whole = pack_group("h264", units)
    assert unpack_group("h264", whole, "storage chunk 0") == units
    for bad in (b"", whole[:3], whole[:20], whole[:-1], whole + b"x", bytes(40)):
        with pytest.raises(CorruptDataError, match="storage chunk 0"):
            unpack_group("h264", bad, "storage chunk 0")
    decoder = GopDecoder(HEIGHT, WIDTH)
    with pytest.raises(CorruptDataError):
        decoder.decode(units[1:3], [0, 1], FULL, np.empty((2, HEIGHT, WIDTH, 3), np.uint8))
    # The decoder is as good as new afterwards.
    decoder.decode(units[:1], [0], FULL, out)
    assert psnr_db(out[0], moving_images(1)[0]) > 30


def test_encoded_images_are_asked_of_encoded_streams_only(store):
    reader = write(EpisodeStore(store.root), moving_images(3), unit="rgb8")
    with pytest.raises(InvalidInputError, match="rgb8"):
        reader.encoded_images("camera_head", 0, 1)


def test_a_stage_that_was_swept_before_it_was_held_is_made_again(tmp_path, monkeypatch):
    stage, real = tmp_path / "stage", fcntl.flock
    swept = []

    def sweep_first(descriptor, how):
        if not swept:
            swept.append(stage.rmdir())
        return real(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", sweep_first)
    os.close(make_held_folder(stage))
    assert stage.is_dir()
