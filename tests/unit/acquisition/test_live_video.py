"""What viewers see of a camera whose images come as H.264."""

import numpy as np
import pytest

from dextouch.episodes import GopEncoder, VideoSettings
from dextouch.errors import NotFoundError
from dextouch.images import decode_jpeg
from dextouch.streams import Sample, encoded_values
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.camera import CameraSettings
from services.acquisition.station import LiveView

CAMERA = CameraSettings(stream="camera_head", port=1, height_px=48, width_px=64, encoding="h264")


@pytest.fixture
def samples():
    encoder = GopEncoder(48, 64, rate_hz=30.0, settings=VideoSettings())
    units = [encoder.encode(np.full((48, 64, 3), 20 * k + 20, np.uint8)) for k in range(10)]
    return [Sample(k, encoded_values([unit])[0:1].reshape(())) for k, unit in enumerate(units)]


def test_the_newest_image_is_shown(samples):
    view = LiveView(build_drivers([CAMERA], StationClock()), {})
    view.accept({"camera_head": samples[3:6]})
    with pytest.raises(NotFoundError, match="key frame"):
        view.jpeg("camera_head", 10)
    for first, stop in ((0, 3), (3, 10)):
        view.accept({"camera_head": samples[first:stop]})
        image = decode_jpeg(view.jpeg("camera_head", 10))
        assert abs(float(image.mean()) - 20 * stop) < 4
    assert view.cameras(10)[0].image_index == 13
