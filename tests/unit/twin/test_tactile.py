"""Amount of touch: what the skin reports is what the contact solver says, and nothing else."""

import mujoco
import numpy as np
import pytest

from dextouch.tactile.layout import DEXTOUCH_V1
from services.twin.scene import compile_scene
from services.twin.simulation import MAX_RELIEF_M, Command, Simulation, elastic_layer
from services.twin.tasks.task import PALM_DOWN, flat, relaxed

BALL = '<body name="ball"><geom class="object" type="sphere" size="0.03" pos="0 0 0.05"/></body>'
PALM_UP = PALM_DOWN @ np.diag([-1.0, -1.0, 1.0])


def _pressed(R_world_wrist, reach_m):
    scene = compile_scene("robot", objects=BALL, object_names=())
    simulation = Simulation(scene)
    palm = scene.hands[1].palm_centre_m
    left = relaxed("left", "robot")

    def command(z_m):
        T_right = np.eye(4)
        T_right[:3, :3] = R_world_wrist
        T_right[:3, 3] = np.array([0.0, 0.0, z_m]) - R_world_wrist @ palm
        joints = np.stack([left.joints_rad, flat("robot")])
        return Command(np.stack([left.T_world_wrist, T_right, np.eye(4)]), joints)

    simulation.place(command(0.082 + reach_m), np.zeros((0, 7)), settle_s=0.0)
    for z_m in np.linspace(0.08 + reach_m, 0.07 + reach_m, 8):
        for _ in simulation.advance(command(z_m)):
            pass
    return simulation


def test_pressures_sum_to_the_contact_force():
    simulation = _pressed(PALM_DOWN, 0.0)
    wrench, force_n = np.zeros(6), 0.0
    for index in range(simulation.data.ncon):
        mujoco.mj_contactForce(simulation.scene.model, simulation.data, index, wrench)
        force_n += wrench[0]
    assert force_n > 1.0
    felt_n = (simulation.tactile_kpa.astype(np.float64) * 1000.0 * DEXTOUCH_V1.areas_m2).sum()
    assert felt_n == pytest.approx(force_n, rel=1e-6)
    assert simulation.pad_forces_n.sum() == pytest.approx(force_n, rel=1e-12)
    assert simulation.pad_forces_n[1, 5] == pytest.approx(force_n, rel=1e-12)
    assert simulation.tactile_kpa.dtype == np.float32


def test_the_back_of_the_hand_feels_nothing():
    simulation = _pressed(PALM_UP, 0.024)
    assert simulation.data.ncon > 0
    assert not simulation.tactile_kpa.any()
    assert not simulation.pad_forces_n.any()


def test_elastic_layer_keeps_the_force_and_narrows_a_deep_print():
    depths = np.array([0.0, 0.001, 0.002, 0.003, 0.004])
    forces = elastic_layer(depths, 1.0, 400.0)
    assert forces.sum() == pytest.approx(1.0)
    assert forces[0] == 0
    assert (np.diff(forces) >= 0).all()
    # Springs of 400 N/m carry 1 N over the deepest taxels alone: Σ (d - c) = 2.5 mm, c = 2 mm cap.
    np.testing.assert_allclose(forces, np.maximum(depths - MAX_RELIEF_M, 0) / 0.003)


def test_elastic_layer_spreads_a_force_that_is_larger_than_the_depths_explain():
    forces = elastic_layer(np.array([0.0, 1e-5, 2e-5]), 5.0, 400.0)
    assert forces[0] == 0
    np.testing.assert_allclose(forces[1:], 2.5, rtol=0.01)
