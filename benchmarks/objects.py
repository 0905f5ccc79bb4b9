"""The benchmark stage `objects`: poses from markers, clicks and touch, against the twin's."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from scipy.ndimage import gaussian_filter

from benchmarks.figures import at_most
from benchmarks.object_places import ClickErrors, TouchErrors, click_errors, touch_errors
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.geometry import invert, transform, transform_from_pose
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.schemas import SceneObjects
from dextouch.streams import HEAD_CAMERA
from services.alignment.markers import MarkerTracker, cells_of_markers
from services.twin.cameras import Markers, marked_objects
from services.twin.scene import object_boxes_m
from services.twin.settings import TwinSettings
from services.twin.simulation import MODEL_RATE_HZ
from services.twin.stage import Stage, command_row
from services.twin.tasks import EVALUATED, named_tasks

FIRST_SEED = 46_000
AMOUNTS: Final = Amounts(usual={"takes": 4}, quick={"takes": 1})
# Takes without images are cheap: so many for one with them.
TAKES_OF_TOUCH: Final = 8
SIDES_PX: Final = (320, 480)
NUM_STEPS: Final = 81
# Every so many steps of a take an image is taken.
STRIDE: Final = 2
LOOKS: Final = ("sharp", "blurred and noisy")
OURS, USUAL = "all markers, fitted edges", "one marker, refined corners"
_BLUR_PX, _NOISE = 0.7, 4.0
# Of the usual recipe, whose pixel centres are whole numbers.
_PIXEL_SHIFT_PX: Final = 0.5

Images = Sequence[UInt8[np.ndarray, "h w 3"]]
Poses = dict[int, Float64[np.ndarray, "4 4"]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    AMOUNTS.add_options(parser, takes="takes per task")
    tasks = ",".join(EVALUATED)
    parser.add_argument("--tasks", default=tasks, metavar="A,B", help="(%(default)s)")


@dataclass(frozen=True)
class _Take:
    """A take as the head camera saw it, with the true poses."""

    objects: SceneObjects
    K: Float64[np.ndarray, "3 3"]
    images: Images
    Ts_world_camera: Float64[np.ndarray, "images 4 4"]
    Ts_world_object: Float64[np.ndarray, "images objects 4 4"]


@dataclass(frozen=True)
class _Found:
    """Errors of one design on one take: along all axes, along the view, and of the rotation."""

    off_mm: Float64[np.ndarray, " n"]
    depth_mm: Float64[np.ndarray, " n"]
    turned_deg: Float64[np.ndarray, " n"]
    num_possible: int
    each_ms: float


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Track the objects of takes by both designs, alternately, at several sizes of the image."""
    count = AMOUNTS.of(options)["takes"]
    tasks = named_tasks(options.tasks.split(","))
    sides_px = SIDES_PX[:1] if options.quick else SIDES_PX
    found: dict[tuple[int, str, str], list[_Found]] = {}
    with bar("tracking", len(tasks) * count * len(sides_px)) as step:
        for side_px in sides_px:
            for task in tasks:
                stage = _stage(task, side_px)
                for seed in range(FIRST_SEED, FIRST_SEED + count):
                    take = _take(stage, seed)
                    for look in LOOKS:
                        images = _seen(take.images, look, seed)
                        for design, track in DESIGNS.items():
                            key = side_px, look, design
                            found.setdefault(key, []).append(_errors(take, images, track))
                    step(f"{task} {seed}")
    clicked = click_errors(tasks, range(FIRST_SEED, FIRST_SEED + count))
    touched = touch_errors(tasks, range(FIRST_SEED, FIRST_SEED + TAKES_OF_TOUCH * count))
    best, exact, usual = found[sides_px[-1], LOOKS[0], OURS], clicked[480, 0], clicked[480, 3]
    depth_mm = _quantile(_all(best, "depth_mm"))
    return StageReport(
        stage="objects",
        packages=("numpy", "opencv-contrib-python-headless", "mujoco"),
        options={"takes": count, "tasks": ", ".join(tasks)},
        tables=[_table(found), _click_table(clicked), _touch_table(touched)],
        requirements=[
            at_most("median error, sharp (mm)", _quantile(_all(best, "off_mm")), 1.0),
            at_most("95 % error, sharp (mm)", _quantile(_all(best, "off_mm"), 0.95), 5.0),
            at_most("median error along the view, sharp (mm)", abs(depth_mm), 0.5),
            at_most("95 % error of exact clicks (mm)", _quantile(exact.off_mm, 0.95), 1.0),
            at_most("median error of clicks, 3 px of 480 (mm)", _quantile(usual.off_mm), 8.0),
            *(
                at_most(f"median error of touch, {task} {name} (mm)", _quantile(one.off_mm), 12.0)
                for (task, name), one in touched.items()
            ),
        ],
        data={
            f"clicks, {noise_px} px of {side_px}": {
                "off_mm": _quantile(one.off_mm),
                "off_mm_95": _quantile(one.off_mm, 0.95),
                "turned_deg": _quantile(one.turned_deg),
                "turned_deg_95": _quantile(one.turned_deg, 0.95),
            }
            for (side_px, noise_px), one in clicked.items()
        }
        | {
            f"{side_px} px, {look}, {design}": {
                name: _quantile(_all(each, name)) for name in ("off_mm", "depth_mm", "turned_deg")
            }
            for (side_px, look, design), each in found.items()
        },
    )


def _stage(task: str, side_px: int) -> tuple[Stage, SceneObjects]:
    stage = Stage(task, "robot", TwinSettings(image_height_px=side_px, image_width_px=side_px))
    scene = stage.simulation.scene
    boxes_m = object_boxes_m(scene)
    objects = marked_objects(task, scene.object_names, boxes_m, scene.bodies.are_fixed)
    stage.rig.markers = Markers(objects, cells_of_markers(objects))
    return stage, objects


def _take(on: tuple[Stage, SceneObjects], seed: int) -> _Take:
    stage, objects = on
    simulation, plan = stage.simulation, stage.plan(seed)
    stage.start(plan)
    images, cameras, poses = [], [], []
    for row in range(1, NUM_STEPS):
        for _ in simulation.advance(command_row(plan.commands, row)):
            pass
        if row % STRIDE == 0:
            images.append(stage.rig.image(simulation, HEAD_CAMERA))
            cameras.append(stage.rig.pose(simulation, HEAD_CAMERA))
            poses.append(transform_from_pose(simulation.object_poses()))
    return _Take(objects, stage.rig.K[HEAD_CAMERA], images, np.stack(cameras), np.stack(poses))


def _seen(images: Images, look: str, seed: int) -> Images:
    if look == LOOKS[0]:
        return images
    draw = np.random.default_rng(seed)
    blurred = [gaussian_filter(image.astype(float), (_BLUR_PX, _BLUR_PX, 0)) for image in images]
    noisy = [image + draw.normal(scale=_NOISE, size=image.shape) for image in blurred]
    return [image.clip(0, 255).round().astype(np.uint8) for image in noisy]


def _ours(take: _Take, images: Images) -> dict[str, Poses]:
    (listed,) = take.objects.tasks.values()
    tracker = MarkerTracker(listed, take.objects.dictionary, take.K, np.zeros(5))
    period_ns = round(1e9 * STRIDE / MODEL_RATE_HZ)
    for index, image in enumerate(images):
        tracker.add(index * period_ns, image, take.Ts_world_camera[index])
    return {
        name: dict(zip((one.t_ns // period_ns).tolist(), one.Ts_world_object, strict=True))
        for name, one in tracker.tracked().items()
    }


def _usual(take: _Take, images: Images) -> dict[str, Poses]:
    """The recipe of most tutorials: corners refined by gradients, the largest marker, one pose."""
    (listed,) = take.objects.tasks.values()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, take.objects.dictionary))
    detector = cv2.aruco.ArucoDetector(kind, parameters)
    K = take.K.copy()
    K[:2, 2] -= _PIXEL_SHIFT_PX
    found: dict[str, Poses] = {one.name: {} for one in listed}
    for index, image in enumerate(images):
        corners, ids, _ = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        seen = {} if not corners else dict(zip(np.ravel(ids).tolist(), corners, strict=True))
        for one in listed:
            markers = [marker for marker in one.markers if marker.id in seen]
            if not markers:
                continue
            largest = max(markers, key=lambda marker: cv2.contourArea(seen[marker.id]))
            square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
            flat = 0.5 * largest.size_m * square
            _, turn, shift = cv2.solvePnP(
                flat, seen[largest.id].reshape(4, 2), K, np.zeros(5),
                flags=cv2.SOLVEPNP_IPPE_SQUARE,
            )  # fmt: skip
            T = transform(rotation_from_vector(np.ravel(turn)), np.ravel(shift))
            T_object_marker = transform_from_pose(np.array(largest.pose))
            found[one.name][index] = take.Ts_world_camera[index] @ T @ invert(T_object_marker)
    return found


Design = Callable[[_Take, Images], dict[str, Poses]]
DESIGNS: Final[dict[str, Design]] = {OURS: _ours, USUAL: _usual}


def _errors(take: _Take, images: Images, track: Design) -> _Found:
    begun_s = time.perf_counter()
    found = track(take, images)
    each_ms = 1e3 * (time.perf_counter() - begun_s) / len(images)
    (listed,) = take.objects.tasks.values()
    off, depth, turned = [], [], []
    for slot, one in enumerate(listed):
        for index, T in found[one.name].items():
            true = take.Ts_world_object[index, slot]
            way_mm = 1e3 * (T[:3, 3] - true[:3, 3])
            off.append(float(np.linalg.norm(way_mm)))
            depth.append(float(way_mm @ take.Ts_world_camera[index][:3, 2]))
            turned.append(float(np.rad2deg(rotation_angle(T[:3, :3].T @ true[:3, :3]))))
    possible = len(images) * len(listed)
    return _Found(np.array(off), np.array(depth), np.array(turned), possible, each_ms)


def _all(each: Sequence[_Found], name: str) -> Float64[np.ndarray, " n"]:
    """Errors of one kind in all takes."""
    return np.concatenate([getattr(one, name) for one in each])


def _quantile(values: Float64[np.ndarray, " n"], share: float = 0.5) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def _table(found: Mapping[tuple[int, str, str], list[_Found]]) -> ResultTable:
    rows = []
    for (side_px, look, design), each in found.items():
        share = sum(len(one.off_mm) for one in each) / sum(one.num_possible for one in each)
        rows.append(
            (
                f"{side_px} px, {look}",
                design,
                f"{share:.2f}",
                _middle_and_most(_all(each, "off_mm")),
                f"{_quantile(_all(each, 'depth_mm')):+.1f}",
                _middle_and_most(_all(each, "turned_deg")),
                f"{np.median([one.each_ms for one in each]):.1f}",
            )
        )
    columns = ("images", "design", "seen", "error (mm)", "along the view (mm)", "turn (deg)",
               "ms an image")  # fmt: skip
    return ResultTable("Poses of objects from markers; errors: median / 95 %", columns, rows)


def _click_table(clicked: Mapping[tuple[int, int], ClickErrors]) -> ResultTable:
    rows = [
        (
            f"{side_px} px",
            f"{noise_px} px",
            _middle_and_most(one.off_mm),
            _middle_and_most(one.turned_deg),
            f"{_quantile(one.reported_mm):.1f}",
            f"{one.refused:.1%}",
        )
        for (side_px, noise_px), one in clicked.items()
    ]
    columns = ("images", "noise of a click (sd)", "error (mm)", "heading (deg)", "as stated (mm)",
               "refused")  # fmt: skip
    return ResultTable("Poses of objects from clicks; errors: median / 95 %", columns, rows)


def _touch_table(touched: Mapping[tuple[str, str], TouchErrors]) -> ResultTable:
    rows = []
    for (task, name), one in touched.items():
        turned = one.turned_deg
        rows.append(
            (
                f"{task}, {name}",
                f"{one.share:.2f}",
                _middle_and_most(one.off_mm),
                _middle_and_most(one.first_mm),
                _middle_and_most(turned[~np.isnan(turned)]),
                _middle_and_most(one.end_mm),
            )
        )
    columns = ("object", "clear hold", "on the table (mm)", "first contact (mm)", "turn (deg)",
               "at the end (mm)")  # fmt: skip
    return ResultTable("Poses of objects from touch; errors: median / 95 %", columns, rows)


def _middle_and_most(values: Float64[np.ndarray, " n"]) -> str:
    if not len(values):
        return "none"
    return f"{_quantile(values):.1f} / {_quantile(values, 0.95):.1f}"
