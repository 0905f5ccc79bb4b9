"""Video of the bridge: what is copied, what is decoded, and what is refused."""

from fractions import Fraction

import av
import numpy as np
import pytest

from dextouch.bridges.lerobot import ExportOptions, ImportOptions, export_dataset, import_dataset
from dextouch.bridges.lerobot.layout import frames_of
from dextouch.bridges.lerobot.video import (
    CameraVideo,
    VideoSpan,
    encode_images,
    read_images,
    read_units,
    stored_units,
)
from dextouch.episodes import (
    FULL_FORM,
    EpisodeStore,
    VideoSettings,
    decoder_of_this_thread,
    is_keyframe,
)
from dextouch.errors import CorruptDataError, ShapeError
from tests.unit.bridges.lerobot_episodes import SIZE_PX, make_episode, pictures

CAMERA = "observation.images.camera_head"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def encoded(count, *, crf=20, group=2):
    settings = VideoSettings(crf=crf, preset="veryfast")
    return encode_images(pictures(count), 15, settings, group)


def decoded_alone(units):
    images = np.empty((len(units), *SIZE_PX, 3), np.uint8)
    for unit, image in zip(units, images, strict=True):
        decoder_of_this_thread(*SIZE_PX).decode([unit], [0], FULL_FORM, image[None])
    return images


def write_video(path, images, *, codec="libx264", b_frames=0):
    with av.open(path, "w", format="mp4") as output:
        stream = output.add_stream(codec, rate=15, options={"crf": "18"})
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt, stream.max_b_frames = "yuv420p", b_frames
        stream.bit_rate, stream.time_base = 4_000_000, Fraction(1, 15)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = index
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def span(path, count, *, first=0, shape=(*SIZE_PX, 3)):
    return VideoSpan(path, first / 15, count, 15, shape)


def test_encoding_gives_one_unit_an_image_in_closed_groups():
    units = encoded(7, group=3)
    assert [is_keyframe(data) for data in units] == [True, False, False] * 2 + [True]
    images = decoded_alone(units[::3])
    assert np.abs(np.array(images).astype(int) - pictures(7)[::3]).mean() < 3


def test_a_better_quality_is_nearer_and_larger():
    sizes, errors = [], []
    for crf in (10, 40):
        units = encoded(4, crf=crf, group=1)
        sizes.append(sum(map(len, units)))
        decoded = np.array(decoded_alone(units))
        errors.append(np.abs(decoded.astype(int) - pictures(4)).mean())
    assert sizes[0] > sizes[1]
    assert errors[0] < errors[1]


def test_units_are_muxed_as_they_are_and_spans_found_again(tmp_path):
    first, second = encoded(5), encoded(6)
    video = CameraVideo(tmp_path, CAMERA, fps=15, shape=(*SIZE_PX, 3))
    # The header of a file holds one quality's parameter sets.
    places = [video.append(units, where="x") for units in (first, second, encoded(2, crf=30))]
    video.close()
    assert [place.file_number for place in places] == [0, 0, 1]
    assert places[2].from_timestamp_s == 0
    assert places[1].from_timestamp_s == places[0].to_timestamp_s == 5 / 15
    path = tmp_path / VIDEO
    assert read_units(span(path, 5)) == first
    assert read_units(span(path, 6, first=5)) == second
    images = np.array(list(read_images(span(path, 6, first=5))))
    assert np.abs(images.astype(int) - pictures(6)).mean() < 4
    for read in (read_units, lambda wanted: list(read_images(wanted))):
        with pytest.raises(CorruptDataError, match="image 11 of 12"):
            read(span(path, 12))
    # From the middle of a group nothing can be copied, but everything decoded.
    assert read_units(span(path, 3, first=6)) is None
    np.testing.assert_array_equal(list(read_images(span(path, 3, first=6))), images[1:4])


def test_what_cannot_be_muxed_is_refused(tmp_path):
    units = encoded(4)
    video = CameraVideo(tmp_path, CAMERA, fps=15, shape=(*SIZE_PX, 3))
    for bad in ([], units[1:], [b"\0\0\0\1\x67"]):
        with pytest.raises(CorruptDataError, match="begin"):
            video.append(bad, where="x")
    other = CameraVideo(tmp_path, CAMERA, fps=15, shape=(96, 64, 3))
    with pytest.raises(ShapeError, match="96"):
        other.append(units, where="x")
    other.close()


@pytest.mark.parametrize(("codec", "b_frames"), [("libx264", 3), ("mpeg4", 0)])
def test_video_that_cannot_be_copied_is_decoded(tmp_path, codec, b_frames):
    path, images = tmp_path / "video.mp4", pictures(12)
    write_video(path, images, codec=codec, b_frames=b_frames)
    assert read_units(span(path, 12)) is None
    decoded = np.array(list(read_images(span(path, 12)))).astype(int)
    assert len(decoded) == 12
    nearest = [
        np.abs(decoded - image).mean(axis=(1, 2, 3)).argmin() for image in images.astype(int)
    ]
    assert nearest == list(range(12))


def test_datasets_with_other_codecs_come_in(store, tmp_path):
    reader = make_episode(num_steps=9).write(store)
    export_dataset([reader], tmp_path / "dataset", repo_id="touch")
    images = reader.window(0, 9).images["camera_head"]
    write_video(tmp_path / "dataset" / VIDEO, images, b_frames=2)
    other = EpisodeStore(tmp_path / "other")
    import_dataset(tmp_path / "dataset", other, options=ImportOptions(images="h264"))
    back = other.open(reader.attributes.episode_id)
    assert np.abs(back.images("camera_head").astype(int) - images).mean() < 5


def test_images_before_the_first_step_stop_the_copying(store, tmp_path):
    made = make_episode(unit="h264")
    made.stamps_ns["camera_head"] = made.stamps_ns["camera_head"] - 100_000_000
    reader = made.write(store)
    frames = frames_of(reader, ("camera_head",), 30)
    indices = frames.image_indices["camera_head"]
    assert indices[0] == 3
    assert (np.diff(indices) == 1).all()
    assert stored_units(reader, "camera_head", indices) is None
    assert len(stored_units(reader, "camera_head", indices[5:])) == len(indices) - 5
    export_dataset([reader], tmp_path / "x", repo_id="touch", options=ExportOptions(fps=30))
    decoded = np.array(
        list(read_images(VideoSpan(tmp_path / "x" / VIDEO, 0.0, 30, 30, (48, 64, 3))))
    )
    assert np.abs(decoded.astype(int) - reader.images("camera_head", 3, 33)).mean() < 4


def write_reordered(path, images, *, x264="", **movie):
    """A video with B-frames as x264 makes them, and what a player shows of it."""
    with av.open(path, "w", format="mp4", options=movie) as output:
        stream = output.add_stream("libx264", rate=15, options={"x264-params": x264})
        stream.height, stream.width, stream.pix_fmt = *images.shape[1:3], "yuv420p"
        for image in images:
            output.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        output.mux(stream.encode(None))
    with av.open(path) as shown:
        frames = shown.decode(video=0)
        return np.array([f.to_ndarray(format="rgb24", interpolation="BICUBIC") for f in frames])


@pytest.mark.long
@pytest.mark.parametrize(
    ("x264", "movie"),
    [
        ("", {}),
        ("keyint=7:bframes=3", {}),
        ("open-gop=1:keyint=17:bframes=3", {}),
        ("keyint=20", {"use_editlist": "0"}),
        ("keyint=20", {"movflags": "negative_cts_offsets"}),
        ("keyint=20", {"movflags": "frag_keyframe+empty_moov"}),
    ],
    ids=["defaults", "short groups", "open groups", "no edit list", "negative", "fragments"],
)
def test_episodes_anywhere_in_a_video_with_b_frames_are_decoded(tmp_path, x264, movie):
    path, count = tmp_path / "video.mp4", 60
    shown = write_reordered(path, pictures(count), x264=x264, **movie)
    assert len(shown) == count
    for first in (0, 1, 6, 16, 19, 20, 33, 58):
        for length in {1, min(12, count - first), count - first}:
            wanted = span(path, length, first=first)
            assert read_units(wanted) is None
            images = np.array(list(read_images(wanted)))
            np.testing.assert_array_equal(images, shown[first : first + length])
    with pytest.raises(CorruptDataError, match="image 5 of 9"):
        list(read_images(span(path, 9, first=55)))
