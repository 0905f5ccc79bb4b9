"""LeRobot data sets of another glove: its taxels go out and come back with their layout."""

import json

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install '.[export]'")

from dextouch.bridges.lerobot import export_dataset, import_dataset
from dextouch.bridges.umi import export_umi
from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from tests.unit.world_model.conftest import make_episode, write_episode
from tests.unit.world_model.test_other_gloves import LAYOUT, small_episode


def test_a_data_set_keeps_the_layout(tmp_path):
    store, back = EpisodeStore(tmp_path / "store"), EpisodeStore(tmp_path / "back")
    write_episode(store, small_episode(0), success=True)
    export_dataset([store.open("toy-0")], tmp_path / "set", repo_id="a/b")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["observation.tactile"]["shape"] == [2, 138]
    (name,) = import_dataset(tmp_path / "set", back).ids
    episode = back.open(name)
    assert episode.tactile_layout == LAYOUT
    np.testing.assert_allclose(
        episode.window(0, 41, cameras=()).tactile_kpa, small_episode(0).tactile_kpa, rtol=1e-6
    )


def test_a_data_set_or_file_of_two_gloves_is_refused(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_episode(store, small_episode(0), success=True)
    write_episode(store, make_episode(1), success=True)
    readers = [store.open("toy-0"), store.open("toy-1")]
    with pytest.raises(InvalidInputError, match=r"got tactile layouts 'small'.*'dextouch_v1'"):
        export_umi(readers, tmp_path / "file.zip")
    with pytest.raises(InvalidInputError, match=r"got tactile layouts 'small'.*'dextouch_v1'"):
        export_dataset(readers, tmp_path / "set", repo_id="a/b")
