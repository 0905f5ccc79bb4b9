"""The tutorial from recordings to a policy score, followed literally."""

import json
import shlex

import pytest

from dextouch.episodes import EpisodeStore
from tests.integration.tutorial_page import TutorialPage, run_command

pytestmark = pytest.mark.slow

PAGE = TutorialPage.read("from_recordings")
# What only a simulation knows.
TRUTH_STREAMS = {"object_poses"}


def test_policies_are_scored_from_recordings_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DEXTOUCH_DATA", raising=False)
    for line in PAGE.commands:
        words = shlex.split(line)
        if words:
            run_command(words)
    takes = EpisodeStore("runs/takes")
    ids = takes.list()
    assert len(ids) == 30
    for episode_id in ids:
        reader = takes.open(episode_id)
        about = reader.attributes
        assert about.origin == "recorded"
        assert (about.seed, about.generator_command, about.event_times_s) == (None, None, {})
        assert not TRUTH_STREAMS & set(reader.streams)
        assert about.success is not None
    scores = json.loads((tmp_path / "runs/scores.json").read_text())
    (trust,) = scores["trust"].values()
    assert trust["takes"] >= 1
    assert {row["policy"] for row in scores["policies"]} == {"cloned", "hold"}
    printed = capsys.readouterr().out
    assert "How far to trust it" in printed
