"""Images of a response as JPEG, read with Pillow, which knows nothing of our code."""

import io

import numpy as np
import pytest
from PIL import Image

from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError
from dextouch.schemas import ReturnSelector, decode_answer
from dextouch.schemas.observations import decode_images, encode_images
from dextouch.streams import unpack
from tests.unit.schemas.test_rollout_codec import INFO, encode_answer
from tests.unit.worlds.fakes import observation

JPEG = ReturnSelector(images="jpeg")


def smooth(num_images, height_px=24, width_px=40):
    """Slopes of colours: [n, h, w, 3]."""
    n, y, x = np.mgrid[:num_images, :height_px, :width_px]
    return np.stack([3 * y + 5 * n, 4 * x, 200 - 2 * x - y], axis=-1).astype(np.uint8)


def files_of(arrays, camera="camera_head"):
    ends = np.cumsum(arrays[f"jpeg_bytes/{camera}"])[:-1]
    return [part.tobytes() for part in np.split(arrays[f"jpeg/{camera}"], ends)]


def test_another_decoder_reads_the_same_images():
    images = smooth(3)
    arrays = encode_images({"image/camera_head": images, "tactile_kpa": np.zeros(2)})
    assert set(arrays) == {"jpeg/camera_head", "jpeg_bytes/camera_head", "tactile_kpa"}
    by_pillow = np.stack([np.asarray(Image.open(io.BytesIO(file))) for file in files_of(arrays)])
    ours = decode_images(arrays, max_bytes=10**6, where="answer")["image/camera_head"]
    assert ours.shape == images.shape
    assert np.abs(ours.astype(int) - by_pillow).max() <= 2
    # The files of Pillow show colours of slopes within a few levels of what was sent.
    assert np.abs(by_pillow.astype(int) - images).max() <= 6
    assert sum(map(len, files_of(arrays))) < images.nbytes / 3


def test_a_jpeg_of_another_encoder_is_read():
    image, file = smooth(1)[0], io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=95, subsampling=0)
    data = np.frombuffer(file.getvalue(), np.uint8)
    arrays = {"jpeg/c": data, "jpeg_bytes/c": np.array([len(data)], np.int32)}
    got = decode_images(arrays, max_bytes=10**6, where="answer")["image/c"]
    assert np.abs(got[0].astype(int) - image).max() <= 6


def test_answers_hold_all_but_images_exactly():
    seen = observation(4)
    data = encode_answer(INFO, seen, selector=JPEG)
    got = decode_answer(data, max_bytes=10**6).observation
    assert {name: array.shape for name, array in got.images.items()} == {
        name: array.shape for name, array in seen.images.items()
    }
    np.testing.assert_array_equal(got.tactile_kpa, seen.tactile_kpa)
    np.testing.assert_array_equal(got.action_reached, seen.action_reached)
    assert not any(name.startswith("image/") for name in unpack(data, max_bytes=10**6)[1])


def test_raw_is_the_default_and_leaves_no_trace_in_hashes_of_requests():
    plain = ReturnSelector(steps="last")
    assert plain.model_dump_json() == '{"cameras":null,"steps":"last","tactile":true}'
    assert '"images":"jpeg"' in ReturnSelector(images="jpeg").model_dump_json()


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"jpeg_bytes/c": None}, InvalidInputError, "missing"),
        ({"jpeg_bytes/c": np.array([-1, 5], np.int32)}, InvalidInputError, "not positive"),
        ({"jpeg_bytes/c": np.array([7], np.int32)}, InvalidInputError, "expected 7 bytes"),
        ({"jpeg_bytes/c": np.array([], np.int32)}, InvalidInputError, "expected 0 bytes"),
        ({"jpeg/c": np.arange(100, dtype=np.uint8), "jpeg_bytes/c": np.array([100], np.int32)},
         CorruptDataError, "images of c"),
    ],
)  # fmt: skip
def test_damaged_images_are_refused(changed, error, says):
    arrays = encode_images({"image/c": smooth(2)}) | changed
    arrays = {name: array for name, array in arrays.items() if array is not None}
    with pytest.raises(error, match=says):
        decode_images(arrays, max_bytes=10**6, where="answer")


def test_images_of_two_sizes_and_huge_ones_are_refused():
    one, other = (encode_images({"image/c": images}) for images in (smooth(1), smooth(1, 32)))
    mixed = {name: np.concatenate([one[name], other[name]]) for name in one}
    with pytest.raises(InvalidInputError, match="expected one size"):
        decode_images(mixed, max_bytes=10**6, where="answer")
    with pytest.raises(LimitExceededError, match="2880 bytes when decoded"):
        decode_images(one, max_bytes=2879, where="answer")
