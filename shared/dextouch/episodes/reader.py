"""Readers of episodes and recordings: streams by time, and windows on the model grid."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeVar, get_args, overload

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped, UInt8

from dextouch.episodes.format import MALFORMED, STAMPS, stream_content
from dextouch.episodes.groups import GroupReader
from dextouch.episodes.image_codecs import FULL_FORM, ImageForm
from dextouch.episodes.validity import measured_actions, measured_taxels
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.geometry import nearest_index
from dextouch.hands.actions import ACTION_DIM, AnchorPoses, poses_from_actions, reanchor
from dextouch.schemas import ActionKind, EpisodeAttributes, RecordingAttributes, StreamContent
from dextouch.streams import HEAD_CAMERA, SampleBatch, pack, unpack
from dextouch.tactile import MAX_LAYOUT_TEXT
from dextouch.tactile.layout import DEXTOUCH_V1, SIDES, TactileLayout, common_layout

R = TypeVar("R")
# Half a step, for a free-running camera at the model rate, plus some jitter.
OWN_IMAGE_SHARE = 0.6
# Tolerated share of dropped images; images of every second step miss more.
MAX_UNSHOWN_SHARE = 0.05
ACTION_STREAMS: dict[ActionKind, str] = {"measured": "action", "commanded": "action_commanded"}
MAX_CAMERA_THREADS = 8
# Stamps of one instant may differ by rounding.
SAME_INSTANT_NS = 1_000
_IMAGES, _IMAGE_DT = "images/", "image_dt_ns/"
# Type and shape of the fields that are one array each; -1 is the number of steps, -2 of taxels.
_WINDOW_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "tactile_kpa": ("float32", (-1, 2, -2)),
    "tactile_valid": ("bool", (-1, 2)),
    "actions": ("float64", (-1, 67)),
    "t_ref_ns": ("int64", (-1,)),
    "anchor": ("float64", (3, 4, 4)),
}
# These are sent only where something was not measured, or is known.
_RARE_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "K_head": ("float64", (3, 3)),
    "actions_measured": ("bool", (-1, 67)),
    "taxels_measured": ("bool", (2, -2)),
}


@dataclass(frozen=True)
class StreamData:
    """Samples of one stream of an episode on the reference clock."""

    t_ref_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __len__(self) -> int:
        return len(self.t_ref_ns)


@dataclass(frozen=True)
class Window:
    """n consecutive steps of the model grid.

    `images` are the nearest ones (one channel if requested in gray), `image_dt_ns` the image's
    stamp minus the step's. `tactile_kpa` [step, left/right, taxel] is the mean of the samples in
    (t−1, t]; where `tactile_valid` is false there was none, and the row is zero. `actions` are
    relative to the *measured* poses of the first step, whose absolute poses are `anchor`; where
    `actions_measured` is false, alignment interpolated them, or no such part was recorded. Taxels
    that are not `taxels_measured` are zero; `tactile_layout` says where they are. `K_head` is in
    pixels, None if unknown.
    """

    images: dict[str, UInt8[np.ndarray, "n h w c"]]
    image_dt_ns: dict[str, Int64[np.ndarray, " n"]]
    tactile_kpa: Float32[np.ndarray, "n 2 taxels"]
    tactile_valid: Bool[np.ndarray, "n 2"]
    actions: Float64[np.ndarray, "n 67"]
    action_kind: ActionKind
    instruction: str
    t_ref_ns: Int64[np.ndarray, " n"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"] | None
    actions_measured: Bool[np.ndarray, "n 67"]
    taxels_measured: Bool[np.ndarray, "2 taxels"]
    tactile_layout: TactileLayout = DEXTOUCH_V1

    def __len__(self) -> int:
        return len(self.t_ref_ns)


@dataclass(frozen=True)
class NativeWindow:
    """The same time span with every stream at its native rate."""

    streams: dict[str, StreamData]
    start_ns: int
    stop_ns: int
    instruction: str
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"] | None


def step_ranges(
    stamps_ns: np.ndarray, grid_ns: np.ndarray, start: int, stop: int
) -> Int64[np.ndarray, "n 2"]:
    """Sample ranges [low, high) with t−1 < stamp ≤ t for grid steps start … stop-1.

    Step 0 has no predecessor: it takes the first sample of the stream, if that lies within half a
    step of it. A range is empty if there is no sample. Stamps of the samples are strictly
    increasing; `grid_ns` are those of all steps of the episode.
    """
    edges = np.searchsorted(stamps_ns, grid_ns[max(0, start - 1) : stop] + SAME_INSTANT_NS, "right")
    if start > 0:
        return np.stack([edges[:-1], edges[1:]], axis=1).astype(np.int64)
    ranges = np.stack([np.concatenate([[0], edges[:-1]]), edges], axis=1).astype(np.int64)
    half_step_ns = int(grid_ns[1] - grid_ns[0]) // 2 if len(grid_ns) > 1 else SAME_INSTANT_NS
    near = len(stamps_ns) > 0 and abs(int(stamps_ns[0] - grid_ns[0])) <= half_step_ns
    ranges[0] = (0, 1) if near else (0, 0)
    return ranges


def mean_over_ranges(
    values: np.ndarray, ranges: np.ndarray
) -> tuple[Float32[np.ndarray, "n taxels"], Bool[np.ndarray, " n"]]:
    """Means of rows [low, high) in float32, and a mask of non-empty ranges.

    Ranges are [n, 2].
    """
    valid = ranges[:, 1] > ranges[:, 0]
    means = np.zeros((len(ranges), *values.shape[1:]), dtype=np.float32)
    for step, (low, high) in enumerate(ranges.tolist()):
        if high > low:
            # Bit-identical to `mean`, without its overhead.
            means[step] = np.add.reduce(values[low:high], axis=0, dtype=np.float64) / (high - low)
    return means, valid


def encode_window(window: Window) -> bytes:
    """Serialize a window."""
    arrays = {name: getattr(window, name) for name in _WINDOW_ARRAYS}
    arrays["anchor"] = np.stack(window.anchor.as_tuple())
    if window.K_head is not None:
        arrays["K_head"] = window.K_head
    for name in ("actions_measured", "taxels_measured"):
        if not (measured := getattr(window, name)).all():
            arrays[name] = measured
    for camera, images in window.images.items():
        arrays[_IMAGES + camera] = images
        arrays[_IMAGE_DT + camera] = window.image_dt_ns[camera]
    fields: dict[str, object] = {
        "action_kind": window.action_kind,
        "instruction": window.instruction,
    }
    if window.tactile_layout != DEXTOUCH_V1:
        fields["tactile_layout"] = window.tactile_layout.model_dump_json()
    return pack(fields, arrays)


def decode_window(data: bytes, *, max_bytes: int) -> Window:
    """Deserialize and validate a window from an untrusted source; arrays are read-only.

    Raises:
        LimitExceededError: more bytes than allowed.
        InvalidInputError: not a valid window.
    """
    fields, arrays = unpack(data, max_bytes=max_bytes)
    cameras = [name.removeprefix(_IMAGES) for name in arrays if name.startswith(_IMAGES)]
    layout = _layout_of(fields.get("tactile_layout"))
    _check_arrays(arrays, cameras, layout.num_taxels)
    action_kind, instruction = fields.get("action_kind"), fields.get("instruction")
    if action_kind not in get_args(ActionKind) or not isinstance(instruction, str):
        raise InvalidInputError(
            f"window: got action kind {action_kind!r} and instruction {instruction!r}, "
            f"expected one of {get_args(ActionKind)} and a text"
        )
    plain: dict[str, Any] = {name: arrays[name] for name in _WINDOW_ARRAYS}
    plain["anchor"] = AnchorPoses(*arrays["anchor"])
    plain["K_head"] = arrays.get("K_head")
    plain["actions_measured"] = arrays.get(
        "actions_measured", np.ones(plain["actions"].shape, dtype=np.bool_)
    )
    plain["taxels_measured"] = arrays.get(
        "taxels_measured", np.ones(plain["tactile_kpa"].shape[1:], dtype=np.bool_)
    )
    return Window(
        images={camera: arrays[_IMAGES + camera] for camera in cameras},
        image_dt_ns={camera: arrays[_IMAGE_DT + camera] for camera in cameras},
        action_kind=fields["action_kind"],
        instruction=instruction,
        tactile_layout=layout,
        **plain,
    )


def _layout_of(field: object) -> TactileLayout:
    """The layout that a window names; `dextouch_v1` where it names none."""
    if field is None:
        return DEXTOUCH_V1
    if not isinstance(field, str) or len(field) > MAX_LAYOUT_TEXT:
        raise InvalidInputError(
            f"window: 'tactile_layout' is a {type(field).__name__}, expected JSON of at most "
            f"{MAX_LAYOUT_TEXT} letters"
        )
    try:
        return TactileLayout.model_validate_json(field)
    except MALFORMED as error:
        raise InvalidInputError(f"window: 'tactile_layout' is not a layout ({error})") from error


def _check_arrays(arrays: dict[str, np.ndarray], cameras: list[str], num_taxels: int) -> None:
    n = len(arrays["t_ref_ns"]) if "t_ref_ns" in arrays and arrays["t_ref_ns"].ndim else 0
    sizes = {-1: n, -2: num_taxels}
    expected = {
        name: (dtype, tuple(sizes.get(size, size) for size in shape))
        for name, (dtype, shape) in (_WINDOW_ARRAYS | _RARE_ARRAYS).items()
        if name in _WINDOW_ARRAYS or name in arrays
    }
    for camera in cameras:
        # Height and width vary by camera; gray images have one channel.
        shape = arrays[_IMAGES + camera].shape
        channels = 1 if shape[3:] == (1,) else 3
        expected[_IMAGES + camera] = ("uint8", (n, *shape[1:3], channels))
        expected[_IMAGE_DT + camera] = ("int64", (n,))
    got = {name: (array.dtype.name, array.shape) for name, array in arrays.items()}
    for name in sorted(expected.keys() | got.keys()):
        if name not in got or name not in expected or got[name] != expected[name]:
            raise InvalidInputError(
                f"window: array {name!r} is {got.get(name, 'missing')}, "
                f"expected {expected.get(name, 'none')}"
            )


_pools: list[ThreadPoolExecutor] = []
# A forked worker does not inherit its parent's threads, so it must not reuse their pools.
os.register_at_fork(after_in_child=_pools.clear)


def each_camera(work: Callable[[str], R], cameras: Iterable[str]) -> dict[str, R]:
    """Call `work` for every camera in a thread each; a single one in the caller's thread."""
    names = list(cameras)
    if len(names) < 2:
        return {name: work(name) for name in names}
    if not _pools:
        _pools.append(ThreadPoolExecutor(MAX_CAMERA_THREADS, thread_name_prefix="camera"))
    return dict(zip(names, _pools[0].map(work, names), strict=True))


class RecordingReader(GroupReader[RecordingAttributes]):
    """Reader of a recording: raw streams, each with its own device clock."""

    def read(
        self, name: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> SampleBatch:
        """Samples with start_ns ≤ t_host_ns < stop_ns; images come decoded, damaged ones never.

        Raises UnknownNameError without the stream, CorruptDataError for damaged bytes.
        """
        low, high = self._range(name, start_ns, stop_ns)
        kept, values = self._without_damaged(name, low, high)
        t_host_ns, t_device_ns, sequence = (
            self._column(f"{name}_{stamp}")[kept].copy() for stamp in STAMPS["recording"]
        )
        return SampleBatch(t_host_ns, t_device_ns, sequence, values)

    def content(self) -> dict[str, StreamContent]:
        """Number of samples and digest of each stream, as committed; nothing is read for it."""
        found = {}
        for stream in self.attributes.streams:
            names = [stream.name, *(f"{stream.name}_{stamp}" for stamp in STAMPS["recording"])]
            arrays = [self._contents.entries[name] for name in names]
            digests = [array.sha256 for array in arrays]
            found[stream.name] = stream_content(arrays[-1].shape[0], digests)
        return found

    def stamps(self, name: str) -> SampleBatch:
        """All stamps of a stream, without the values (which are [n, 0] here); raises as `read`."""
        t_host_ns = self.stamps_ns(name).copy()
        # Not cached like the first column, since they are read once.
        t_device_ns, sequence = (
            self._contents.shard(f"{name}_{stamp}").read() for stamp in STAMPS["recording"][1:]
        )
        return SampleBatch(t_host_ns, t_device_ns, sequence, np.empty((len(t_host_ns), 0)))


class EpisodeReader(GroupReader[EpisodeAttributes]):
    """Reader of an episode: streams on one reference clock, actions on the model grid."""

    @cached_property
    def tactile_layout(self) -> TactileLayout:
        """Layout of the taxels of both hands; `dextouch_v1` where no stream names another one.

        Raises:
            InvalidInputError: the two hands have different ones.
        """
        named = [self.streams.get(f"tactile_{side}") for side in SIDES]
        layouts = [stream.tactile_layout for stream in named if stream is not None]
        return common_layout(layouts, what=self._what)

    @property
    def measured_taxels(self) -> Bool[np.ndarray, "2 taxels"]:
        """Taxels that were measured; the others, which alignment refused, are zero throughout."""
        return measured_taxels(self.attributes.calibration, self.tactile_layout.num_taxels)

    @property
    def num_steps(self) -> int:
        """Steps of the model grid: the rows of `action`; 0 without that stream."""
        return self.num_samples("action") if "action" in self.streams else 0

    def read(
        self, name: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> StreamData:
        """Samples with start_ns ≤ t_ref_ns < stop_ns; images come decoded, damaged ones never.

        Raises UnknownNameError without the stream, CorruptDataError for damaged bytes.
        """
        low, high = self._range(name, start_ns, stop_ns)
        kept, values = self._without_damaged(name, low, high)
        return StreamData(self.stamps_ns(name)[kept].copy(), values)

    @overload
    def window(
        self,
        start: int,
        num_steps: int = ...,
        *,
        cameras: tuple[str, ...] = ...,
        action_kind: ActionKind = ...,
        grid: Literal[True] = ...,
        form: ImageForm = ...,
    ) -> Window: ...
    @overload
    def window(
        self,
        start: int,
        num_steps: int = ...,
        *,
        cameras: tuple[str, ...] = ...,
        action_kind: ActionKind = ...,
        grid: Literal[False],
        form: ImageForm = ...,
    ) -> NativeWindow: ...
    def window(
        self,
        start: int,
        num_steps: int = 17,
        *,
        cameras: tuple[str, ...] = (HEAD_CAMERA,),
        action_kind: ActionKind = "measured",
        grid: bool = True,
        form: ImageForm = FULL_FORM,
    ) -> Window | NativeWindow:
        """Steps start … start + num_steps − 1, decoding only what they need.

        Args:
            start: first step, 0 … `num_steps` of the episode − 1.
            num_steps: at least 1.
            cameras: image streams to read; the others are not decoded.
            action_kind: measured (reached) or commanded (sent) actions.
            grid: on the model grid; False gives all streams at their own rates, the camera
                streams among them only for `cameras`.
            form: half size or gray images.

        Raises:
            InvalidInputError: steps outside the episode.
            UnknownNameError: a camera or action kind that the episode does not have.
            CorruptDataError: damaged bytes.
        """
        self._check_steps(start, num_steps)
        self._check_cameras(cameras)
        if not grid:
            return self._native_window(start, num_steps, cameras, form)
        steps_ns = self.stamps_ns("action")[start : start + num_steps]
        pictures = each_camera(lambda name: self.nearest_pictures(name, steps_ns, form), cameras)
        tactile_kpa, tactile_valid = self.touch(start, num_steps)
        return Window(
            images={name: images for name, (_, images) in pictures.items()},
            image_dt_ns={
                name: self.stamps_ns(name)[nearest] - steps_ns
                for name, (nearest, _) in pictures.items()
            },
            tactile_kpa=tactile_kpa,
            tactile_valid=tactile_valid,
            actions=self.actions(start, num_steps, kind=action_kind),
            action_kind=action_kind,
            instruction=self.attributes.instruction,
            t_ref_ns=steps_ns.copy(),
            anchor=self.anchor(start),
            K_head=self._K_head(),
            actions_measured=measured_actions(self.attributes, steps_ns, action_kind),
            taxels_measured=self.measured_taxels,
            tactile_layout=self.tactile_layout,
        )

    def _K_head(self) -> Float64[np.ndarray, "3 3"] | None:  # noqa: N802 (K is the camera matrix)
        return None if self.attributes.K_head is None else self.attributes.K_head_matrix()

    def touch(
        self, start: int, num_steps: int
    ) -> tuple[Float32[np.ndarray, "n 2 taxels"], Bool[np.ndarray, "n 2"]]:
        """Mean pressures (kPa) of steps, and where there was a sample; as in `window`."""
        self._check_steps(start, num_steps)
        left, right = (self._tactile(side, start, start + num_steps) for side in SIDES)
        return np.stack([left[0], right[0]], axis=1), np.stack([left[1], right[1]], axis=1)

    def actions(
        self, start: int, num_steps: int, *, kind: ActionKind = "measured"
    ) -> Float64[np.ndarray, "n 67"]:
        """Actions of steps, relative to the measured poses of the first one; as in `window`.

        Raises InvalidInputError for steps outside the episode, UnknownNameError without the action
        kind.
        """
        self._check_steps(start, num_steps)
        if kind not in ACTION_STREAMS:
            raise UnknownNameError("action kind", kind, list(ACTION_STREAMS))
        measured, steps = self._column("action"), slice(start, start + num_steps)
        if kind == "measured":
            return reanchor(measured[steps], 0)
        commanded = self._column(self._stream(ACTION_STREAMS[kind]).name)
        return reanchor(commanded[steps], 0, anchor_action=measured[start])

    def anchor(self, step: int) -> AnchorPoses:
        """Measured poses of left wrist, right wrist and head camera at a step, in the world."""
        measured = self._column("action")[step : step + 1]
        if measured.shape[1:] != (ACTION_DIM,):
            raise InvalidInputError(f"{self._what}: 'action' has rows of {measured.shape[1:]}")
        return poses_from_actions(measured, self.attributes.anchor.to_poses()).anchor(0)

    def _native_window(
        self, start: int, num_steps: int, cameras: tuple[str, ...], form: ImageForm
    ) -> NativeWindow:
        grid_ns = self._column("action_t_ref_ns")
        first_ns, stop_ns = int(grid_ns[start]), int(grid_ns[start + num_steps - 1]) + 1
        ranges = {name: self._range(name, first_ns, stop_ns) for name in cameras}
        pictures = each_camera(
            lambda name: self._without_damaged(name, *ranges[name], form=form), cameras
        )
        data = {
            name: StreamData(self.stamps_ns(name)[kept].copy(), images)
            for name, (kept, images) in pictures.items()
        }
        data |= {
            name: self.read(name, first_ns, stop_ns)
            for name, stream in self.streams.items()
            if stream.kind != "image"
        }
        return NativeWindow(
            streams=data,
            start_ns=first_ns,
            stop_ns=stop_ns,
            instruction=self.attributes.instruction,
            anchor=self.anchor(start),
            K_head=self._K_head(),
        )

    def shown_steps(
        self, camera: str, steps: Int64[np.ndarray, " steps"] | None = None
    ) -> tuple[Int64[np.ndarray, " shown"], Int64[np.ndarray, " shown"]]:
        """Steps that have an image at most 0.6 steps away, and the index of that image.

        Images that cannot be decoded do not count: those that are chosen are decoded once. Steps to
        look at are increasing, None for all. Raises UnknownNameError without the camera,
        NotFoundError if none of its images can be decoded.
        """
        self._check_cameras((camera,))
        stamps, grid_ns = self.stamps_ns(camera), self.stamps_ns("action")
        if not len(stamps):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        chosen = np.arange(len(grid_ns)) if steps is None else steps
        nearest = self.nearest_images(camera, grid_ns[chosen])
        reach_ns = OWN_IMAGE_SHARE * 1e9 / self.attributes.model_rate_hz
        is_near = np.abs(stamps[nearest] - grid_ns[chosen]) <= reach_ns
        return chosen[is_near], nearest[is_near]

    def has_every_image(self, camera: str) -> bool:
        """Whether nearly every step has an image of its own; one in twenty may have been dropped.

        Raises as `shown_steps`.
        """
        num_missing = self.num_steps - len(self.shown_steps(camera)[0])
        return num_missing <= MAX_UNSHOWN_SHARE * self.num_steps

    def require_images(self, camera: str) -> None:
        """Raise InvalidInputError unless the episode `has_every_image` of a camera.

        `window` returns the nearest image whatever its time: where only every N-th step was
        rendered, that is the image of another step.
        """
        if not self.has_every_image(camera):
            num_missing = self.num_steps - len(self.shown_steps(camera)[0])
            raise InvalidInputError(
                f"{self._what}: {num_missing} of {self.num_steps} steps have no image of "
                f"{camera!r} within {OWN_IMAGE_SHARE} steps, expected one a step; record it with "
                "images of every step (`dextouch train data --images 1`)"
            )

    def nearest_pictures(
        self, camera: str, t_ns: np.ndarray, form: ImageForm = FULL_FORM
    ) -> tuple[Int64[np.ndarray, " n"], UInt8[np.ndarray, "n h w c"]]:
        """Indices of the images nearest to non-decreasing times, and these images.

        Raises NotFoundError without an image, or one that can be decoded.
        """
        if not self.num_samples(camera):
            raise NotFoundError(f"{self._what}: {camera!r} holds no image")
        nearest = nearest_index(self.stamps_ns(camera), t_ns)
        try:
            return nearest, self.images_at(camera, nearest, form=form)
        except CorruptDataError:
            # A damaged image is treated as one that was never recorded: its neighbour is nearest.
            nearest = self.nearest_images(camera, t_ns)
            return nearest, self.images_at(camera, nearest, form=form)

    def _check_steps(self, start: int, num_steps: int) -> None:
        if num_steps < 1 or start < 0 or start + num_steps > self.num_steps:
            raise InvalidInputError(
                f"{self._what}: got window of steps {start} … {start + num_steps - 1}, "
                f"expected within its {self.num_steps} steps"
            )

    def _check_cameras(self, cameras: tuple[str, ...]) -> None:
        valid = [name for name, stream in self.streams.items() if stream.kind == "image"]
        for camera in cameras:
            if camera not in valid:
                raise UnknownNameError("camera", camera, valid)

    def _tactile(self, side: str, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        name = f"tactile_{side}"
        if name not in self.streams:
            empty = np.zeros((stop - start, self.tactile_layout.num_taxels), dtype=np.float32)
            return empty, np.zeros(stop - start, dtype=bool)
        stamps, grid_ns = self._column(f"{name}_t_ref_ns"), self._column("action_t_ref_ns")
        ranges = step_ranges(stamps, grid_ns, start, stop)
        low, high = int(ranges[0, 0]), int(max(ranges[0, 0], ranges[-1, 1]))
        return mean_over_ranges(self._values(name, low, high), ranges - low)
