"""Pressure of the twin's palm against an elastic foundation (Winkler), the analytic reference.

The reference is a layer of springs of 20 kPa/mm on the palm, pressed by the same rigid shape, in
the same pose, with the same force; each taxel is the mean of 12 × 12 points.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from dextouch.geometry import transform_from_pose
from dextouch.tactile.layout import NUM_TIP_TAXELS, PALM_PITCH_M, PALM_SHAPE, PALM_TAXEL_AREA_M2
from services.twin.scene import compile_scene
from services.twin.simulation import Command, Simulation
from services.twin.tasks.task import PALM_DOWN, flat, relaxed

STIFFNESS_PA_M = 2e7
SUPERSAMPLING = 12
HEIGHT_M = 0.08
PRESSES_M = (0.004, 0.010, 0.020)
MAX_MEAN_L1 = 0.30
MIN_MEAN_IOU = 0.70


@dataclass(frozen=True)
class Shape:
    """A fixed object: its MJCF geom, and its height over the table's plane (-inf: nothing)."""

    geom: str
    height_m: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _sphere(x, y, radius=0.03):
    inside = radius**2 - x**2 - y**2
    return np.where(inside > 0, HEIGHT_M - radius + np.sqrt(np.maximum(inside, 0)), -np.inf)


def _cylinder(x, y, radius=0.028, half=0.03):
    inside = radius**2 - y**2
    top = HEIGHT_M - radius + np.sqrt(np.maximum(inside, 0))
    return np.where((np.abs(x) <= half) & (inside > 0), top, -np.inf)


def _box(x, y, half=(0.02, 0.015)):
    return np.where((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]), HEIGHT_M, -np.inf)


SHAPES = {
    "sphere": Shape(f'type="sphere" size="0.03" pos="0 0 {HEIGHT_M - 0.03}"', _sphere),
    "cylinder": Shape(
        f'type="cylinder" size="0.028 0.03" pos="0 0 {HEIGHT_M - 0.028}" '
        'quat="0.70710678 0 0.70710678 0"',
        _cylinder,
    ),
    "box": Shape(f'type="box" size="0.02 0.015 0.02" pos="0 0 {HEIGHT_M - 0.02}"', _box),
}


def _pressed(shape: Shape, press_m: float) -> tuple[Simulation, np.ndarray]:
    """The right palm pressed down on a shape; the simulation and T_world_wrist."""
    scene = compile_scene(
        "robot",
        objects=f'<body name="shape"><geom class="object" {shape.geom}/></body>',
        object_names=(),
    )
    simulation = Simulation(scene)
    hand = scene.hands[1]

    def command(palm_z_m: float) -> Command:
        T_right = np.eye(4)
        T_right[:3, :3] = PALM_DOWN
        T_right[:3, 3] = np.array([0.0, 0.0, palm_z_m]) - PALM_DOWN @ hand.palm_centre_m
        left = relaxed("left", "robot")
        joints = np.stack([left.joints_rad, flat("robot")])
        return Command(np.stack([left.T_world_wrist, T_right, np.eye(4)]), joints)

    simulation.place(command(HEIGHT_M + 0.01), np.zeros((0, 7)), settle_s=0.0)
    for palm_z_m in (
        np.linspace(HEIGHT_M + 0.008, HEIGHT_M - press_m, 6).tolist() + [HEIGHT_M - press_m] * 8
    ):
        for _ in simulation.advance(command(palm_z_m)):
            pass
    return simulation, transform_from_pose(simulation.wrist_poses()[1])


def _reference_n(shape: Shape, hand, T_world_wrist: np.ndarray, force_n: float) -> np.ndarray:
    """Force on each palm taxel of the elastic foundation, [15, 16]."""
    rows, columns = PALM_SHAPE
    offsets = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    centres = hand.palm_skin_m()
    centres[..., 1] = hand.palm_sign * hand.shape.palm_face_m
    points = np.broadcast_to(
        centres[:, :, None, None], (rows, columns, SUPERSAMPLING, SUPERSAMPLING, 3)
    ).copy()
    points[..., 2] += (offsets * PALM_PITCH_M[0])[:, None]
    points[..., 0] += (offsets * PALM_PITCH_M[1])[None, :]
    world = points @ T_world_wrist[:3, :3].T + T_world_wrist[:3, 3]
    # Palm nearly level: the vertical gap stands for the one along the palm's normal.
    depth = shape.height_m(world[..., 0], world[..., 1]) - world[..., 2]
    area = PALM_TAXEL_AREA_M2 / SUPERSAMPLING**2
    low, high = -0.02, 0.02
    for _ in range(60):
        middle = 0.5 * (low + high)
        total = STIFFNESS_PA_M * area * np.maximum(depth + middle, 0.0).sum()
        low, high = (middle, high) if total < force_n else (low, middle)
    return STIFFNESS_PA_M * area * np.maximum(depth + middle, 0.0).sum(axis=(2, 3))


@pytest.mark.long
def test_palm_pressure_has_the_shape_of_an_elastic_foundation(capsys):
    rows = []
    for name, shape in SHAPES.items():
        for press_m in PRESSES_M:
            simulation, T_world_wrist = _pressed(shape, press_m)
            forces_n = (
                simulation.tactile_kpa[1, NUM_TIP_TAXELS:].astype(np.float64).reshape(PALM_SHAPE)
                * 1000.0
                * PALM_TAXEL_AREA_M2
            )
            force_n = simulation.pad_forces_n[1, 5]
            expected_n = _reference_n(shape, simulation.scene.hands[1], T_world_wrist, force_n)
            threshold = 0.02 * expected_n.max()
            ours, theirs = forces_n > threshold, expected_n > threshold
            rows.append(
                (
                    name,
                    force_n,
                    np.abs(forces_n - expected_n).sum() / force_n,
                    (ours & theirs).sum() / (ours | theirs).sum(),
                    abs(forces_n.sum() / force_n - 1),
                )
            )
    table = np.array([row[1:] for row in rows])
    lines = ["", "shape      force N   rel. L1 (≤ 0.30)   IoU (≥ 0.70)   sum error"]
    lines += [f"{r[0]:9s} {r[1]:8.2f} {r[2]:12.3f} {r[3]:16.3f} {r[4]:14.1e}" for r in rows]
    lines += [f"mean {table[:, 1].mean():25.3f} {table[:, 2].mean():16.3f}", ""]
    with capsys.disabled():
        sys.stdout.write("\n".join(lines))
    assert (table[:, 0] > 1.0).all()
    assert table[:, 3].max() < 1e-6
    assert table[:, 1].mean() <= MAX_MEAN_L1
    assert table[:, 2].mean() >= MIN_MEAN_IOU
