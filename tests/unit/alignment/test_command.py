"""`dextouch align` from the shell: recordings aligned and told, refused with a reason, reported."""

import json
import re
import threading
from functools import partial

import pytest

from dextouch.command_line import ProgressLines
from dextouch.episodes import EpisodeStore
from services.alignment import command_line
from services.cli.main import main
from tests.unit.alignment.recordings import write_recording
from tests.unit.alignment.test_service import FakeWorker
from tests.unit.episodes.hostile_group import stamp_version


@pytest.fixture(autouse=True)
def worker(monkeypatch):
    """The same work in a thread; `test_worker.py` has real processes."""
    go_on = threading.Event()
    go_on.set()
    kind = type("Worker", (FakeWorker,), {"held": go_on})
    monkeypatch.setattr(command_line, "AlignmentWorker", kind)


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_recording(store, "take", seconds=10.0, lost=(("wrist_left", 300, 400),))
    write_recording(store, "other")
    write_recording(store, "handless", streams=("head",))
    return store


def test_recordings_are_aligned_and_told(store, tmp_path, capsys):
    path = tmp_path / "reports.json"
    arguments = ["run", "take", "--store", str(store.root), "--json", str(path)]
    assert main(["align", *arguments]) == 0
    assert "take aligned" in capsys.readouterr().out
    assert json.loads(path.read_text())[0]["created"] is True
    assert main(["align", *arguments]) == 0
    assert "take was aligned already" in capsys.readouterr().out


def test_progress_is_told_where_no_terminal_is(store, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "ProgressLines", partial(ProgressLines, period_s=0.0))
    assert main(["align", "run", "take", "--workers", "1", "--store", str(store.root)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"   align 0 of 1  take \w+.* 25%", lines[0])
    assert len(lines) > 1


def test_a_failure_is_told_and_the_others_are_aligned(store, capsys):
    arguments = ["run", "handless", "take", "--workers", "2", "--store", str(store.root)]
    assert main(["align", *arguments]) == 3
    told = capsys.readouterr()
    assert "take aligned" in told.out
    assert "wrist_left" in told.err


def test_all_aligns_what_has_no_episode(store, capsys):
    assert main(["align", "run", "other", "--store", str(store.root)]) == 0
    capsys.readouterr()
    assert main(["align", "run", "--all", "--store", str(store.root)]) == 3
    told = capsys.readouterr()
    assert "take aligned" in told.out
    assert "other" not in told.out
    assert "handless" in told.err
    store.delete("handless", kind="recording")
    assert main(["align", "run", "--all", "--store", str(store.root)]) == 0
    assert "nothing to do" in capsys.readouterr().out


def test_a_damaged_recording_keeps_no_other_from_being_aligned(store, capsys):
    stamp_version(store, "recording", "take", 1)
    assert main(["align", "run", "--all", "--store", str(store.root)]) == 3
    told = capsys.readouterr()
    assert "other aligned" in told.out
    assert "format version 1, expected 2" in told.err


@pytest.mark.parametrize("which", ["take", "episode"])
def test_report_of_a_recording_or_its_episode(store, tmp_path, capsys, which):
    main(["align", "run", "take", "--store", str(store.root)])
    item_id = "take" if which == "take" else store.list()[0]
    capsys.readouterr()
    path = tmp_path / "report.json"
    arguments = ["report", item_id, "--store", str(store.root), "--json", str(path)]
    assert main(["align", *arguments]) == 0
    page = capsys.readouterr().out
    for word in ("not in the episode", "wrist_left: no samples", "residual", "latency", "dropped"):
        assert word in page
    (report,) = json.loads(path.read_text())
    assert {part["reason"] for part in report["refused_parts"]} == {"gap", "shorter"}
    assert report["recording_id"] == "take"


def test_report_of_what_is_not_aligned(store, capsys):
    assert main(["align", "report", "other", "--store", str(store.root)]) == 3
    assert "`dextouch align run other`" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["run", "--all"], ["run", "take"], ["report", "take"]])
def test_a_store_that_is_not_there_is_not_a_store_where_all_is_done(tmp_path, capsys, arguments):
    missing = tmp_path / "missing"
    assert main(["align", *arguments, "--store", str(missing)]) == 3
    assert f"store {missing}: no such folder" in capsys.readouterr().err
    assert not missing.exists()


@pytest.mark.parametrize(
    "arguments", [["run"], ["run", "take", "--all"], ["report", "nothing"], ["run", "nothing"]]
)
def test_refusals(store, capsys, arguments):
    assert main(["align", *arguments, "--store", str(store.root)]) == 3
    assert capsys.readouterr().err.startswith("dextouch align: ")


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"]])
def test_help_teaches(capsys, arguments):
    with pytest.raises(SystemExit) as stop:
        main(["align", *arguments])
    assert stop.value.code == 0
    assert "dextouch align run --all" in capsys.readouterr().out
