"""Objects of takes that a mock station recorded, measured by the markers on them."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, object_track
from dextouch.geometry import interpolate_poses, transform_from_pose
from dextouch.geometry.transforms import bracket
from services.pipelines.mock_takes import device_options, write_by_station
from services.pipelines.training_data import marked_stage
from services.twin.episodes import record
from services.twin.take_options import TakeOptions

pytestmark = pytest.mark.long

LEAN = TakeOptions(images=("camera_head",), image_every=4, streams="training")
TASK, SEED = "stack_bowls", 2


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """The truth of a take and the episode of its recording."""
    stage, objects = marked_stage(TASK, "robot")
    truth = record(stage, SEED, replace(device_options(LEAN), image_every=1))
    store = EpisodeStore(tmp_path_factory.mktemp("station"))
    write_by_station(store, truth, objects, episode_id="one", options=LEAN)
    return truth, store.open("one")


def test_nothing_but_the_outcome_comes_from_the_twin(taken):
    truth, episode = taken
    about = episode.attributes
    assert (about.origin, about.seed, about.generator_command) == ("recorded", None, None)
    assert not about.event_times_s
    assert about.success == truth.attributes.success
    assert "object_poses" not in episode.streams
    assert set(about.object_names) == {"bowl_moved", "bowl_base"}


def test_objects_are_where_the_twin_had_them(taken):
    truth, episode = taken
    window = episode.window(0, episode.num_steps, cameras=())
    track = object_track(episode, window.t_ref_ns)
    true = truth.streams["object_poses"]
    # Clocks of the station are fitted: times of the episode differ from those of the truth by a
    # constant and less than a millisecond.
    origin_ns = _start_ns(truth, window)
    left, weight, _ = bracket(true.t_ref_ns, window.t_ref_ns + origin_ns, max_gap_ns=10**9)
    for index, name in enumerate(episode.attributes.object_names):
        Ts = interpolate_poses(transform_from_pose(true.values[:, index]), left, weight)
        known = track.known[:, index]
        assert known.mean() > 0.6, name
        off_mm = 1e3 * np.linalg.norm(track.poses[known, index, :3] - Ts[known, :3, 3], axis=1)
        # Errors of the head's tracker, of clocks and of the markers; measured 1.1 and 2.3 mm.
        assert np.median(off_mm) < 2.5, name
        assert np.percentile(off_mm, 95) < 6.0, name


def _start_ns(truth, window):
    """Time 0 of the episode on the axis of the truth, from the motion of the wrists."""
    wrist = truth.streams["wrist_right"]
    T = window.anchor.T_world_wrist_right
    near = np.linalg.norm(wrist.values[:50, :3] - T[:3, 3], axis=1)
    return int(wrist.t_ref_ns[int(near.argmin())])
