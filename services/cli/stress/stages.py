"""Stages of the stress matrix by name, loaded lazily."""

import importlib
from typing import Final

from dextouch.errors import UnknownNameError
from services.cli.stress.cells import StageCells

STAGES: Final = {
    "geometry": "services.cli.stress.geometry",
    "clocks": "services.cli.stress.clocks",
    "hand-eye": "services.cli.stress.hand_eye",
    "retargeting": "services.cli.stress.retargeting",
    "tactile-calibration": "services.cli.stress.tactile_calibration",
    "resampling": "services.cli.stress.resampling",
    "store": "services.cli.stress.storage",
    "world-model": "services.cli.stress.world_model",
    "state-model": "services.cli.stress.state_model",
    "twin": "services.cli.stress.twin",
    "metrics": "services.cli.stress.metrics",
    "judging": "services.cli.stress.judging",
    "training": "services.cli.stress.training",
}


def load_stage(name: str) -> StageCells:
    """The cells of a stage.

    Raises:
        UnknownNameError: no such stage.
    """
    if name not in STAGES:
        raise UnknownNameError("stage", name, list(STAGES))
    stage = importlib.import_module(STAGES[name]).STAGE
    if not isinstance(stage, StageCells):
        raise UnknownNameError("stage", name, list(STAGES))
    return stage
