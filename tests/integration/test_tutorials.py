"""The tutorials of docs/tutorials followed literally; add_a_device has its own test."""

import asyncio
import contextlib
import io
import json
import runpy
import shlex
import sys
import threading
import time

import pytest

from dextouch.serving import load_settings
from dextouch.worlds import create_world_app
from services.alignment.retargeting import hand_retargeter
from services.cli import up
from services.twin.settings import TwinServiceSettings
from services.twin.world import twin_worlds
from tests.integration.tutorial_page import TutorialPage, run_command
from tests.unit.worlds.running import served

# Of a machine that is busy with other things.
START_LIMIT_S = 900
READING = TutorialPage.read("read_episodes")


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The folder in which a reader works, and where Python finds the reader's modules."""
    folder = tmp_path_factory.mktemp("lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("DEXTOUCH_DATA", raising=False)
        patch.chdir(folder)
        patch.setattr(sys, "path", [str(folder), *sys.path])
        sys.modules.pop("my_policy", None)
        yield folder
        sys.modules.pop("my_policy", None)


@contextlib.contextmanager
def services_up(words, folder):
    """The addresses of `dextouch up …` while its services run."""
    written, stop = folder / "addresses.json", asyncio.Event()
    settings = load_settings(up.UpSettings, [*words, "--json", str(written)])
    loop = asyncio.new_event_loop()
    running = threading.Thread(target=lambda: loop.run_until_complete(up.run(settings, stop)))
    running.start()
    try:
        deadline_s = time.monotonic() + START_LIMIT_S
        while not (written.exists() and written.read_text().endswith("\n")):
            assert running.is_alive()
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        yield json.loads(written.read_text())
    finally:
        loop.call_soon_threadsafe(stop.set)
        running.join()
        loop.close()


@pytest.mark.slow
def test_a_take_is_recorded_and_aligned(lab, monkeypatch, capsys):
    page = TutorialPage.read("record_and_align")
    page.write_files(lab)
    # Compiled here: a worker of the service does it too, but after everybody else's work. Mocks
    # play in real time, and on a busy machine they have gaps that ordinary limits refuse.
    hand_retargeter.warm_up()
    monkeypatch.setenv("DEXTOUCH_ALIGNMENT_OPTIONS__MAX_GAP_MS", "10000")
    monkeypatch.setenv("DEXTOUCH_DATA", str(lab / "recorded"))
    script = lab / page.command("python ")[1]
    with services_up(page.command("dextouch up ")[2:], lab) as urls:
        text = script.read_text(encoding="utf-8")
        for port, name in ((8083, "acquisition"), (8082, "alignment")):
            assert text.count(f"http://127.0.0.1:{port}") == 1
            text = text.replace(f"http://127.0.0.1:{port}", urls[name])
        script.write_text(text, encoding="utf-8")
        capsys.readouterr()
        runpy.run_path(str(script))
    *streams, aligned = capsys.readouterr().out.splitlines()
    assert aligned == "take-1: done"
    assert {line.split(":")[0] for line in streams} >= {"tactile_left", "wrist_left", "camera_head"}
    run_command(page.command("dextouch store list"))
    kinds = {line.split()[1]: line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert kinds["recording"] == "take-1"
    assert kinds["episode"].startswith("take-1-")
    run_command(page.command("dextouch align report"))
    assert "take-1" in capsys.readouterr().out


@pytest.fixture(scope="module")
def notebook(lab):
    """What the cells about reading print, and the names that they define."""
    run_command(READING.command("dextouch "))
    names = {}
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        for cell in READING.cells[:-1]:
            exec(cell, names)  # noqa: S102 - our own page
    return shown.getvalue(), names


def test_an_episode_is_read(notebook):
    shown, names = notebook
    for output in READING.outputs:
        assert output in shown
    # 80 steps at 15 Hz are 320 samples of a glove at 60 Hz, beside the one at 0; 60 are a second.
    assert "321 samples, of which 60 in the second second" in shown
    assert "tactile_right           321 of (320,)  kPa" in shown
    assert names["tips_kpa"].shape == (321, 5)
    assert names["tips_kpa"].max() > 0


def test_an_episode_is_plotted(notebook, lab, monkeypatch):
    assert READING.command("pip install ") == ["pip", "install", "matplotlib"]
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.setenv("MPLCONFIGDIR", str(lab / "matplotlib"))
    pytest.importorskip("matplotlib")
    _, names = notebook
    exec(READING.cells[-1], names)  # noqa: S102 - our own page
    assert (lab / "episode.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_policy_is_scored(lab, capsys):
    page = TutorialPage.read("score_a_policy")
    page.write_files(lab)
    settings = load_settings(TwinServiceSettings, page.command("dextouch twin serve ")[3:])
    with served(create_world_app(twin_worlds(settings.scene), settings)) as url:
        addresses = {f"http://127.0.0.1:{settings.port}": url}
        run_command(page.command("dextouch evaluate "), addresses)
    assert "mine" in (lab / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    runpy.run_path(page.command("python ")[1])
    assert capsys.readouterr().out == page.outputs[0]
    report = json.loads((lab / "report.json").read_text(encoding="utf-8"))
    assert {row["task"] for row in report["policies"]} == {"stand_bottle"}


@pytest.mark.slow
def test_the_tiny_model_is_trained_and_imagines(lab, capsys):
    page = TutorialPage.read("train_the_tiny_model")
    *making, shown, imagining, listed = map(shlex.split, page.commands)
    for words in making:
        run_command(words)
    assert json.loads((lab / "tiny.json").read_text(encoding="utf-8"))["steps"] == 10
    capsys.readouterr()
    run_command(shown)
    (checkpoint,) = json.loads(capsys.readouterr().out)
    assert checkpoint["file"] == "tiny.safetensors"
    run_command(imagining)
    capsys.readouterr()
    run_command(listed)
    (imagined,) = capsys.readouterr().out.splitlines()
    assert f"imagined-{checkpoint['digest'][:8]}-twin-stand_bottle-robot-001000" in imagined
