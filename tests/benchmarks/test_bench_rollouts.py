"""The benchmark of chunks beside echoes, in its shortest form."""

import json
import os
import threading
import time

import pytest

from benchmarks.command import main
from benchmarks.rollouts.ways import processor_s
from dextouch.errors import InvalidInputError


def test_ours_and_the_echo_move_the_same_bytes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.command.refuse_shape_checks", lambda: None)
    path = tmp_path / "report.json"
    short = ["--quick", "--rounds", "1", "--chunks", "5", "--crowd-chunks", "1"]
    assert main(["rollouts", *short, "--json", str(path)]) == 0
    report = json.loads(path.read_text())
    sizes = report["bytes"]
    # 16 images of 64 x 64 px, 16 x 640 taxels in float32 and 16 x 67 numbers in float64.
    everything = 16 * (64 * 64 * 3 + 640 * 4 + 67 * 8)
    for way in ("HTTP", "WebSocket"):
        assert 0 < sizes[f"{way}, 16 raw images"] - everything < 1500
        assert 0 < sizes[f"{way}, last image"] - everything / 16 < 1500
    assert sizes["HTTP, last image as JPEG"] < sizes["HTTP, last image"] / 2
    named = {requirement["what"].split(":")[0] for requirement in report["requirements"]}
    assert {"HTTP, 16 raw images", "kept in Redis"} < named
    assert report["processor_seconds"].keys() == report["seconds"].keys()
    assert all(taken_s > 0 for (taken_s,) in report["processor_seconds"].values())
    assert report["crowds"]["batch device"]["p99_s"] > 0.005 * (0.8 + 0.2 * 2)
    assert "WebSocket, last image" in capsys.readouterr().out


def test_processor_time_is_that_of_all_threads():
    worked, end = threading.Event(), threading.Event()

    def work() -> None:
        sum(range(3_000_000))
        worked.set()
        # The time of a thread that has ended is not known any more.
        end.wait()

    before_s, by_python_s = processor_s(os.getpid()), time.process_time()
    thread = threading.Thread(target=work)
    thread.start()
    worked.wait()
    taken_s, by_python_s = processor_s(os.getpid()) - before_s, time.process_time() - by_python_s
    end.set()
    thread.join()
    assert taken_s == pytest.approx(by_python_s, rel=0.2, abs=0.01)


def test_more_chunks_than_a_rollout_has_are_refused(monkeypatch):
    monkeypatch.setattr("benchmarks.command.refuse_shape_checks", lambda: None)
    with pytest.raises(InvalidInputError, match="901 chunks"):
        main(["rollouts", "--chunks", "901"])
