"""`dextouch align retarget`: a four-fingered hand, given in URDF, follows a recorded person."""

import json

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.hands import chain_indices
from dextouch.hands.hand_files import load_hand
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.cli.main import main
from tests.accuracy.test_alignment import truth_streams, write_recording
from tests.unit.alignment.recordings import write_recording as write_robot_recording
from tests.unit.hands.hand_texts import documented_mappings, four_finger_urdf, write_hand


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def retarget(store, tmp_path, item_id):
    model, mapping = write_hand(tmp_path, four_finger_urdf(), documented_mappings()[1])
    files = ["--model", str(model), "--mapping", str(mapping), "--to", str(tmp_path / "out.npz")]
    report = ["--json", str(tmp_path / "out.json"), "--store", str(store.root)]
    return main(["align", "retarget", item_id, *files, *report]), load_hand(model, mapping)


@pytest.mark.long
def test_fingers_point_where_the_persons_do(store, tmp_path, capsys):
    write_recording(store, truth_streams("human"), "human")
    episode = store.open(align_recording(store, "take", AlignmentOptions()).episode_id)
    status, hand = retarget(store, tmp_path, "take")
    assert status == 0
    found = np.load(tmp_path / "out.npz", allow_pickle=False)
    tracked = episode.read("keypoints_right")
    assert found["joint_names"].tolist() == [f"joint_{number}" for number in range(16)]
    assert found["t_ref_ns"].tolist() == tracked.t_ref_ns.tolist()
    joints_rad = found["joints_rad"]
    assert ((joints_rad >= hand.lower_rad) & (joints_rad <= hand.upper_rad)).all()
    # The middle bone of index, middle and ring, PIP to DIP.
    robot = np.diff(hand.chain_points_m(joints_rad)[:, :3], axis=2)[:, :, 1]
    for finger, chain in enumerate(("index", "middle", "ring")):
        nodes = chain_indices(chain)
        human = tracked.values[:, nodes[3]] - tracked.values[:, nodes[2]]
        cosine = (robot[:, finger] * human).sum(axis=1) / (
            np.linalg.norm(robot[:, finger], axis=1) * np.linalg.norm(human, axis=1)
        )
        assert np.rad2deg(np.median(np.arccos(np.clip(cosine, -1, 1)))) < 15
    facts = json.loads((tmp_path / "out.json").read_text())
    assert facts["share_solved"] > 0.9
    assert facts["episode_id"] == episode.attributes.episode_id
    assert "16 joints of the right hand" in capsys.readouterr().out


def test_an_episode_without_a_persons_hand_is_refused(store, tmp_path, capsys):
    write_robot_recording(store, "robot")
    align_recording(store, "robot", AlignmentOptions())
    assert retarget(store, tmp_path, "robot")[0] == 3
    assert "expected an episode of a person" in capsys.readouterr().err
    assert not (tmp_path / "out.npz").exists()
