"""`dextouch demo --train`: its commands are ones that the trainers take, in a sound order."""

import pytest

from dextouch.serving import load_settings
from services.pipelines import demo_scoring as scoring
from services.world_model.settings import TrainStateCommand


class LoadedError(Exception):
    """Tells which files would be loaded."""


def load(*paths):
    raise LoadedError(*paths)


def test_a_small_state_model_is_trained_before_its_endings_are_judged(tmp_path, monkeypatch):
    called = []
    for word, (place, name) in {
        "data": (scoring.training_data, "main"),
        "world-model": (scoring, "run_train"),
        "policy": (scoring, "run_train_policy"),
        "imagined": (scoring.imagined_data, "imagined_main"),
        "judge": (scoring, "run_train_judge"),
    }.items():
        monkeypatch.setattr(
            place, name, lambda words, word=word: called.append([word, *words]) or 0
        )
    monkeypatch.setattr(scoring.Models, "load", load)
    with pytest.raises(LoadedError) as caught:
        scoring.train_models(tmp_path)
    world_model, _, probe = caught.value.args
    words = [word for word, *_ in called]
    assert words == ["data"] * 4 + ["world-model", "policy", "imagined", "judge"]
    settings = load_settings(TrainStateCommand, called[words.index("world-model")][1:])
    assert settings.output == world_model
    assert settings.tasks == ("stand_bottle", "stack_bowls")
    assert settings.episodes == (str(tmp_path / "episodes"), str(tmp_path / "endings"))
    assert (settings.num_members, settings.core.num_steps) == (1, 1500)
    imagined, judged = called[words.index("imagined")], called[words.index("judge")]
    assert imagined[imagined.index("--checkpoint") + 1] == str(world_model)
    assert imagined[imagined.index("--store") + 1] in judged
    assert judged[-1] == str(probe)
