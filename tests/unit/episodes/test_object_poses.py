"""Poses of objects at the steps of an episode, from streams with and without gaps."""

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore, has_object_poses, object_track
from dextouch.streams import StreamDescriptor
from tests.unit.episodes.conftest import episode_of, grid_ns

IMAGE_NS = grid_ns(30, 41)


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path)


def written(store, streams, names):
    """An episode of 21 steps at 15 Hz with further pose streams: name to times and values."""
    made = episode_of(21)
    for name, (t_ns, values) in streams.items():
        made.descriptors.append(
            StreamDescriptor(
                name=name, kind="pose", shape=values.shape[1:], dtype="float64",
                unit="pose_m_wxyz", nominal_rate_hz=30,
            )
        )  # fmt: skip
        made.stamps_ns[name], made.values[name] = t_ns, values
    return made.write(store, object_names=names)


def poses_at(x_m):
    """Poses at positions along x, not turned."""
    x_m = np.asarray(x_m, dtype=np.float64)
    poses = np.tile([0.0, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0], (len(x_m), 1))
    poses[:, 0] = x_m
    return poses


def track_of(reader):
    return object_track(reader, reader.window(0, reader.num_steps, cameras=()).t_ref_ns)


def test_truth_is_read_as_it_was_written(store):
    truth = np.random.default_rng(0).normal(size=(21, 2, 7))
    truth[..., 3:] /= np.linalg.norm(truth[..., 3:], axis=-1, keepdims=True)
    reader = written(store, {"object_poses": (grid_ns(15, 21), truth)}, ("cup", "lid"))
    track = track_of(reader)
    np.testing.assert_array_equal(track.poses, truth.astype(np.float32))
    assert track.known.all()
    assert track.sources == ("twin", "twin")


def test_steps_lie_between_the_sightings_around_them(store):
    moved_m = np.linspace(0.0, 0.4, 41)
    reader = written(store, {"object_cup": (IMAGE_NS + 10_000_000, poses_at(moved_m))}, ("cup",))
    track = track_of(reader)
    expected = np.interp(grid_ns(15, 21), IMAGE_NS + 10_000_000, moved_m)
    np.testing.assert_allclose(track.poses[:, 0, 0], expected, atol=1e-6)
    # The first step is 10 ms before the first sighting: within a period and a half.
    assert track.known.all()
    assert track.sources == ("tracker",)


def test_a_moved_object_is_unknown_while_nobody_saw_it(store):
    moved_m = np.linspace(0.0, 0.4, 41)
    hidden = (np.arange(41) < 11) | (np.arange(41) > 29)
    streams = {"object_cup": (IMAGE_NS[hidden], poses_at(moved_m[hidden]))}
    track = track_of(written(store, streams, ("cup",)))
    # Images 10 and 30 are steps 5 and 15.
    assert track.known[:, 0].tolist() == [k <= 5 or k >= 15 for k in range(21)]
    np.testing.assert_allclose(track.poses[6:15, 0, 0], moved_m[10], atol=1e-6)


def test_an_object_that_stands_where_it_stood_is_known_in_between(store):
    hidden = (np.arange(41) < 11) | (np.arange(41) > 29)
    x_m = np.where(np.arange(41) < 20, 0.1, 0.11)
    streams = {"object_cup": (IMAGE_NS[hidden], poses_at(x_m[hidden]))}
    assert track_of(written(store, streams, ("cup",))).known.all()


def test_an_object_is_unknown_before_it_was_first_seen_and_after_it_was_last_seen(store):
    part = slice(8, 33)
    streams = {"object_cup": (IMAGE_NS[part], poses_at(np.full(25, 0.1)))}
    known = track_of(written(store, streams, ("cup",))).known[:, 0]
    # Images 8 … 32 are steps 4 … 16; the neighbouring steps are two periods away.
    assert known.tolist() == [4 <= k <= 16 for k in range(21)]


def test_slots_follow_the_names_and_an_unseen_object_is_unknown(store):
    streams = {"object_lid": (IMAGE_NS, poses_at(np.full(41, 0.3)))}
    track = track_of(written(store, streams, ("cup", "lid")))
    assert not track.known[:, 0].any()
    assert track.known[:, 1].all()
    np.testing.assert_allclose(track.poses[:, 1, 0], 0.3)
    assert np.isfinite(track.poses).all()


def test_an_episode_without_objects_has_no_track(store):
    reader = written(store, {}, ())
    assert track_of(reader) is None
    assert not has_object_poses(reader)
