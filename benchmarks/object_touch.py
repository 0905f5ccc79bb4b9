"""Errors of places that touch gives in the twin's takes, beside those of the first contact."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from benchmarks.object_clicks import described
from dextouch.episodes import EpisodeGrid, EpisodeStore, PadContacts, touched_objects
from dextouch.geometry import apply, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import SceneObject, SceneObjects, TouchedAt
from dextouch.tactile.layout import SIDES
from services.twin.episodes import record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import TakeOptions

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
                    _errors(take, track.poses[:, index], index, one)
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


def _errors(
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
