"""The command that a checkpoint records repeats its training."""

import pytest

from dextouch.serving import load_settings
from services.world_model.settings import (
    StateTrainSettings,
    TrainCommand,
    TrainSettings,
    TrainStateCommand,
    command_line,
)
from services.world_model.training.state_trainer import _command


@pytest.mark.parametrize(
    ("kind", "parser", "command", "given"),
    [
        (
            TrainSettings,
            TrainCommand,
            command_line,
            {
                "episodes": "store",
                "streaming": True,
                "max_steps": 3,
                "network": {"use_pose_raster": False, "video_width": 16},
            },
        ),
        (
            StateTrainSettings,
            TrainStateCommand,
            _command,
            {
                "episodes": ["store", "other"],
                "tasks": ["stand_bottle", "insert_peg"],
                "num_members": 3,
                "core": {"num_steps": 7, "weights": {"success": 0.5}},
                "reader": {"bfloat16": False},
            },
        ),
    ],
)
def test_recorded_command_gives_the_same_settings(kind, parser, command, given):
    settings = kind.model_validate(given)
    words = command(settings).split()
    assert words[:2] == ["dextouch", "train"]
    read = load_settings(parser, words[3:])
    assert read.model_dump(include=set(kind.model_fields)) == settings.model_dump()
