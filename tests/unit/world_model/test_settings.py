"""The command that a checkpoint records repeats its training."""

import pytest
import torch

from dextouch.errors import UnknownNameError
from dextouch.serving import load_settings
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.paper_settings import TrainCommand, TrainSettings, command_line
from services.world_model.settings import StateTrainSettings, TrainStateCommand
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


def test_flags_override_a_preset_and_its_base():
    flags = ["--episodes", "store", "--preset", "paper-video-only", "--network.sampling-steps", "3"]
    settings = load_settings(TrainCommand, flags)
    network = settings.network
    # Of its own file, of its base, of the base's base, and of the flag.
    assert (network.use_touch, network.action_conditioning) == (False, "cross_attention")
    assert (network.video_target, network.sampling_steps) == ("plain", 3)
    assert settings.optimizer.touch_loss == "contact_or_changing"
    again = load_settings(TrainCommand, command_line(settings).split()[3:])
    assert again.network == network


def test_a_preset_can_come_from_the_environment(monkeypatch):
    monkeypatch.setenv("DEXTOUCH_WORLD_MODEL_TRAIN_PRESET", "paper")
    assert load_settings(TrainCommand, ["--episodes", "store"]).network.prediction == "velocity"


def test_unknown_presets_name_the_valid_ones():
    with pytest.raises(UnknownNameError, match=r"valid: .*paper-video-only"):
        load_settings(TrainCommand, ["--episodes", "store", "--preset", "papre"])


def test_the_default_preset_is_that_of_no_preset():
    assert load_settings(TrainCommand, ["--episodes", "s"]).network == NetworkConfig()
    assert load_settings(TrainCommand, ["--episodes", "s", "--preset", "tiny"]).network == (
        NetworkConfig()
    )


def test_one_flag_of_a_group_leaves_its_other_defaults():
    drawing = load_settings(TrainStateCommand, ["--episodes", "s", "--drawing.batch", "3"]).drawing
    assert (drawing.batch, drawing.cpu_budget_s) == (3, 400)


@pytest.mark.parametrize(("preset", "billions"), [("100m", 0.1), ("300m", 0.3), ("1b", 1.0)])
def test_presets_have_the_weights_that_their_names_say(preset, billions):
    network = load_settings(TrainCommand, ["--episodes", "s", "--preset", preset]).network
    with torch.device("meta"):
        model = JointWorldModel(network)
    assert sum(one.numel() for one in model.parameters()) / 1e9 == pytest.approx(billions, rel=0.1)
