"""The command line: train writes a checkpoint and a report, show reads it, nonsense is refused."""

import json

import pytest

from dextouch.errors import InvalidInputError
from services.world_model.checkpoints import write_checkpoint, write_state_checkpoint
from services.world_model.command_line import run_show, run_train
from tests.contracts.test_world import untrained_state_checkpoint


@pytest.mark.long
def test_train_then_show(toy_store, tmp_path, capsys):
    output, report = tmp_path / "m.safetensors", tmp_path / "report.json"
    flags = {
        "episodes": toy_store.root, "output": output, "json": report, "max_steps": 3,
        "heldout_percent": 50, "network.image_px": 32, "network.video_width": 16,
        "network.tactile_width": 16, "network.num_layers": 1, "network.num_heads": 1,
        "network.codec_channels": 8, "windows.fit_windows": 8, "optimizer.batch": 2,
    }  # fmt: skip
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in flags.items()]
    assert run_train(["--preset=tiny", *arguments]) == 0
    written = json.loads(report.read_text())
    assert written["steps"] == 3
    assert "psnr_copy" in written["metrics"]
    assert written["digest"][:16] in capsys.readouterr().out
    assert run_show(["--checkpoint", str(output)]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown[0]["digest"] == written["digest"]
    assert shown[0]["metrics"] == written["metrics"]
    assert "--episodes=store --" in shown[0]["command"]
    assert "--network.video-width=16" in shown[0]["command"]
    assert str(tmp_path) not in json.dumps(shown)
    assert "cut short" not in capsys.readouterr().out
    assert run_train(["--preset=tiny", *arguments, "--wall-budget-s=1e-9"]) == 0
    assert "cut short at step 1 of 3; --resume with a larger limit" in capsys.readouterr().out


def test_nonsense_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="seed"):
        run_train(["--episodes", str(tmp_path), "--seed", "-1"])
    with pytest.raises(SystemExit):
        run_train(["--episodes", str(tmp_path), "--sed", "1"])


def test_show_tells_both_forms_apart(tiny_model, metadata, tmp_path, capsys):
    loaded = untrained_state_checkpoint()
    write_state_checkpoint(
        tmp_path / "b.safetensors", loaded.dynamics, loaded.renderer, loaded.metadata
    )
    write_checkpoint(tmp_path / "a.safetensors", tiny_model, metadata)
    assert run_show(["--checkpoint", str(tmp_path)]) == 0
    paper, state = json.loads(capsys.readouterr().out)
    assert (paper["form"], state["form"]) == ("paper's form", "state model")
    assert state["digest"] == loaded.digest
    assert state["object_names"] == {"stand_bottle": ["bottle"]}
