"""Training of the full architecture by several processes, with every option, is that of one."""

import json
from dataclasses import replace

import pytest
import torch

from dextouch.episodes import EpisodeStore
from services.world_model.checkpoints import read_checkpoint
from services.world_model.paper_settings import LoraSettings, TrainSettings
from services.world_model.training.distribution import Processes
from services.world_model.training.joint_trainer import train
from services.world_model.training.resume_files import StateFiles
from tests.unit.world_model.conftest import write_episode
from tests.unit.world_model.test_distribution import curve_of, run_processes
from tests.unit.world_model.wan.test_end_to_end import settings

__all__ = ["settings"]

LEAN = {"recompute": True, "accumulate": 2}
ADAPTED = {"lora": LoraSettings(rank=4)}


@pytest.fixture
def stored(settings, large_episode, tmp_path):
    """The settings with a store that other processes can read, and more windows a step."""
    store = EpisodeStore(tmp_path / "store")
    for seed in range(4):
        episode = large_episode(seed)
        # One has no wrist camera.
        views = (255 - episode.images,) if seed else ()
        write_episode(store, replace(episode, further=views))
    more = settings.optimizer.model_copy(update={"batch": 8, "warmup_steps": 2})
    return settings.model_copy(
        update={
            "episodes": str(store.root), "heldout_percent": 25, "optimizer": more, "max_steps": 4,
            "state_every_s": 1e6,
        }
    )  # fmt: skip


def assert_near(given, log, expected):
    """Losses and weights, as stored in their precision."""
    # A step logs its losses when it is the last.
    torch.testing.assert_close(
        torch.tensor(log), torch.tensor(curve_of(expected)), rtol=1e-4, atol=1e-4
    )
    ours = read_checkpoint(given.output).model.state_dict()
    for name, weight in read_checkpoint(expected.checkpoint).model.state_dict().items():
        torch.testing.assert_close(ours[name], weight, rtol=1e-4, atol=1e-4, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "changes"),
    [
        (2, {**LEAN, **ADAPTED}),
        (2, {"freeze_video": True, "precision": "bfloat16"}),
        (4, LEAN),
        (4, {**LEAN, **ADAPTED, "replicas": 2}),
        (2, {**LEAN, **ADAPTED, "views": True}),
        (4, {**LEAN, "views": True}),
    ],
    ids=str,
)
def test_several_processes_train_as_one(stored, tmp_path, count, changes):
    changes = dict(changes)
    if changes.pop("precision", None):
        wan = stored.network.wan.model_copy(update={"precision": "bfloat16"})
        stored = stored.model_copy(
            update={"network": stored.network.model_copy(update={"wan": wan})}
        )
    if changes.pop("views", None):
        seeing = stored.network.model_copy(
            update={"further_views": ("camera_wrist_left",), "past_images": 2, "past_stride": 4}
        )
        stored = stored.model_copy(update={"network": seeing})
    one = {key: changes[key] for key in ("lora", "freeze_video") if key in changes}
    expected = train(TrainSettings.model_validate({**stored.model_dump(), **one}))
    output = tmp_path / "several" / "model.safetensors"
    several = stored.model_copy(update={**changes, "output": output})
    done, log = run_processes(several, count=count)
    assert done.returncode == 0, done.stderr
    assert_near(several, log, expected)


@pytest.mark.slow
def test_adapters_survive_a_kill_of_one_process(stored, tmp_path):
    changes = {**LEAN, **ADAPTED, "max_steps": 22}
    expected = train(stored.model_copy(update=changes))
    output = tmp_path / "killed" / "model.safetensors"
    kept = stored.model_copy(
        update={**changes, "output": output, "state_every_s": 0.0, "resume": True}
    )
    done, _ = run_processes(kept, killed_rank=1)
    assert done.returncode != 0
    folder = StateFiles(output, Processes())._folder
    assert json.loads((folder / "newest.json").read_text())["step"] == 19
    # In twice as many, of which each half has a whole copy; they write states, too.
    done, log = run_processes(kept.model_copy(update={"replicas": 2}), count=4)
    assert done.returncode == 0, done.stderr
    assert_near(kept, log, expected)
    assert not folder.exists()
