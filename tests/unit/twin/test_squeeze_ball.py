"""Squeeze Ball: touch rises with compression as the springs say; verdicts on pins set by hand."""

import mujoco
import numpy as np
import pytest

from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, command_row
from services.twin.tasks import get_task

NOTHING = (False, False, False, False)


@pytest.mark.parametrize(
    ("pins_mm", "expected"),
    [
        ((0, 0), NOTHING),
        ((3, 3), (False, True, False, False)),
        # Only one side was pressed.
        ((8, 0), NOTHING),
        ((0, 8), NOTHING),
        ((5, 4), (False, True, False, False)),
        ((5, 5), (False, True, True, True)),
    ],
)
def test_the_verdict_follows_the_pins(hand_made, pins_mm, expected):
    task = get_task("squeeze_ball")
    simulation = hand_made("squeeze_ball", task.place(np.random.default_rng(5)))
    model, data = simulation.scene.model, simulation.data
    for side, depth_mm in zip(("near", "far"), pins_mm, strict=True):
        data.qpos[model.joint(f"pin_{side}_slide").qposadr[0]] = 0.001 * depth_mm
    mujoco.mj_forward(model, data)
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_the_touch_follows_the_springs(domain):
    stage = Stage("squeeze_ball", domain, TwinSettings())
    plan = stage.plan(0)
    stage.start(plan)
    simulation = stage.simulation
    slide = simulation.scene.model.joint("ball_near_slide").qposadr[0]
    depths_m, thumb_n = [], []
    for row in range(1, NUM_GRID_STEPS):
        for _ in simulation.advance(command_row(plan.commands, row)):
            pass
        depths_m.append(simulation.data.qpos[slide])
        thumb_n.append(simulation.pad_forces_n[1, 0])
    assert stage.task.succeeded(simulation)
    # The ball is round again.
    assert abs(depths_m[-1]) < 1e-4
    peak = int(np.argmax(depths_m))
    # Hooke's law with 500 N/m, while the squeeze is held.
    assert thumb_n[peak] == pytest.approx(500 * depths_m[peak], rel=0.25)
    squeezing = np.array(depths_m[: peak + 1])
    rising = np.array(thumb_n[: peak + 1])[squeezing > 0.001]
    assert np.corrcoef(squeezing[squeezing > 0.001], rising)[0, 1] > 0.9


@pytest.mark.long
def test_a_ball_that_is_still_squeezed_is_not_done():
    stage = Stage("squeeze_ball", "robot", TwinSettings())
    # The hand stops while it holds the ball.
    episode = record(stage, 0, TakeOptions(images=(), frozen_from_step=35))
    assert tuple(episode.attributes.event_times_s) == ("touched", "pressed", "squeezed")
    assert episode.attributes.success is False
