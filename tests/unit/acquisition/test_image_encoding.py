import threading

import numpy as np
import pytest

from dextouch.episodes import GOP_IMAGES, is_keyframe
from dextouch.errors import DeviceError, InvalidInputError, NotFoundError
from dextouch.images import decode_jpeg
from dextouch.streams import Sample
from services.acquisition.devices.camera import CameraDecoder
from services.acquisition.drivers.images import (
    MAX_WAITING_IMAGES,
    EncodingQueue,
    GroupPreview,
    ImageEncoder,
    WholeGroups,
)
from services.acquisition.drivers.packets import DecoderStatistics

SIZE_PX = (32, 48)
WAIT_S = 20.0


def picture(index):
    rows, columns = np.mgrid[0 : SIZE_PX[0], 0 : SIZE_PX[1]]
    wave = 120 + 60 * np.sin((rows + 2 * index) / 5) + 40 * np.cos(columns / 7)
    return np.repeat(wave[..., None], 3, axis=2).astype(np.uint8)


def queue_of(encoding):
    return EncodingQueue(ImageEncoder(encoding, SIZE_PX, rate_hz=30.0), name="camera_head")


def decoder_of(encoding):
    return CameraDecoder("camera_head", height_px=32, width_px=48, encoding=encoding)


def encoded(count, *, first=0):
    queue = queue_of("h264")
    samples = []
    for index in range(first, first + count):
        assert queue.put(Sample(index, picture(index), index, index))
        samples += queue.collect(WAIT_S)
    queue.stop()
    return samples


def keys(samples):
    return [index for index, sample in enumerate(samples) if is_keyframe(sample.values.item())]


def psnr_db(image, truth):
    return 10 * np.log10(255**2 / max(1e-9, np.mean((image.astype(float) - truth) ** 2)))


@pytest.mark.parametrize("encoding", ["rgb8", "jpeg"])
def test_still_images_keep_their_stamps(encoding):
    queue = queue_of(encoding)
    assert queue.put(Sample(7, picture(3), 8, 9))
    (sample,) = queue.collect(WAIT_S)
    queue.stop()
    assert (sample.t_host_ns, sample.t_device_ns, sample.sequence) == (7, 8, 9)
    image = sample.values if encoding == "rgb8" else decode_jpeg(sample.values.item())
    assert psnr_db(image, picture(3)) > 35


def test_groups_of_eight():
    assert keys(encoded(20)) == [0, 8, 16]


def test_a_take_begins_a_group_whatever_came_before():
    queue, samples = queue_of("h264"), []
    for index in range(23):
        if index == 13:
            queue.begin_group()
        assert queue.put(Sample(index, picture(index)))
        samples += queue.collect(WAIT_S)
    queue.stop()
    assert keys(samples) == [0, 8, 13, 21]


def test_a_stopped_queue_goes_on_with_its_group():
    queue, samples = queue_of("h264"), []
    for index in range(12):
        if index == 5:
            queue.stop()
        assert queue.put(Sample(index, picture(index)))
        samples += queue.collect(WAIT_S)
    queue.stop()
    assert keys(samples) == [0, 8]


def test_what_waits_at_a_stop_is_not_lost():
    queue = queue_of("h264")
    for index in range(5):
        assert queue.put(Sample(index, picture(index)))
    queue.stop()
    assert [sample.t_host_ns for sample in queue.collect()] == [0, 1, 2, 3, 4]


class SlowEncoder(ImageEncoder):
    """Encodes when told to."""

    def __init__(self):
        super().__init__("h264", SIZE_PX, rate_hz=30.0)
        self.go_on = threading.Event()

    def encode(self, image, *, begins):
        assert self.go_on.wait(WAIT_S)
        return super().encode(image, begins=begins)


def test_a_slow_encoder_drops_counts_and_tears_no_group(request):
    encoder = SlowEncoder()
    queue = EncodingQueue(encoder, name="camera_head")
    request.addfinalizer(encoder.go_on.set)
    taken = [queue.put(Sample(index, picture(index))) for index in range(20)]
    assert taken == [True] * MAX_WAITING_IMAGES + [False] * (20 - MAX_WAITING_IMAGES)
    assert queue.num_dropped == 20 - MAX_WAITING_IMAGES
    assert queue.collect(0.0) == []
    queue.begin_group()
    encoder.go_on.set()
    samples = queue.collect(WAIT_S)
    for index in range(20, 30):
        assert queue.put(Sample(index, picture(index)))
        samples += queue.collect(WAIT_S)
    queue.stop()
    assert [sample.t_host_ns for sample in samples] == [*range(8), *range(20, 30)]
    assert keys(samples) == [0, 8, 16]


def test_odd_sizes_are_refused_for_h264_only():
    with pytest.raises(InvalidInputError, match="even"):
        ImageEncoder("h264", (31, 48), rate_hz=30.0)
    assert ImageEncoder("jpeg", (31, 48), rate_hz=30.0).encoding == "jpeg"


def test_the_newest_image_can_be_looked_at():
    preview = GroupPreview(SIZE_PX)
    samples = encoded(2 * GOP_IMAGES)
    preview.add(samples[3].values.item())
    with pytest.raises(NotFoundError, match="key frame"):
        preview.image()
    for index, sample in enumerate(samples):
        preview.add(sample.values.item())
        assert psnr_db(preview.image(), picture(index)) > 30


def test_a_preview_does_not_go_on_without_a_key_frame():
    samples = encoded(2 * GOP_IMAGES)
    preview = GroupPreview(SIZE_PX)
    for sample in [*samples[:GOP_IMAGES], samples[GOP_IMAGES + 1]]:
        preview.add(sample.values.item())
    with pytest.raises(NotFoundError, match="key frame"):
        preview.image()


def passed(groups, samples):
    return [group for sample in samples if (group := groups.add(sample))]


def test_whole_groups_pass():
    samples, counts = encoded(20), DecoderStatistics()
    groups = WholeGroups("camera_head", counts)
    assert passed(groups, samples) == [samples[:8], samples[8:16]]
    groups.reset()
    assert counts.refused == 4


@pytest.mark.parametrize("lost", [0, 3, 7, 8, 12])
def test_a_group_that_lost_an_image_is_left_out(lost):
    samples, counts = encoded(24), DecoderStatistics()
    groups = WholeGroups("camera_head", counts)
    torn = lost // GOP_IMAGES
    expected = [samples[8 * g : 8 * g + 8] for g in range(3) if g != torn]
    assert passed(groups, samples[:lost] + samples[lost + 1 :]) == expected
    assert counts.refused == GOP_IMAGES - 1


def renumbered(samples):
    return [Sample(s.t_host_ns, s.values, s.t_device_ns, i) for i, s in enumerate(samples)]


@pytest.mark.parametrize("length", [3, 9])
def test_groups_of_another_length_are_named(length):
    groups = WholeGroups("camera_head", DecoderStatistics())
    if length < GOP_IMAGES:
        samples = renumbered([*encoded(length), *encoded(1)])
    else:
        whole = encoded(8)
        samples = renumbered([*whole, whole[-1]])
    for sample in samples[:-1]:
        groups.add(sample)
    with pytest.raises(DeviceError, match="another length than 8 images"):
        groups.add(samples[-1])
