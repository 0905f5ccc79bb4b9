"""Write and read an episode with three kinds of cameras; needs the extra `store` alone.

Run by `make check-environments` in environments with other versions of the packages, from a folder
outside the checkout. Images are compared with what simplejpeg and PyAV themselves decode, and those
of the golden store with their digest, so that pixels do not depend on the installed versions.
Names of modules that are given as arguments are imported first, as LeRobot would be.
"""

import hashlib
import importlib
import shutil
import sys
import tempfile
from pathlib import Path

import av
import numpy as np
import simplejpeg
import zarr

from dextouch.episodes import EpisodeStore, GopEncoder, VideoSettings
from dextouch.schemas import RecordingAttributes
from dextouch.streams import StreamDescriptor, encoded_values

GOLDEN = Path(__file__).parents[1] / "golden/store_v2"
GOLDEN_IMAGES_SHA256 = "e7d0ac385db7244b13ea0e2f51267f1183cc62093a220695a384ded040479877"
HEIGHT, WIDTH, COUNT = 48, 64, 21
MIN_PSNR_DB = 33


def moving_images():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: HEIGHT + 16, : WIDTH + 48][..., None] / 12.0
    waves = [np.sin(rng.uniform(-1, 1) * x + rng.uniform(-1, 1) * y + [0, 1, 2]) for _ in range(4)]
    scene = 128 + 28 * np.sum(waves, axis=0)
    spans = [scene[i % 16 : i % 16 + HEIGHT, 2 * i : 2 * i + WIDTH] for i in range(COUNT)]
    return np.stack(spans).astype(np.uint8)


def decoded_by_av(units):
    context = av.CodecContext.create("h264", "r")
    frames = [frame for unit in units for frame in context.decode(av.Packet(unit))]
    frames += context.decode(None)
    return np.stack(
        [f.reformat(format="rgb24", interpolation="BICUBIC").to_ndarray() for f in frames]
    )


def check_cameras(folder):
    images = moving_images()
    encoder = GopEncoder(HEIGHT, WIDTH, rate_hz=30.0, settings=VideoSettings())
    units = [encoder.encode(image) for image in images]
    jpegs = [simplejpeg.encode_jpeg(image, quality=90) for image in images]
    given = {"rgb8": images, "jpeg": encoded_values(jpegs), "h264": encoded_values(units)}
    expected = {
        "rgb8": images,
        "jpeg": np.stack([simplejpeg.decode_jpeg(data) for data in jpegs]),
        "h264": decoded_by_av(units),
    }
    streams = [
        StreamDescriptor(
            name=f"camera_{unit}",
            kind="image",
            shape=(HEIGHT, WIDTH, 3),
            dtype="uint8",
            unit=unit,
            nominal_rate_hz=30,
        )
        for unit in given
    ]
    attributes = RecordingAttributes(
        recording_id="take-1",
        task="stand_bottle",
        instruction="",
        domain="human",
        station="bench",
        streams=streams,
    )
    t_host_ns = np.arange(COUNT, dtype=np.int64)
    store = EpisodeStore(folder / "store")
    with store.writer(kind="recording", attributes=attributes) as writer:
        for unit, values in given.items():
            writer.append(f"camera_{unit}", values=values, t_host_ns=t_host_ns)
    reader = store.recording("take-1")
    array = zarr.open_array(store.root / "recordings/take-1/camera_rgb8", mode="r")
    np.testing.assert_array_equal(array[:], images)
    for unit, true in expected.items():
        np.testing.assert_array_equal(reader.images(f"camera_{unit}"), true, err_msg=unit)
    difference = expected["h264"].astype(float) - images
    psnr_db = 10 * np.log10(255**2 / np.mean(difference**2))
    assert psnr_db > MIN_PSNR_DB, psnr_db


def golden_digest(folder):
    shutil.copytree(GOLDEN, folder / "golden")
    store, digest = EpisodeStore(folder / "golden"), hashlib.sha256()
    for episode_id in sorted(store.list()):
        item = store.open(episode_id)
        for name in sorted(name for name, stream in item.streams.items() if stream.kind == "image"):
            digest.update(item.images(name).tobytes())
    return digest.hexdigest()


def main():
    for name in sys.argv[1:]:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        check_cameras(Path(folder))
        got = golden_digest(Path(folder))
    assert got == GOLDEN_IMAGES_SHA256, f"golden images: got {got}"
    print(f"av {av.__version__}, zarr {zarr.__version__}, numpy {np.__version__}: images are right")


if __name__ == "__main__":
    main()
