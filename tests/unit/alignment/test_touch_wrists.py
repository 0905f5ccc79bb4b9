"""Wrists placed by touch: gaps of gloves cost no step, and without gloves one offset remains."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.geometry import invert
from dextouch.hands.actions import poses_from_actions
from services.alignment.jobs import align_recording, episode_id_of
from services.alignment.settings import AlignmentOptions
from tests.accuracy.test_alignment import truth_streams, write_recording

TOUCH = AlignmentOptions(wrist="touch")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    store, streams = EpisodeStore(tmp_path_factory.mktemp("store")), truth_streams("human")

    def lose(recorded, _):
        # 0.13 s of one glove and one second of the other.
        for name, lost in (("tactile_left", slice(100, 108)), ("tactile_right", slice(150, 210))):
            columns = recorded[name][1]
            columns[:] = [np.delete(column, lost, axis=0) for column in columns]

    def miss(recorded, _):
        # Half a second of touch in which a taxel of the little finger is not read.
        raw, columns = recorded["tactile_left"]
        columns[3] = columns[3].astype(np.float32)
        columns[3][85:115, 40] = np.nan
        recorded["tactile_left"] = raw.model_copy(update={"dtype": "float32"}), columns

    gloves = ("tactile_left", "tactile_right")
    write_recording(store, streams, "human", recording_id="whole")
    write_recording(store, streams, "human", recording_id="gaps", edit=lose)
    write_recording(store, streams, "human", recording_id="missing", edit=miss)
    write_recording(store, streams, "human", recording_id="bare", leave_out=gloves)
    return store


def wrists(store, recording_id, options):
    """Left wrist in the world, and joints, at every step."""
    episode = store.open(align_recording(store, recording_id, options).episode_id)
    anchor = episode.attributes.anchor.to_poses()
    reached = poses_from_actions(episode.read("action").values, anchor)
    return reached.Ts_world_wrist_left, reached.joints_left_rad, episode


@pytest.mark.long
def test_gaps_of_gloves_cost_no_step(store):
    whole, _, _ = wrists(store, "whole", TOUCH)
    _, _, tracked = wrists(store, "gaps", AlignmentOptions())
    gaps, _, episode = wrists(store, "gaps", TOUCH)
    assert episode.num_steps == tracked.num_steps == len(gaps)
    assert episode.attributes.quality["retargeting_left_wrist_offset_mm"] > 1
    # A short gap is interpolated.
    assert np.abs(gaps[:80, :3, 3] - whole[:80, :3, 3]).max() < 0.002


@pytest.mark.long
def test_a_missing_taxel_costs_the_force_of_its_own_pad_alone(store):
    whole, q_whole, _ = wrists(store, "whole", TOUCH)
    missing, q_missing, episode = wrists(store, "missing", TOUCH)
    assert episode.attributes.quality["tactile_left_num_incomplete"] == 30
    np.testing.assert_allclose(q_missing[:, :16], q_whole[:, :16], atol=0.01)
    assert np.abs(missing[:, :3, 3] - whole[:, :3, 3]).max() < 0.002


def test_without_gloves_the_wrist_has_one_offset_and_the_fingers_are_as_retargeted(store):
    tracked, q_tracked, _ = wrists(store, "bare", AlignmentOptions())
    moved, q_moved, _ = wrists(store, "bare", TOUCH)
    offset = invert(tracked) @ moved
    np.testing.assert_allclose(
        offset[:, :3, :3], np.tile(np.eye(3), (len(offset), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(offset, np.tile(offset[0], (len(offset), 1, 1)), atol=1e-9)
    assert np.linalg.norm(offset[0, :3, 3]) > 0.001
    np.testing.assert_array_equal(q_moved, q_tracked)


def test_episodes_with_tracked_wrists_keep_their_ids(store):
    recording = store.recording("whole")
    given = '{"model_rate_hz":15.0,"max_gap_ms":50.0,"max_bridged_ms":250.0,"min_num_steps":17}'
    assert AlignmentOptions().model_dump_json() == given
    assert episode_id_of(recording, AlignmentOptions()) != episode_id_of(recording, TOUCH)
    assert AlignmentOptions.model_validate(TOUCH.model_dump()) == TOUCH
