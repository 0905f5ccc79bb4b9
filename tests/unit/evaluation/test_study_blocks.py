"""Blocks of a study, as machines of a cluster run them, give the outcomes of the whole study."""

import json
from collections import Counter
from dataclasses import asdict

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.evaluation.scores import RolloutScore
from services.evaluation.studies.results import StudyDefinition, StudyResults, planned_rollouts_of
from services.evaluation.trained_networks import save_checkpoint
from services.pipelines.study import blocks_of, main, run_block
from tests.unit.evaluation import toy
from tests.unit.worlds.running import served

pytestmark = pytest.mark.long

NUM_STARTS = 12


def script():
    scenes = range(2000, 2000 + NUM_STARTS)
    return toy.replay([toy.demonstration(task, seed) for task in toy.TASKS for seed in scenes])


@pytest.fixture
def study_file(tmp_path, probe_checkpoint):
    save_checkpoint(tmp_path / "probe.safetensors", probe_checkpoint)
    worlds = {
        "judge": toy.ToyWorld("judge", judge=True),
        "dream": toy.ToyWorld("dream", judge=False, drift_m=0.01),
    }
    with served(create_world_app(worlds, WorldServiceSettings())) as url:
        path = tmp_path / "study.toml"
        path.write_text(
            f"""
name = "toy"
tasks = ["reach", "reach far"]
first_seed = 2000
num_starts = {NUM_STARTS}
probe = "{tmp_path}/probe.safetensors"
[real]
url = "{url}"
world = "judge"
[imagined.dream]
url = "{url}"
world = "dream"
[policies.still]
builtin = "hold"
[policies.script]
factory = "tests.unit.evaluation.test_study_blocks:script"
"""
        )
        yield path


def test_blocks_give_the_outcomes_of_the_whole_study(tmp_path, study_file):
    assert main(["run", str(study_file), "--folder", str(tmp_path / "whole")]) == 0
    whole = StudyResults.read(tmp_path / "whole")
    definition = StudyDefinition.model_validate(whole.header.definition)
    store = EpisodeStore(tmp_path / "blocks")
    missing = list(planned_rollouts_of(definition))
    blocks = blocks_of(definition, missing, whole.header, store.url)
    # Ten starts and two, of two tasks in two worlds.
    sizes = Counter(len(block.rollouts) for block in blocks)
    assert sizes == {10 * 2: 4, 2 * 2: 4}
    assert Counter(one for block in blocks for one in block.rollouts) == Counter(missing)
    outcomes = [one for block in blocks for one in run_block(block)]
    assert all(isinstance(one, RolloutScore) for one in outcomes)
    expected = {json.dumps(asdict(one)) for one in whole.outcomes.values()}
    assert {json.dumps(asdict(one)) for one in outcomes} == expected
    first = EpisodeStore(tmp_path / "whole/rollouts")
    assert sorted(store.list()) == sorted(first.list())
    # Again, as after a worker that was killed before its answer came: nothing is stored twice.
    assert {json.dumps(asdict(one)) for one in run_block(blocks[-1])} <= expected
    assert sorted(store.list()) == sorted(first.list())


def test_blocks_hold_what_is_missing(tmp_path, study_file):
    main(["run", str(study_file), "--folder", str(tmp_path / "whole")])
    header = StudyResults.read(tmp_path / "whole").header
    definition = StudyDefinition.model_validate(header.definition)
    some = [
        one
        for one in planned_rollouts_of(definition)
        if one.seed in {2003, 2007} and one.world == "dream"
    ]
    blocks = blocks_of(definition, some, header, None)
    assert [len(block.rollouts) for block in blocks] == [4, 4]
    assert {block.definition.seeds for block in blocks} == {range(2003, 2008)}
    assert all(list(block.definition.imagined) == ["dream"] for block in blocks)
