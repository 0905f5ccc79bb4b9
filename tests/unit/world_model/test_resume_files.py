"""A killed run goes on as if nothing had happened; a run can start from another's checkpoint."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError
from services.networks import optimizer
from services.world_model.checkpoints import read_checkpoint
from services.world_model.training import joint_trainer
from services.world_model.training.distribution import ALONE
from services.world_model.training.joint_trainer import TrainingRun, train, train_on
from services.world_model.training.resume_files import StateFiles, state_path

CHILD = Path(__file__).with_name("killed_training.py")
ROOT = Path(__file__).parents[3]


@pytest.fixture
def settings(train_settings):
    return train_settings.model_copy(
        update={"heldout_percent": 50, "max_steps": 24, "cpu_budget_s": 1e6}
    )


def weights(path):
    return read_checkpoint(path).model.state_dict()


def assert_same_run(report, expected):
    ours, theirs = weights(report.checkpoint), weights(expected.checkpoint)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    losses = [(entry.step, entry.loss_video, entry.loss_tactile) for entry in report.log]
    assert losses == [(e.step, e.loss_video, e.loss_tactile) for e in expected.log]
    assert report.metrics == expected.metrics
    assert not state_path(report.checkpoint).exists()


@pytest.mark.slow
def test_a_killed_run_of_both_domains_goes_on_as_if_nothing_had_happened(
    toy_store, human_store, settings, tmp_path
):
    mixed = {"human": (str(human_store.root),), "human_share": 0.5, "human_episodes": 3}
    settings = settings.model_copy(update=mixed)
    expected = train(settings)
    output = tmp_path / "killed" / "model.safetensors"
    killed = settings.model_copy(update={"output": output, "state_every_s": 0.0, "resume": True})
    (tmp_path / "settings.json").write_text(killed.model_dump_json())
    path = os.pathsep.join([str(ROOT), str(ROOT / "shared")])
    ended = subprocess.run(
        [sys.executable, str(CHILD), str(tmp_path / "settings.json")],
        env={**os.environ, "PYTHONPATH": path},
        check=False,
    )
    assert ended.returncode == -signal.SIGKILL
    assert state_path(output).is_file()
    assert not output.exists()
    steps = []
    report = train(killed, lambda progress: steps.append(progress.step))
    # Nothing before the kill is done again but the step that was not kept.
    assert steps == [20, 24]
    assert_same_run(report, expected)


@pytest.mark.slow
def test_a_run_may_be_killed_at_any_moment(toy_store, settings, tmp_path):
    """Two runs are killed a random while after they began to write states, at every step."""
    expected = train(settings)
    output = tmp_path / "killed" / "model.safetensors"
    kept = settings.model_copy(update={"output": output, "state_every_s": 0.0, "resume": True})
    (tmp_path / "settings.json").write_text(kept.model_dump_json())
    path = os.pathsep.join([str(ROOT), str(ROOT / "shared")])
    command = [sys.executable, str(CHILD), str(tmp_path / "settings.json")]
    rng = np.random.default_rng()
    for _ in range(2):
        begun = state_path(output).stat().st_mtime_ns if state_path(output).exists() else 0
        with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as process:
            while process.poll() is None and (
                not state_path(output).exists() or state_path(output).stat().st_mtime_ns == begun
            ):
                time.sleep(0.005)
            time.sleep(rng.uniform(0.0, 0.3))
            process.kill()
    assert not output.exists()
    assert_same_run(train(kept), expected)


@pytest.mark.slow
def test_windows_that_were_read_ahead_are_read_again(toy_store, settings, tmp_path):
    expected = train(settings.model_copy(update={"streaming": True}))

    class StoppedError(Exception):
        pass

    def stop(progress):
        raise StoppedError

    for workers in (0, 1):
        changes = {"streaming": True, "loader_workers": workers, "state_every_s": 0.0}
        output = tmp_path / f"{workers}.safetensors"
        stopped = settings.model_copy(update={**changes, "output": output})
        with pytest.raises(StoppedError):
            train(stopped, stop)
        assert_same_run(train(stopped.model_copy(update={"resume": True})), expected)


@pytest.mark.long
def test_a_state_of_another_run_is_refused(toy_store, settings, tmp_path):
    path = state_path(settings.output)

    class StoppedError(Exception):
        pass

    def stop(progress):
        raise StoppedError

    kept = settings.model_copy(update={"state_every_s": 0.0})
    with pytest.raises(StoppedError):
        train(kept, stop)
    other = kept.model_copy(update={"resume": True, "seed": 7})
    with pytest.raises(ConflictError, match=r"'seed': 0.*'seed': 7"):
        train(other)
    data = path.read_bytes()
    for damaged in (data[:100], b"", data[: len(data) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(CorruptDataError, match="start over"):
            StateFiles(settings.output, ALONE).read({}, {})


@pytest.mark.long
def test_a_run_can_start_from_a_checkpoint(toy_episodes, toy_episode, settings, tmp_path):
    heldout = [toy_episode(10_000, 25)]
    first = train_on(toy_episodes[:3], heldout, settings.model_copy(update={"max_steps": 2}))
    ancestor = read_checkpoint(first.checkpoint)
    assert ancestor.metadata.initialized_from is None
    changes = {"init": first.checkpoint, "output": tmp_path / "next.safetensors", "max_steps": 1}
    later = settings.model_copy(update=changes)
    run = TrainingRun(toy_episodes[3:], later)
    run.start_from(ancestor)
    for mine in (run.model.state_dict(), run._averages):
        for name, tensor in mine.items():
            assert torch.equal(tensor, ancestor.model.state_dict()[name])
    report = train_on(toy_episodes[3:], heldout, later)
    metadata = read_checkpoint(report.checkpoint).metadata
    assert metadata.initialized_from == first.digest
    assert "--init=model.safetensors" in metadata.command
    assert set(metadata.train_episode_ids) == {e.episode_id for e in toy_episodes}
    assert set(metadata.train_fingerprints) == {e.fingerprint() for e in toy_episodes}
    # Codecs are those of the ancestor, not fitted anew.
    learned = {name for name, _ in ancestor.model.named_parameters()}
    for name, tensor in weights(report.checkpoint).items():
        if name not in learned:
            assert torch.equal(tensor, ancestor.model.state_dict()[name]), name
    with pytest.raises(InvalidInputError, match="has not seen"):
        train_on(toy_episodes[3:], toy_episodes[:1], later)
    wider = later.network.model_copy(update={"video_width": 64})
    with pytest.raises(ConflictError, match=r"video_width.*32, 64"):
        train_on(toy_episodes[3:], heldout, later.model_copy(update={"network": wider}))


@pytest.mark.long
def test_a_state_is_kept_now_and_then(toy_episodes, toy_episode, settings, monkeypatch):
    kept = []
    monkeypatch.setattr(StateFiles, "write", lambda files, state: kept.append(state.facts.step))
    train_on(toy_episodes, [toy_episode(9, 25)], settings.model_copy(update={"max_steps": 3}))
    assert kept == []
    often = settings.model_copy(update={"max_steps": 3, "state_every_s": 0.0})
    train_on(toy_episodes, [toy_episode(9, 25)], often)
    assert kept == [1, 2, 3]


def test_seconds_between_states_count_from_the_end_of_the_last_one(
    toy_episodes, settings, monkeypatch
):
    now_s, kept = [0.0], []
    clock = SimpleNamespace(monotonic=lambda: now_s[0], process_time=lambda: 0.0)
    for module in (optimizer, joint_trainer):
        monkeypatch.setattr(module, "time", clock)

    def learn(run, batch):
        now_s[0] += 1.0
        return 0.0, 0.0

    def write(files, state):
        now_s[0] += 10.0
        kept.append(state.facts.step)

    monkeypatch.setattr(TrainingRun, "learn", learn)
    monkeypatch.setattr(StateFiles, "write", write)
    slow = settings.model_copy(update={"max_steps": 12, "state_every_s": 5.0})
    joint_trainer._run_or_resume(TrainingRun(toy_episodes, slow), None, None, None)
    assert kept == [5, 10]
