"""`python -m benchmarks touch`: a few takes of one task go the whole way."""

from contextlib import nullcontext

import pytest

from benchmarks import touch_alone
from benchmarks.command import stage_parser
from dextouch.episodes import EpisodeStore, split_of
from dextouch.errors import ConflictError
from dextouch.schemas import ObjectClicks
from services.world_model.checkpoints import read_state_checkpoint


def options(*arguments):
    parser = stage_parser("touch")
    touch_alone.add_options(parser)
    return parser.parse_args(["--quick", "--tasks", "stand_bottle", "--jobs", "1", *arguments])


def bar(*_):
    return nullcontext(lambda _: None)


@pytest.mark.slow
def test_takes_without_poses_train_a_model_and_are_scored(tmp_path):
    given = options("--takes", "30", "--clicks", "3", "--keep", str(tmp_path))
    report = touch_alone.measure(given, tmp_path, bar)
    ((task, num_takes, *_),) = report.tables[0].rows
    assert task == "stand_bottle"
    assert int(num_takes) >= 3
    lab = EpisodeStore(tmp_path / "lab")
    for name in lab.list():
        about = lab.open(name).attributes
        assert not [one.name for one in about.streams if one.name.startswith("object")]
        assert not about.object_names
        assert not about.event_times_s
    sources = read_state_checkpoint(tmp_path / "model/model.safetensors").metadata.object_sources
    assert {"touch", "none"} < set(sources)
    clicks = ObjectClicks.load(tmp_path / "objects.json").episodes
    assert len(clicks) == 3
    splits = {split_of(lab.open(name).attributes) for name in clicks}
    assert splits <= {"A", "B"}


def test_a_command_that_fails_is_named(tmp_path):
    with pytest.raises(ConflictError, match="recorded failed; its log is in"):
        touch_alone.measure(options("--takes", "0", "--keep", str(tmp_path)), tmp_path, bar)
