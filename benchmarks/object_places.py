"""Errors of object places that clicks and touch give in the twin's takes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import EpisodeGrid, EpisodeStore, PadContacts, clicked_poses, touched_objects
from dextouch.errors import InvalidInputError
from dextouch.geometry import apply, invert, pinhole_matrix, project, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import (
    ClickedAt,
    EpisodeAttributes,
    EpisodeClicks,
    ObjectClick,
    SceneObject,
    SceneObjects,
    StoredAnchor,
    TouchedAt,
    matrix_rows,
)
from dextouch.streams import HEAD_CAMERA, StreamDescriptor
from dextouch.tactile.layout import SIDES
from services.twin.episodes import record, write_episode
from services.twin.scene import object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions

SIDES_PX: Final = (64, 320, 480)
NOISE_PX: Final = (0, 1, 2, 3)
# Standard deviation of a person's click on each axis, in an image of 480 px.
USUAL_NOISE_PX: Final = 3.0
# Shorter ways between two clicks, as shares of the image, say no direction.
_LEAST_WAY: Final = 1.2 / 64
# Of every object of a take.
NUM_DRAWS: Final = 25
# Sides of a box that differ by less look alike: such an object gets one click.
_ALIKE: Final = 0.2
_CENTRED_M: Final = 1e-3
# Second clicks lie this far out on the way to the end of the box.
_SHARE_OUT: Final = 0.8


@dataclass(frozen=True)
class ClickErrors:
    """Errors of positions and headings, and the sd that was stated for each axis of the table.

    `refused` is the share of second clicks that were too near the first.
    """

    off_mm: Float64[np.ndarray, " n"]
    turned_deg: Float64[np.ndarray, " m"]
    reported_mm: Float64[np.ndarray, " n"]
    refused: float


@dataclass(frozen=True)
class _Start:
    """The first step of a take: its objects with their true poses, and the head camera."""

    task: str
    objects: tuple[SceneObject, ...]
    Ts_world_object: Float64[np.ndarray, "objects 4 4"]
    T_world_camera: Float64[np.ndarray, "4 4"]
    focal_of_side: float

    def about(self, side_px: int) -> EpisodeAttributes:
        """An episode with square images of a size."""
        camera = StreamDescriptor(
            name=HEAD_CAMERA, kind="image", shape=(side_px, side_px, 3), dtype="uint8", unit="rgb8",
            nominal_rate_hz=15,
        )  # fmt: skip
        anchor = AnchorPoses(np.eye(4), np.eye(4), self.T_world_camera)
        return EpisodeAttributes(
            episode_id="clicked",
            task=self.task,
            instruction="",
            domain="robot",
            origin="twin",
            anchor=StoredAnchor.from_poses(anchor),
            K_head=matrix_rows(self.camera(side_px)),
            streams=(camera,),
        )

    def camera(self, side_px: int) -> Float64[np.ndarray, "3 3"]:
        """The camera matrix of images of a size."""
        fovy_rad = 2 * np.arctan(0.5 / self.focal_of_side)
        return pinhole_matrix(width_px=side_px, height_px=side_px, fovy_rad=fovy_rad)


def click_errors(tasks: Sequence[str], seeds: Iterable[int]) -> dict[tuple[int, int], ClickErrors]:
    """Errors by side of the image and standard deviation of clicks on each of its axes (px).

    The middle of the top of every object's box is clicked, and a place farther along its longer
    side, with normal noise. Without noise, what is left is the error of the stated heights.
    """
    starts = [start for task in tasks for start in _starts(task, seeds)]
    return {
        (side_px, noise_px): _click_errors(starts, side_px, noise_px)
        for side_px in SIDES_PX
        for noise_px in NOISE_PX
    }


def _starts(task: str, seeds: Iterable[int]) -> list[_Start]:
    stage = Stage(task, "robot", TwinSettings())
    simulation = stage.simulation
    boxes_m = object_boxes_m(simulation.scene)
    starts = []
    for seed in seeds:
        stage.start(stage.plan(seed))
        Ts = transform_from_pose(simulation.object_poses())
        listed = zip(simulation.scene.object_names, boxes_m, Ts, strict=True)
        objects = tuple(described(name, box_m, T) for name, box_m, T in listed)
        K = stage.rig.K[HEAD_CAMERA]
        T_camera = stage.rig.pose(simulation, HEAD_CAMERA)
        starts.append(_Start(task, objects, Ts, T_camera, K[1, 1] / (2 * K[1, 2])))
    return starts


def described(
    name: str, box_m: Float64[np.ndarray, "6"], T: Float64[np.ndarray, "4 4"]
) -> SceneObject:
    """An object as a person would describe it who sees how it stands."""
    up = int(np.argmax(np.abs(T[2, :3])))
    sign = 1.0 if T[2, up] > 0 else -1.0
    others = [axis for axis in range(3) if axis != up]
    ahead = max(others, key=lambda axis: box_m[3 + axis])
    short, long = sorted(box_m[3 + axis] for axis in others)
    is_centred = max(abs(box_m[axis]) for axis in others) < _CENTRED_M
    base_m = T[2, 3] + sign * box_m[up] - box_m[3 + up]
    click = ClickedAt.model_validate(
        {
            "up": ("" if sign > 0 else "-") + "xyz"[up],
            "heading": "xyz"[ahead],
            "symmetric": is_centred and short > (1 - _ALIKE) * long,
            "base_m": round(float(base_m), 3),
        }
    )
    x, y, z, half_x, half_y, half_z = box_m.tolist()
    return SceneObject(name=name, box_m=(x, y, z, half_x, half_y, half_z), click=click)


def _click_errors(starts: Sequence[_Start], side_px: int, noise_px: int) -> ClickErrors:
    draw = np.random.default_rng([side_px, noise_px])
    off, turned, reported, num_refused = [], [], [], 0
    for start in starts:
        about, K = start.about(side_px), start.camera(side_px)
        objects = SceneObjects(tasks={start.task: start.objects})
        for index, (one, true) in enumerate(zip(start.objects, start.Ts_world_object, strict=True)):
            exact_px = _places_px(one, start.T_world_camera, K, true)
            for _ in range(NUM_DRAWS):
                noisy = (exact_px + noise_px * draw.normal(size=(2, 2))).clip(0, side_px)
                clicks = EpisodeClicks(objects={one.name: _click(one, noisy)})
                try:
                    found = clicked_poses(about, objects, clicks)
                except InvalidInputError:
                    num_refused += 1
                    continue
                T = transform_from_pose(found.poses[index])
                off.append(1e3 * float(np.linalg.norm(T[:3, 3] - true[:3, 3])))
                reported.append(1e3 * float(found.sd_m[index]))
                if not one.click.symmetric:
                    axis = "xyz".index(one.click.heading)
                    cosine = float(T[:3, axis] @ true[:3, axis])
                    turned.append(float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))))
    share = num_refused / (num_refused + len(off))
    return ClickErrors(np.array(off), np.array(turned), np.array(reported), share)


def clicked_image(
    take: EpisodeGrid,
    objects: Sequence[SceneObject],
    draw: np.random.Generator,
    noise_px: float = USUAL_NOISE_PX,
) -> EpisodeClicks:
    """Clicks on the first image of a take of the twin, with normal noise (px of 480).

    Objects that lie outside the image, or whose direction cannot be told from it, are hidden.
    """
    Ts = transform_from_pose(take.reader.read("object_poses").values[0])
    side_px = take.image_size_px[0]
    clicks = {}
    for one, T in zip(objects, Ts, strict=True):
        exact_px = _places_px(one, take.anchor.T_world_camera_head, take.K_head, T)
        noisy = exact_px + noise_px * side_px / 480 * draw.normal(size=(2, 2))
        inside = noisy.clip(0, side_px)
        length_px = np.linalg.norm(inside[1] - inside[0])
        is_seen = (noisy[0] >= 0).all() and (noisy[0] <= side_px).all()
        if is_seen and (one.click.symmetric or length_px > _LEAST_WAY * side_px):
            clicks[one.name] = _click(one, inside)
        else:
            clicks[one.name] = ObjectClick(state="hidden")
    return EpisodeClicks(objects=clicks)


def _click(one: SceneObject, places_px: Float64[np.ndarray, "2 2"]) -> ObjectClick:
    point_px, heading_px = ((u, v) for u, v in places_px.tolist())
    return ObjectClick(point_px=point_px, heading_px=None if one.click.symmetric else heading_px)


def _places_px(
    one: SceneObject,
    T_world_camera: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    T: Float64[np.ndarray, "4 4"],
) -> Float64[np.ndarray, "2 2"]:
    """Where the middle of the top of a box is seen, and a place farther along its longer side."""
    box_m = np.array(one.box_m)
    up, ahead = ("xyz".index(name[-1]) for name in (one.click.up, one.click.heading))
    top_m = box_m[:3].copy()
    top_m[up] += box_m[3 + up] * (-1 if one.click.up[0] == "-" else 1)
    farther_m = top_m.copy()
    farther_m[ahead] += _SHARE_OUT * box_m[3 + ahead]
    points_m = apply(invert(T_world_camera) @ T, np.stack([top_m, farther_m]))
    return project(K, points_m)[0]


# How hands hold the objects of each task, as with a ruler (cm) and a protractor (10°).
GRIPS: Final[Mapping[str, Mapping[str, Mapping[str, Any]]]] = {
    "place_phone": {
        "phone": {"hand": "right", "closing_deg": 60},
        "stand": {
            "event": "release", "hand": "right", "point_m": (0.0, 0.04, 0.09), "closing_deg": 170,
        },
        "pad": {"hand": "right", "closing_deg": 60},
    },
    "place_shoes": {
        "shoe_left": {"hand": "left", "point_m": (0.0, -0.04, 0.09), "closing_deg": 0},
        "shoe_right": {"hand": "right", "point_m": (0.0, -0.04, 0.09), "closing_deg": 0},
        "rack": {"event": "release", "point_m": (0.0, -0.04, 0.11), "closing_deg": 0},
    },
    "stack_bowls": {"bowl_moved": {}, "bowl_base": {"event": "release"}},
    "stand_bottle": {"bottle": {"hand": "right", "closing_deg": -150}},
}  # fmt: skip
# What stands still under what is held.
_FIXED: Final = frozenset({"pad"})
# Standard deviation of the demonstrator's error.
_NOISE_M: Final = 0.004


@dataclass(frozen=True)
class TouchErrors:
    """Errors of one object over takes that succeeded: on the table, of its turn, and at the end.

    `first_mm` are those of the usual recipe, whose place is that of the first contact (of the last,
    for what something is put on), and `share` is that of takes with a clear hold.
    """

    off_mm: Float64[np.ndarray, " n"]
    first_mm: Float64[np.ndarray, " n"]
    turned_deg: Float64[np.ndarray, " n"]
    end_mm: Float64[np.ndarray, " n"]
    share: float


def touch_errors(tasks: Sequence[str], seeds: Iterable[int]) -> dict[tuple[str, str], TouchErrors]:
    """Errors by task and object, for those tasks that `GRIPS` describes."""
    found = {}
    for task in (task for task in tasks if task in GRIPS):
        with TemporaryDirectory() as folder:
            takes, objects = _takes(task, seeds, Path(folder))
            listed = objects.tasks[task]
            each = [(take, touched_objects(take, objects)) for take in takes]
            for index, one in enumerate(listed):
                rows = [
                    _touch_errors(take, track.poses[:, index], index, one)
                    for take, track in each
                    if track.known[0, index]
                ]
                columns = np.array(rows, dtype=np.float64).reshape(-1, 4).T
                off_mm, first_mm, turned_deg, end_mm = columns
                share = len(rows) / max(1, len(each))
                found[task, one.name] = TouchErrors(off_mm, first_mm, turned_deg, end_mm, share)
    return found


def _takes(task: str, seeds: Iterable[int], folder: Path) -> tuple[list[EpisodeGrid], SceneObjects]:
    """Takes that succeeded, and their objects as a lab describes them."""
    store, stage = EpisodeStore(folder), Stage(task, "robot", TwinSettings())
    options = TakeOptions(noise_m=_NOISE_M, image_every=40, streams="training")
    names = [write_episode(store, record(stage, seed, options)) for seed in seeds]
    takes = [EpisodeGrid(store.open(name)) for name in names]
    listed = described_objects(takes[0])
    return [take for take in takes if take.success], SceneObjects(tasks={task: listed})


def described_objects(take: EpisodeGrid) -> tuple[SceneObject, ...]:
    """Objects of a take of the twin as a lab describes them."""
    listed = []
    for name, box_m, T in zip(take.object_names, take.boxes_m, _true_poses(take)[0], strict=True):
        touch = TouchedAt.model_validate(GRIPS[take.task][name])
        more = {"touch": touch, "fixed": name in _FIXED}
        listed.append(described(name, box_m, T).model_copy(update=more))
    return tuple(listed)


def _true_poses(take: EpisodeGrid) -> Float64[np.ndarray, "steps objects 4 4"]:
    return transform_from_pose(take.reader.read("object_poses").values)


def _touch_errors(
    take: EpisodeGrid, poses: np.ndarray, index: int, one: SceneObject
) -> tuple[float, float, float, float]:
    """On the table (ours, first contact; mm), of the turn (degrees), and at the end (mm)."""
    true = _true_poses(take)[:, index]
    ours = transform_from_pose(poses.astype(float))
    touch = one.touch or TouchedAt()
    point_m = np.array(touch.point_m or one.box_m[:3])
    turned = rotation_angle(ours[0, :3, :3].T @ true[0, :3, :3])
    if one.click.symmetric:
        turned = np.array(np.nan)
    first_m = _first_contact_m(take, touch) - ours[0, :3, :3] @ point_m
    return (
        1e3 * float(np.linalg.norm(ours[0, :2, 3] - true[0, :2, 3])),
        1e3 * float(np.linalg.norm(first_m[:2] - true[0, :2, 3])),
        float(np.rad2deg(turned)),
        1e3 * float(np.linalg.norm(ours[-1, :3, 3] - true[-1, :3, 3])),
    )


def _first_contact_m(take: EpisodeGrid, touch: TouchedAt) -> Float64[np.ndarray, "3"]:
    """The mean of the pads that touch in the step of the first or last contact, in the world."""
    contacts = PadContacts.of(take)
    used = [side == touch.hand or touch.hand is None for side in SIDES]
    touches = contacts.touches & np.array(used)[:, None]
    steps = np.flatnonzero(touches.any(axis=(1, 2)))
    step = steps[0] if touch.event == "grasp" else steps[-1]
    pads_m = apply(contacts.Ts_world_wrist[step], contacts.pads_m[step])
    return pads_m[touches[step]].mean(axis=0)
