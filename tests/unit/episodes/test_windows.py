"""Windows on the model grid against the plain computation from the arrays they were made of."""

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st

from dextouch.episodes import mean_over_ranges, step_ranges
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import nearest_index
from dextouch.hands import actions as act


@pytest.mark.parametrize("start", [0, 1, 4])
def test_window_equals_the_plain_way(made, store, start):
    window = made.write(store).window(start)
    grid_ns = made.stamps_ns["action"]
    np.testing.assert_array_equal(window.t_ref_ns, grid_ns[start : start + 17])
    expected = act.actions_from_poses(made.trajectory, made.trajectory.anchor(start))
    np.testing.assert_allclose(window.actions, expected[start : start + 17], atol=1e-9)
    np.testing.assert_allclose(
        window.anchor.T_world_camera_head,
        made.trajectory.Ts_world_camera_head[start],
        atol=1e-9,
    )
    for row in range(17):
        step = start + row
        for hand, side in enumerate(("left", "right")):
            values = made.values[f"tactile_{side}"]
            last = 4 * step + 1
            plain = values[0] if step == 0 else values[last - 4 : last].mean(axis=0)
            np.testing.assert_allclose(window.tactile_kpa[row, hand], plain, rtol=1e-6)
        np.testing.assert_array_equal(
            window.images["camera_head"][row], made.values["camera_head"][2 * step]
        )
    assert window.tactile_valid.all()
    assert set(window.images) == {"camera_head"}
    assert (window.image_dt_ns["camera_head"] == 0).all()
    assert window.K_head[0, 0] == 60.0
    assert len(window) == 17


def shown_by(make_episode, store, keep, *, late_ns=0):
    """A reader of 41 steps whose 81 images at 30 Hz are those of `keep`, each so late."""
    made = make_episode(41)
    made.values["camera_head"] = made.values["camera_head"][keep]
    made.stamps_ns["camera_head"] = made.stamps_ns["camera_head"][keep] + late_ns
    return made.write(store)


@pytest.mark.parametrize(("every", "shown"), [(1, 41), (2, 41), (4, 21), (8, 11)])
def test_a_step_has_its_own_image_or_none(make_episode, store, every, shown):
    reader = shown_by(make_episode, store, slice(None, None, every))
    steps, images = reader.shown_steps("camera_head")
    assert len(steps) == shown
    # 30 Hz: image 2n is that of step n; `every` of them lie between two that were kept.
    np.testing.assert_array_equal(images * every, 2 * steps)
    if shown == 41:
        reader.require_images("camera_head")
        return
    with pytest.raises(InvalidInputError, match=f"{41 - shown} of 41 steps have no image"):
        reader.require_images("camera_head")


def test_a_camera_may_run_on_its_own_and_drop_an_image_or_two(make_episode, store):
    late = shown_by(make_episode, store, slice(None, None, 2), late_ns=33_000_000)
    late.require_images("camera_head")
    assert len(late.shown_steps("camera_head")[0]) == 41
    # 60 ms late, the image of the step before is the nearer one, but for step 0.
    later = make_episode(41, seed=4)
    later.stamps_ns["camera_head"] = later.stamps_ns["camera_head"][::2] + 60_000_000
    later.values["camera_head"] = later.values["camera_head"][::2]
    reader = later.write(store, episode_id="later")
    steps, images = reader.shown_steps("camera_head")
    np.testing.assert_array_equal(steps, np.arange(1, 41))
    np.testing.assert_array_equal(images, steps - 1)
    dropping = make_episode(41, seed=5)
    keep = np.delete(np.arange(0, 81, 2), [7, 30])
    dropping.stamps_ns["camera_head"] = dropping.stamps_ns["camera_head"][keep]
    dropping.values["camera_head"] = dropping.values["camera_head"][keep]
    reader = dropping.write(store, episode_id="dropping")
    assert sorted(set(range(41)) - set(reader.shown_steps("camera_head")[0])) == [7, 30]
    reader.require_images("camera_head")


def test_unknown_cameras_show_nothing(made, store):
    reader = made.write(store)
    for ask in (reader.shown_steps, reader.require_images):
        with pytest.raises(UnknownNameError, match="camera_head"):
            ask("tactile_left")


def test_commanded_actions_refer_to_the_measured_pose(made, store):
    window = made.write(store).window(3, 5, action_kind="commanded")
    poses = act.poses_from_actions(made.values["action_commanded"], made.trajectory.anchor(0))
    expected = act.actions_from_poses(poses, made.trajectory.anchor(3))
    np.testing.assert_allclose(window.actions, expected[3:8], atol=1e-9)
    assert abs(window.actions[0, :3]).max() > 1e-3


def test_jpeg_images_are_near_and_only_asked_ones_are_decoded(make_episode, store, monkeypatch):
    made = make_episode(camera_unit="jpeg")
    reader = made.write(store)
    decoded = []
    real = simplejpeg.decode_jpeg
    monkeypatch.setattr(
        simplejpeg, "decode_jpeg", lambda *args, **kw: decoded.append(args) or real(*args, **kw)
    )
    window = reader.window(2, 5)
    assert len(decoded) == 5
    error = window.images["camera_head"].astype(int) - made.values["camera_head"][4:14:2]
    assert abs(error).mean() < 2
    reader.verify()


def test_lost_tactile_samples_are_flagged(made, store):
    keep = np.ones(len(made.stamps_ns["tactile_left"]), dtype=bool)
    keep[[0, 9, 10, 11, 12, 14]] = False
    made.stamps_ns["tactile_left"] = made.stamps_ns["tactile_left"][keep]
    made.values["tactile_left"] = made.values["tactile_left"][keep]
    window = made.write(store).window(0)
    assert window.tactile_valid[:, 0].tolist() == [True, True, True, False] + [True] * 13
    assert (window.tactile_kpa[3, 0] == 0).all()
    np.testing.assert_allclose(
        window.tactile_kpa[4, 0], made.values["tactile_left"][[8, 9, 10]].mean(axis=0), rtol=1e-6
    )


def test_native_rates(made, store):
    window = made.write(store).window(3, 5, grid=False)
    assert len(window.streams["tactile_left"]) == 17
    assert len(window.streams["camera_head"]) == 9
    assert "camera_wrist_left" not in window.streams


@pytest.mark.parametrize(("start", "num_steps"), [(-1, 5), (5, 17), (0, 0), (30, 1)])
def test_steps_outside_are_refused(made, store, start, num_steps):
    with pytest.raises(InvalidInputError, match="within its 21 steps"):
        made.write(store).window(start, num_steps)


def test_unknown_names_are_refused(made, store):
    reader = made.write(store)
    with pytest.raises(UnknownNameError, match="camera_head"):
        reader.window(0, cameras=("camera_left",))
    with pytest.raises(UnknownNameError, match="tactile_left"):
        reader.read("tactile")


@given(
    stamps=st.lists(st.integers(0, 1000), min_size=1, max_size=20, unique=True).map(sorted),
    t=st.lists(st.integers(-100, 1100), max_size=10),
)
def test_nearest_is_nearest(stamps, t):
    stamps, t = np.array(stamps), np.array(t, dtype=np.int64)
    got = nearest_index(stamps, t)
    for index, time in zip(got, t, strict=True):
        assert abs(stamps[index] - time) == abs(stamps - time).min()


def test_of_two_equally_near_stamps_the_earlier_counts():
    got = nearest_index(np.array([10, 20, 30]), np.array([15, 25, 14, 26, 0, 99]))
    assert got.tolist() == [0, 1, 0, 2, 0, 2]


# Samples near any step, a few microseconds to either side, and anywhere between.
STEP_NS = 66_666_667
SOME_STAMPS = st.lists(
    st.integers(-50_000_000, 900_000_000)
    | st.builds(
        lambda step, off_ns: step * STEP_NS + off_ns, st.integers(0, 13), st.integers(-2000, 2000)
    ),
    max_size=40,
    unique=True,
).map(sorted)


def steps_of(stamp_ns, grid_ns):
    """The step whose (t-1, t] holds a stamp: one within 1 µs of a step counts as that step."""
    for step, t_ns in enumerate(grid_ns.tolist()):
        if abs(stamp_ns - t_ns) <= 1_000:
            return step
        if stamp_ns < t_ns:
            return step
    return len(grid_ns)


@given(stamps=SOME_STAMPS, start=st.integers(0, 8), count=st.integers(1, 5))
def test_ranges_tile_the_time_and_windows_agree(stamps, start, count):
    stamps_ns = np.array(stamps, dtype=np.int64)
    grid_ns = np.arange(14, dtype=np.int64) * STEP_NS
    whole = step_ranges(stamps_ns, grid_ns, 0, 14)
    part = step_ranges(stamps_ns, grid_ns, start, start + count)
    np.testing.assert_array_equal(part, whole[start : start + count])
    steps = [steps_of(stamp, grid_ns) for stamp in stamps]
    for step in range(1, 14):
        low, high = whole[step]
        assert [i for i, at in enumerate(steps) if at == step] == list(range(low, high))


def test_samples_within_a_microsecond_after_a_step_belong_to_it():
    """Worked out by hand from docs/episode_format.md, for steps of 100 ms."""
    stamps_ns = np.array(
        [0, 50_000_000, 100_001_000, 100_001_001, 199_999_000, 200_000_999, 200_001_001]
    )
    ranges = step_ranges(stamps_ns, np.arange(3) * 100_000_000, 0, 3)
    assert ranges.tolist() == [[0, 1], [1, 3], [3, 6]]


@pytest.mark.parametrize(
    ("first_ns", "is_taken"),
    [
        (0, True),
        (50_000_000, True),
        (50_000_001, False),
        (-50_000_000, True),
        (-50_000_001, False),
        (99_000_000, False),
    ],
)
def test_step_0_takes_a_first_sample_within_half_a_step(first_ns, is_taken):
    ranges = step_ranges(np.array([first_ns, 250_000_000]), np.arange(3) * 100_000_000, 0, 3)
    assert ranges[0].tolist() == [0, int(is_taken)]
    assert step_ranges(np.array([], dtype=np.int64), np.arange(2), 0, 1).tolist() == [[0, 0]]


@pytest.mark.parametrize("off_ns", [-900, 900])
def test_stamps_off_by_less_than_a_microsecond_change_nothing(made, store, off_ns):
    expected = made.write(store).window(0)
    for side in ("left", "right"):
        made.stamps_ns[f"tactile_{side}"] = made.stamps_ns[f"tactile_{side}"] + off_ns
    window = made.write(store, episode_id="shifted").window(0)
    np.testing.assert_array_equal(window.tactile_kpa, expected.tactile_kpa)
    np.testing.assert_array_equal(window.tactile_valid, expected.tactile_valid)


def test_a_glove_that_begins_late_gives_nothing_at_step_0(made, store):
    """The first sample is 50 ms after step 0, more than half of its 66.7 ms."""
    stamps = made.stamps_ns["tactile_left"]
    made.stamps_ns["tactile_left"] = stamps[3:]
    made.values["tactile_left"] = made.values["tactile_left"][3:]
    window = made.write(store).window(0)
    assert window.tactile_valid[:2].tolist() == [[False, True], [True, True]]
    assert (window.tactile_kpa[0, 0] == 0).all()


@given(
    num_rows=st.integers(0, 40),
    edges=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), min_size=1, max_size=6),
    dtype=st.sampled_from(["uint16", "float32", "float64"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_means_over_ranges_are_those_of_numpy(num_rows, edges, dtype, seed):
    rng = np.random.default_rng(seed)
    values = (rng.gamma(2.0, 300.0, (num_rows, 320))).astype(dtype)
    ranges = np.minimum(np.array(edges, dtype=np.int64), num_rows)
    means, valid = mean_over_ranges(values, ranges)
    assert means.dtype == np.float32
    for mean, held, (low, high) in zip(means, valid, ranges, strict=True):
        assert held == (low < high)
        plain = values[low:high].mean(axis=0, dtype=np.float64) if held else np.zeros(320)
        np.testing.assert_array_equal(mean, plain.astype(np.float32))
