"""One take → LeRobotDataset v3, by its own writer and reader: the rivals of `make bench-lerobot`.

A LeRobotDataset has one rate, that of its images. Streams of other rates are folded into arrays a
row, as its users do: two tactile samples, four of keypoints, three of poses. That drops a tenth
of the 100 Hz poses and every native time stamp, which spares LeRobot bytes, not us.
"""

import ctypes.util
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.store.designs import OpenStore, StoreWindow
from benchmarks.store.workload import (
    CAMERAS,
    IMAGE_RATE_HZ,
    IMAGE_SHAPE,
    NUMERIC_RATES_HZ,
    WINDOW_IMAGES,
    WINDOW_TACTILE,
    Workload,
)

if TYPE_CHECKING:
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

_REPO = "local/bench"
# Four threads a camera is what LeRobot's documentation advises for its image writer.
_IMAGE_WRITER_THREADS = 4 * len(CAMERAS)
_TOLERANCE_S = 1e-4
_SAMPLES_A_ROW = {name: rate // IMAGE_RATE_HZ for name, rate in NUMERIC_RATES_HZ.items()}
_WINDOW_S = [index / IMAGE_RATE_HZ for index in range(WINDOW_IMAGES)]
_WINDOW_NUMBERS = ("tactile_left", "tactile_right", "action")


def image_feature(camera: str) -> str:
    """LeRobot's name of a camera."""
    return f"observation.images.{camera}"


def number_feature(name: str) -> str:
    """LeRobot's name of a numeric stream."""
    return name if name == "action" else f"observation.{name}"


@dataclass(frozen=True)
class LeRobotDesign:
    """LeRobotDataset v3 with one choice of its options.

    Args:
        name: of the design.
        streaming: encode while images come, instead of PNG files that become videos at the end.
        encoder: options of its RGBEncoderConfig; none: its defaults.
        direct: read with its video decoder and its table, past `LeRobotDataset.__getitem__`.
        reads: the design whose files are read; None: its own.
    """

    name: str
    streaming: bool = True
    encoder: dict[str, str | int] = field(default_factory=dict)
    direct: bool = False
    reads: str | None = None

    def missing(self) -> str | None:
        """What its packages need and is not there; None where all is."""
        for package in ("lerobot", "torchcodec", "datasets"):
            if importlib.util.find_spec(package) is None:
                return f"package {package} (make bench-lerobot installs it)"
        if ctypes.util.find_library("avutil") is None:
            return "FFmpeg's libraries for torchcodec (Debian: apt-get install ffmpeg)"
        return None

    def write(self, workload: Workload, folder: Path) -> None:
        """Add the take row by row and save it as the one episode of a dataset."""
        # A queue that stays full for 0.1 s loses images; one that holds the whole take cannot,
        # and the take is written no slower for it.
        mode: dict[str, object] = (
            {"streaming_encoding": True, "encoder_queue_maxsize": workload.num_images + 1}
            if self.streaming
            else {"image_writer_threads": _IMAGE_WRITER_THREADS}
        )
        if self.encoder:
            from lerobot.configs import RGBEncoderConfig

            mode["rgb_encoder"] = RGBEncoderConfig(**self.encoder)
        dataset = _dataset_class().create(
            _REPO, fps=IMAGE_RATE_HZ, features=_features(workload), root=folder, **mode
        )
        for index in range(workload.num_images):
            dataset.add_frame(_row(workload, index))
        dataset.save_episode()
        dataset.finalize()

    def open(self, folder: Path) -> OpenStore:
        """Open the dataset, once a camera so that cameras can be read from threads."""
        return _OpenDirect(folder) if self.direct else _OpenLeRobot(folder)


class _OpenLeRobot(OpenStore):
    """Windows by `LeRobotDataset[index]`, its public way."""

    def __init__(self, folder: Path) -> None:
        self._datasets = {camera: _open(folder, (camera,)) for camera in CAMERAS}
        self._folder = folder
        self._together: dict[tuple[str, ...], LeRobotDataset] = {}

    def window(self, camera: str, start: int) -> StoreWindow:
        return _window(self._datasets[camera][start], camera)

    def windows(self, cameras: Sequence[str], start: int, *, threaded: bool) -> list[StoreWindow]:
        """All cameras in one item, which LeRobot decodes in threads of its own."""
        if not threaded:
            return super().windows(cameras, start, threaded=False)
        names = tuple(cameras)
        if names not in self._together:
            self._together[names] = _open(self._folder, names)
        item = self._together[names][start]
        return [_window(item, camera) for camera in names]


class _OpenDirect(OpenStore):
    """Windows by the functions below `LeRobotDataset`: no other camera, no tensor a row."""

    def __init__(self, folder: Path) -> None:
        dataset = _open(folder, ())
        columns = [number_feature(name) for name in _WINDOW_NUMBERS]
        self._rows = dataset.hf_dataset.with_format("numpy", columns=columns)
        self._videos = {
            camera: folder / dataset.meta.get_video_file_path(0, image_feature(camera))
            for camera in CAMERAS
        }

    def window(self, camera: str, start: int) -> StoreWindow:
        from lerobot.datasets.video_utils import decode_video_frames

        times_s = [(start + index) / IMAGE_RATE_HZ for index in range(WINDOW_IMAGES)]
        images = decode_video_frames(
            self._videos[camera], times_s, _TOLERANCE_S, "torchcodec", return_uint8=True
        )
        rows = self._rows[start : start + WINDOW_IMAGES]
        left, right, actions = (np.asarray(rows[number_feature(name)]) for name in _WINDOW_NUMBERS)
        return StoreWindow(
            images=np.moveaxis(images.numpy(), 1, -1),
            tactile_left=left.reshape(WINDOW_TACTILE, -1),
            tactile_right=right.reshape(WINDOW_TACTILE, -1),
            actions=actions.reshape(WINDOW_IMAGES, -1),
        )


def _dataset_class() -> type["LeRobotDataset"]:
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    torch.set_num_threads(1)
    return LeRobotDataset


def _open(folder: Path, cameras: tuple[str, ...]) -> "LeRobotDataset":
    features = [number_feature(name) for name in _WINDOW_NUMBERS] if cameras else []
    features += [image_feature(camera) for camera in cameras]
    return _dataset_class()(
        _REPO,
        root=folder,
        delta_timestamps=dict.fromkeys(features, _WINDOW_S) if features else None,
        return_uint8=True,
        tolerance_s=_TOLERANCE_S,
    )


def _window(item: "dict[str, torch.Tensor]", camera: str) -> StoreWindow:
    left, right, actions = (item[number_feature(name)].numpy() for name in _WINDOW_NUMBERS)
    return StoreWindow(
        images=np.moveaxis(item[image_feature(camera)].numpy(), 1, -1),
        tactile_left=left.reshape(WINDOW_TACTILE, -1),
        tactile_right=right.reshape(WINDOW_TACTILE, -1),
        actions=actions.reshape(WINDOW_IMAGES, -1),
    )


def _features(workload: Workload) -> dict[str, dict[str, object]]:
    features: dict[str, dict[str, object]] = {
        image_feature(camera): {
            "dtype": "video",
            "shape": IMAGE_SHAPE,
            "names": ["height", "width", "channel"],
        }
        for camera in CAMERAS
    }
    for name, stream in workload.numbers.items():
        folded = () if name == "action" else (_SAMPLES_A_ROW[name],)
        features[number_feature(name)] = {
            "dtype": stream.values.dtype.name,
            "shape": (*folded, *stream.values.shape[1:]),
            "names": None,
        }
    return features


def _row(workload: Workload, index: int) -> dict[str, object]:
    row: dict[str, object] = {
        image_feature(camera): workload.images[camera].values[index] for camera in CAMERAS
    }
    for name, stream in workload.numbers.items():
        count = _SAMPLES_A_ROW[name]
        first = min(index * stream.rate_hz // IMAGE_RATE_HZ, len(stream.values) - count)
        samples = stream.values[first : first + count]
        row[number_feature(name)] = samples[0] if name == "action" else samples
    return {**row, "task": "bench"}


STREAMING, TUNED, DIRECT = "lerobot-streaming", "lerobot-h264", "-direct"
_DESIGNS = (
    LeRobotDesign(STREAMING),
    LeRobotDesign(f"{STREAMING}{DIRECT}", direct=True, reads=STREAMING),
    LeRobotDesign(TUNED, encoder={"vcodec": "h264", "preset": "ultrafast", "crf": 25, "g": 8}),
    LeRobotDesign(f"{TUNED}{DIRECT}", direct=True, reads=TUNED),
    LeRobotDesign("lerobot-default", streaming=False),
)


def lerobot_designs() -> list[LeRobotDesign]:
    """All LeRobot designs; the streaming writer with LeRobot's own defaults is the first."""
    return list(_DESIGNS)
