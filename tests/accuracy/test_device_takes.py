"""Human takes of the twin through mock devices and alignment, against the twin's truth."""

import sys
import time

import numpy as np
import pytest

from benchmarks.closure.benchmark import Method, retarget_take, robot_trajectory
from dextouch.episodes import EpisodeStore
from dextouch.geometry import apply, interpolate_poses, invert, transform_from_pose
from dextouch.geometry.rotations import rotation_angle
from dextouch.hands import CHAINS, NODE_INDEX
from dextouch.hands.actions import poses_from_actions
from dextouch.hands.robot_hand import RobotHand
from dextouch.tactile import DEXTOUCH_V1
from services.acquisition.mocks.gloves import GloveCalibration
from services.alignment.recording_error import compare_with_truth, match_streams
from services.pipelines.mock_takes import SESSION_SEEDS, device_options, write_by_station
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage

pytestmark = pytest.mark.long

SIDES = ("left", "right")
OPTIONS = TakeOptions(images=("camera_head",))
TRAINING = TakeOptions(images=("camera_head",), image_every=4, streams="training")
# Wrist and joints of a take without any measurement error.
TOUCH = Method("touch", anchors=True, presses=False)
TIPS = [NODE_INDEX[chain, "tip"] for chain in CHAINS]
PRESSED_N = 0.5
GRID_S = np.arange(81) / 15
BOUNDS = {
    "wrist mm": 1.5,
    "wrist deg": 0.2,
    "joints deg": 1.5,
    "pressing fingertips mm": 3.0,
    "touch kPa": 0.02,
    "clock ms": 0.2,
    "delay ms": 1.0,
    "label ms": 0.3,
}
# On an idle 3 GHz core. Only the slow test demands it: other machines and load change it.
CPU_BOUND_S = {"CPU s": 4.0}


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A take with its truth and its episode for training, the first one of its session."""
    truth = record(Stage("stand_bottle", "human", TwinSettings()), 43, device_options(TRAINING))
    store = EpisodeStore(tmp_path_factory.mktemp("first"))
    write_by_station(store, truth, episode_id=name_of(truth), options=TRAINING)
    return truth, store.open(name_of(truth))


def name_of(truth):
    return f"{truth.attributes.episode_id}-devices"


def measured(truth, store):
    """Errors of a take with all streams, and its processor time."""
    start_s = time.process_time()
    write_by_station(store, truth, episode_id=name_of(truth), options=OPTIONS)
    cpu_s = time.process_time() - start_s
    original = store.open(write_episode(store, truth))
    return {**errors(store.open(name_of(truth)), original, truth), "CPU s": cpu_s}


def check(rows, bounds, capsys):
    with capsys.disabled():
        sys.stdout.write(f"\n{len(rows)} human takes: error | mean | worst | bound\n")
        for figure in rows[0]:
            found = [row[figure] for row in rows]
            bound = bounds.get(figure, "none")
            sys.stdout.write(f"{figure} | {np.mean(found):.3f} | {max(found):.3f} | {bound}\n")
    for figure, bound in bounds.items():
        assert max(row[figure] for row in rows) <= bound, figure


def test_a_human_take_becomes_actions_of_the_robot_within_a_stations_errors(
    first, tmp_path, capsys
):
    truth, before = first
    store = EpisodeStore(tmp_path)
    check([measured(truth, store)], BOUNDS, capsys)
    # Equal takes give equal episodes, whatever is kept of them.
    again = store.open(name_of(truth))
    for stream in ("action", "tactile_left", "object_poses"):
        np.testing.assert_array_equal(before.read(stream).values, again.read(stream).values)
        np.testing.assert_array_equal(before.read(stream).t_ref_ns, again.read(stream).t_ref_ns)
    assert {"wrist_left", "keypoints_right", "head"} <= set(again.streams)


@pytest.mark.slow
def test_six_human_takes(first, tmp_path, capsys):
    rows = []
    for task in ("stand_bottle", "insert_peg"):
        stage = Stage(task, "human", TwinSettings())
        truths = (record(stage, seed, device_options(OPTIONS)) for seed in (0, 7, 31))
        rows += [measured(truth, EpisodeStore(tmp_path)) for truth in truths]
    check(rows, BOUNDS | CPU_BOUND_S, capsys)


def test_an_episode_for_training_has_labels_and_the_calibration_of_its_session(first):
    truth, episode = first
    assert set(episode.streams) == {
        "action", "tactile_left", "tactile_right", "camera_head", "object_poses"
    }  # fmt: skip
    assert episode.shown_steps("camera_head")[0].tolist() == [*range(0, 80, 4), 78, 79, 80]
    about = episode.attributes
    assert (about.origin, about.domain, about.seed) == ("twin", "human", 43)
    assert about.success is truth.attributes.success
    assert about.object_names == truth.attributes.object_names
    assert about.event_times_s.keys() == truth.attributes.event_times_s.keys()
    assert {"noise_m", "retargeting_left_wrist_offset_mm"} <= about.quality.keys()
    own = GloveCalibration.seeded("left", 43 // SESSION_SEEDS)
    (tare,) = np.array(about.calibration["tactile_left_tare_counts"])
    assert (tare == np.rint(own.tare_counts)).all()


def errors(episode, original, truth):
    # True time of step 0, from the true stamps of matching samples.
    matches = match_streams(episode, original, 0)
    origin_ns = -np.mean([match.mean_offset_ns for match in matches.values()])
    labels, poses = episode.read("object_poses"), original.read("object_poses")
    label_ns = np.abs(labels.t_ref_ns[:, None] + origin_ns - poses.t_ref_ns).min(axis=1).max()
    compared = compare_with_truth(episode, original, origin_in_truth_ns=round(origin_ns))
    return {
        **pose_errors(episode, truth, origin_ns * 1e-9),
        "touch kPa": compared["taxel_mae_kpa"],
        "clock ms": max(compared["clock_rms_ms"].values()),
        "delay ms": max(map(abs, compared["latency_error_ms"].values())),
        "label ms": label_ns * 1e-6,
    }


def pose_errors(episode, truth, origin_s):
    """Of the actions, against the same transfer of the true streams, and of pressing fingertips."""
    expected = robot_trajectory(retarget_take(truth), TOUCH)
    action = episode.read("action")
    reached = poses_from_actions(action.values, episode.attributes.anchor.to_poses())
    at_s = (action.t_ref_ns * 1e-9 + origin_s).clip(0, GRID_S[-1])
    left = np.searchsorted(GRID_S, at_s, side="right").clip(1, 80) - 1
    weight = (at_s - GRID_S[left]) * 15
    apart_m, turned_rad, joints_rad, missed_m = [], [], [], []
    for side in SIDES:
        wrist, joints = f"Ts_world_wrist_{side}", f"joints_{side}_rad"
        Ts = interpolate_poses(getattr(expected, wrist), left, weight)
        mine = getattr(reached, wrist)
        q_mine = getattr(reached, joints)
        apart_m.append(np.linalg.norm(mine[:, :3, 3] - Ts[:, :3, 3], axis=1))
        turned_rad.append(rotation_angle((invert(Ts) @ mine)[:, :3, :3]))
        q = getattr(expected, joints)
        near = (1 - weight[:, None]) * q[left] + weight[:, None] * q[left + 1]
        joints_rad.append(np.abs(q_mine - near))
        missed_m.append(missed_by_pressing_tips_m(truth, side, at_s, mine, q_mine))
    return {
        "wrist mm": np.mean(apart_m) * 1e3,
        "wrist deg": np.rad2deg(np.mean(turned_rad)),
        "joints deg": np.rad2deg(np.mean(joints_rad)),
        "pressing fingertips mm": np.concatenate(missed_m).mean() * 1e3,
    }


def missed_by_pressing_tips_m(truth, side, at_s, Ts_world_robot, joints_rad):
    """Distance of the robot's fingertips to the person's in the world, where these press."""

    def nearest(name):
        stream = truth.streams[f"{name}_{side}"]
        index = np.abs(stream.t_ref_ns[:, None] * 1e-9 - at_s).argmin(axis=0)
        return stream.values[index]

    T, person = transform_from_pose(nearest("wrist")), nearest("keypoints")[:, TIPS]
    robot = RobotHand(side).fingertips_m(joints_rad)
    apart_m = apply(T, person) - apply(Ts_world_robot, robot)
    pressing = DEXTOUCH_V1.pad_forces_n(nearest("tactile"))[:, :5] > PRESSED_N
    return np.linalg.norm(apart_m, axis=-1)[pressing]
