"""A run of several processes is that of one: same losses, same weights, and it survives a kill."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed
from torch.distributed.device_mesh import init_device_mesh

from dextouch.errors import ConflictError, InvalidInputError
from services.world_model.checkpoints import read_checkpoint
from services.world_model.training.distribution import Processes
from services.world_model.training.joint_dataset import WindowPosition, stack_windows
from services.world_model.training.joint_trainer import TrainingRun, train, train_on
from services.world_model.training.resume_files import StateFiles, state_path
from tests.unit.world_model.conftest import losses

CHILD = Path(__file__).with_name("distributed_training.py")
ROOT = Path(__file__).parents[3]


@pytest.fixture
def settings(train_settings):
    return train_settings.model_copy(
        update={"heldout_percent": 50, "max_steps": 24, "cpu_budget_s": 1e6}
    )


def run_processes(settings, *, count=2, killed_rank=-1):
    """Train under torchrun; its exit status and loss log."""
    settings.output.parent.mkdir(parents=True, exist_ok=True)
    given = settings.output.with_suffix(".settings.json")
    log = settings.output.with_suffix(".log.json")
    given.write_text(settings.model_dump_json())
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += [f"--nproc-per-node={count}", str(CHILD), str(given), str(log), str(killed_rank)]
    path = os.pathsep.join([str(ROOT), str(ROOT / "shared")])
    done = subprocess.run(
        command,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    return done, json.loads(log.read_text()) if log.is_file() else None


def curve_of(report):
    return [(one.step, one.loss_video, one.loss_tactile) for one in report.log]


def assert_near(settings, log, expected):
    """The loss curve and the weights as stored, in half precision, of a run of one process."""
    curves = torch.tensor(log), torch.tensor(curve_of(expected))
    torch.testing.assert_close(*curves, rtol=1e-4, atol=1e-4)
    ours = read_checkpoint(settings.output).model.state_dict()
    theirs = read_checkpoint(expected.checkpoint).model.state_dict()
    for name, weight in theirs.items():
        torch.testing.assert_close(ours[name], weight, rtol=1e-3, atol=1e-4, msg=name)


@pytest.mark.slow
def test_two_processes_train_as_one(toy_store, settings, tmp_path):
    expected = train(settings)
    shared = settings.model_copy(update={"output": tmp_path / "two" / "model.safetensors"})
    done, log = run_processes(shared)
    assert done.returncode == 0, done.stderr
    assert_near(shared, log, expected)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 4])
def test_after_a_kill_any_number_of_processes_goes_on(toy_store, settings, tmp_path, count):
    expected = train(settings)
    output = tmp_path / "killed" / "model.safetensors"
    kept = settings.model_copy(update={"output": output, "state_every_s": 0.0, "resume": True})
    done, log = run_processes(kept, killed_rank=1)
    assert done.returncode != 0
    assert log is None
    assert not output.exists()
    folder = StateFiles(output, Processes())._folder
    assert json.loads((folder / "newest.json").read_text())["step"] == 19
    assert not list(folder.rglob("*.metadata"))
    # One process alone, without torchrun, does not start over in silence.
    with pytest.raises(ConflictError, match="torchrun"):
        train(kept)
    done, log = run_processes(kept, count=count)
    assert done.returncode == 0, done.stderr
    assert_near(kept, log, expected)
    assert not folder.exists()
    assert not state_path(output).exists()


@pytest.fixture
def sharded():
    """A process group of this process alone, as torchrun would join one."""
    distributed.init_process_group("gloo", store=distributed.HashStore(), rank=0, world_size=1)
    yield Processes(0, 1, init_device_mesh("cpu", (1,)))
    distributed.destroy_process_group()


@pytest.mark.filterwarnings("ignore:FSDP2-wrapped module")
@pytest.mark.parametrize("self_forcing", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_sharded_training_is_resumed_and_equals_plain_training(
    toy_episodes, toy_episode, settings, sharded, self_forcing
):
    class StoppedError(Exception):
        pass

    def stop(_):
        raise StoppedError

    heldout, short = (
        [toy_episode(10_000, 25)],
        settings.model_copy(update={"max_steps": 3, "self_forcing": self_forcing}),
    )
    expected = train_on(toy_episodes, heldout, short)
    kept = short.model_copy(
        update={
            "output": settings.output.parent / "kept" / "model.safetensors",
            "state_every_s": 0.0,
            "resume": True,
        }
    )
    with pytest.raises(StoppedError):
        train_on(toy_episodes, heldout, kept, stop, sharded)
    folder = StateFiles(kept.output, sharded)._folder
    assert json.loads((folder / "newest.json").read_text())["step"] == 2
    assert {path.suffix for path in folder.rglob("*") if path.is_file()} == {
        ".json", ".safetensors",
    }  # fmt: skip
    # Without torchrun it does not start over in silence, nor do other settings resume it.
    with pytest.raises(ConflictError, match="torchrun"):
        train_on(toy_episodes, heldout, kept)
    changed = kept.model_copy(update={"seed": 7})
    with pytest.raises(ConflictError, match="'seed': 0"):
        train_on(toy_episodes, heldout, changed, processes=sharded)
    report = train_on(toy_episodes, heldout, kept, processes=sharded)
    assert_near(kept, curve_of(report), expected)
    assert not folder.exists()


def test_losses_of_the_parts_have_that_of_the_batch_as_their_mean(toy_episodes, tiny_model):
    windows = [episode.cut(WindowPosition(0, 3, 9)) for episode in toy_episodes[:4]]

    def found(processes):
        batch = stack_windows(processes.own(windows))
        generator = torch.Generator().manual_seed(5)
        loss = losses(tiny_model, batch, generator=generator, processes=processes)
        return torch.stack([loss.video, loss.tactile])

    parts = torch.stack([found(Processes(rank, 2)) for rank in range(2)])
    torch.testing.assert_close(parts.mean(0), found(Processes()))
    assert (parts[0] - parts[1]).abs().max() > 1e-3


def test_each_process_has_its_own_windows_and_noise(toy_episodes, settings):
    runs = [TrainingRun(toy_episodes, settings, Processes(rank, 2)) for rank in range(2)]
    alone = TrainingRun(toy_episodes, settings)
    parts = [next(run._noted_places()) for run in runs]
    assert [place for pair in zip(*parts, strict=True) for place in pair] == next(
        alone._noted_places()
    )
    noises = [
        Processes(rank, 2).randn([2, 3], torch.Generator().manual_seed(4)) for rank in range(2)
    ]
    whole = torch.randn(4, 3, generator=torch.Generator().manual_seed(4))
    assert torch.equal(torch.stack(noises, dim=1).flatten(0, 1), whole)


def test_a_batch_that_cannot_be_divided_is_refused(toy_episodes, settings):
    with pytest.raises(InvalidInputError, match="4 windows for 3 processes"):
        TrainingRun(toy_episodes, settings, Processes(0, 3))
