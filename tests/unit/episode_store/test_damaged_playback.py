"""Players get no damaged image, which a browser would fill in."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.images import decode_jpeg, encode_jpeg
from dextouch.streams import encoded_values, unpack
from services.episode_store.reading import ImagesQuery, _images
from tests.unit.bridges.lerobot_episodes import make_episode, pictures

CAMERA = "camera_head"


@pytest.mark.parametrize("half_size", [False, True])
def test_a_span_with_a_damaged_image_is_played_without_it(tmp_path, half_size):
    made = make_episode(num_steps=5)
    made.set_unit("jpeg", CAMERA)
    images = [encode_jpeg(image) for image in pictures(9)]
    images[4] = images[4][:-50]
    made.values[CAMERA] = encoded_values(images)
    reader = made.write(EpisodeStore(tmp_path))
    answer = _images(reader, CAMERA, ImagesQuery(half_size=half_size), 1 << 24)
    _, arrays = unpack(answer, max_bytes=1 << 24)
    kept = np.delete(np.arange(9), 4)
    np.testing.assert_array_equal(arrays["t_ns"], reader.stamps_ns(CAMERA)[kept])
    ends = np.cumsum(arrays["num_bytes"])
    data = arrays["data"].tobytes()
    assert ends[-1] == len(data)
    for start, end, index in zip([0, *ends[:-1]], ends, kept, strict=True):
        if half_size:
            assert decode_jpeg(data[start:end]).shape == (24, 32, 3)
        else:
            assert data[start:end] == images[index]
