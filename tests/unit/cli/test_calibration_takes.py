"""`dextouch station calibrate` from takes of known truth: wrist, profile, robot base, latency."""

import json
from argparse import Namespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.simulated.board_scenes import mount_difference
from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import InvalidInputError, NotFoundError, ShapeError
from dextouch.geometry import pose_from_transform, transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.images import encode_jpeg
from dextouch.schemas import RecordingAttributes, matrix_rows
from dextouch.streams import SampleBatch, StreamDescriptor, encoded_values
from services.acquisition.devices import load_calibration
from services.alignment.calibration.motion import DegenerateMotionError
from services.alignment.station_calibration.record import load_matrices
from services.cli import main as command_line
from services.pipelines.calibrate import main
from services.pipelines.calibrate.show import show
from tests.accuracy.test_common_motion import K, room, shake
from tests.accuracy.test_robot_base import pairs
from tests.accuracy.test_time_offset import taps
from tests.unit.alignment.tracked_hands import any_rotation, flat_hand, moving_hand

START_NS = 10**12


def write_take(path, streams, calibration=None, frames=None):
    """A spooled take; `streams` are name: (kind, unit, times in ns, values)."""
    descriptors = {
        name: StreamDescriptor(
            name=name,
            kind=kind,
            side="left" if kind == "tactile" else None,
            frame=(frames or {}).get(name),
            shape=values.shape[1:],
            dtype="float64",
            unit=unit,
            nominal_rate_hz=round(1e9 / np.median(np.diff(t_ns))),
        )
        for name, (kind, unit, t_ns, values) in streams.items()
    }
    attributes = RecordingAttributes(
        recording_id="take",
        task="calibrate-takes",
        instruction="",
        domain="human",
        station="test",
        calibration=calibration or {},
        streams=tuple(descriptors.values()),
    )
    with SpoolWriter(path, attributes, sync=False) as spool:
        for name, (_, _, t_ns, values) in streams.items():
            number = np.arange(len(t_ns), dtype=np.int64)
            t_host_ns = t_ns + START_NS
            spool.append(name, SampleBatch(t_host_ns, t_host_ns, number, values))
    return path


def run(*arguments, to):
    report = to.parent / "report.json"
    words = [str(argument) for argument in arguments]
    assert main([*words, "--to", str(to), "--json", str(report)]) == 0
    return json.loads(report.read_text()), load_calibration(to / "calibration.json")


def hand_take(path, keypoints_m, side="left"):
    t_ns = np.arange(len(keypoints_m), dtype=np.int64) * 10_000_000
    return write_take(path, {f"keypoints_{side}": ("keypoints", "m", t_ns, keypoints_m)})


def test_wrist_axes_from_a_flat_hand_and_the_person_in_them(tmp_path):
    rng = np.random.default_rng(0)
    R = any_rotation(rng)
    flat = hand_take(tmp_path / "flat", flat_hand("left", rng) @ R.T)
    to = tmp_path / "to"
    report, matrices = run("wrist", "--side", "left", "--take", flat, to=to)
    found = np.array(matrices["T_keypoints_left_wrist_left"])[:3, :3]
    np.testing.assert_allclose(found, R, atol=0.01)
    assert report["hand_size"] == pytest.approx(1.0, abs=0.02)

    keypoints_m = moving_hand("left", rng, num_samples=300)
    moving = hand_take(tmp_path / "moving", keypoints_m @ R.T)
    _, matrices = run("profile", "--side", "left", "--take", moving, to=to)
    profile = np.array(matrices["hand_profile_left"])
    # Nodes 1 to 4 are the thumb's; its bones keep their lengths.
    bones_m = np.linalg.norm(np.diff(keypoints_m[0, 1:5], axis=0), axis=-1)
    np.testing.assert_allclose(profile[0, :3], bones_m, atol=1e-6)
    levels = {f["name"]: (f["level"], f["sigma"]) for f in show(argument(to))["findings"]}
    assert levels["T_keypoints_left_wrist_left"][0] == "OK"
    assert levels["hand_profile_left"][1].startswith("knuckles ")


def argument(folder):
    return Namespace(folder=folder)


def test_hands_that_do_not_serve_are_refused(tmp_path):
    rng = np.random.default_rng(1)
    bent = hand_take(tmp_path / "bent", moving_hand("left", rng))
    with pytest.raises(InvalidInputError, match="lay the hand flat"):
        main(["wrist", "--side", "left", "--take", str(bent), "--to", str(tmp_path / "to")])
    turned = hand_take(tmp_path / "turned", moving_hand("left", rng) @ any_rotation(rng).T)
    with pytest.raises(InvalidInputError, match="dextouch station calibrate wrist --side left"):
        main(["profile", "--side", "left", "--take", str(turned), "--to", str(tmp_path / "to")])
    with pytest.raises(NotFoundError, match="only keypoints_left"):
        main(["wrist", "--side", "right", "--take", str(bent), "--to", str(tmp_path / "to")])
    assert not (tmp_path / "to").exists()


@pytest.mark.parametrize("has_mount", [True, False])
def test_robot_base_from_pairs_of_poses(tmp_path, has_mount):
    tracker, effector, T_world_base, mount = pairs(3, has_mount=has_mount)
    file = tmp_path / "pairs.json"
    file.write_text(json.dumps(np.stack([tracker, effector], axis=1).tolist()))
    flags = [] if has_mount else ["--same-frame"]
    report, matrices = run("robot-base", "--poses", file, *flags, to=tmp_path / "to")
    angle_rad, distance_m = mount_difference(np.array(matrices["T_world_base"]), T_world_base)
    assert np.rad2deg(angle_rad) < 0.2
    assert distance_m < 2e-3
    assert mount_difference(np.array(report["T_effector_tracker"]), mount)[0] < 5e-3
    (finding,) = show(argument(tmp_path / "to"))["findings"]
    assert finding["level"] == "OK"
    file.write_text(json.dumps(tracker.tolist()))
    with pytest.raises(ShapeError, match="T_base_effector"):
        main(["robot-base", "--poses", str(file), "--to", str(tmp_path / "to")])


def shaken(t_s):
    """Irregular rotation about all axes, from whole formulas."""
    rng = np.random.default_rng(5)
    rates_hz, phases = rng.uniform(0.3, 2.5, (3, 5)), rng.uniform(0, 2 * np.pi, (3, 5))
    waves = np.sin(2 * np.pi * rates_hz * t_s[:, None, None] + phases)
    return rotation_from_vector(0.25 * waves.sum(axis=2))


@pytest.mark.parametrize("same_world", [True, False])
def test_delays_of_trackers_of_one_or_two_worlds_that_are_held_together(tmp_path, same_world):
    rng = np.random.default_rng(2)
    t_s = {"wrist_left": np.arange(0, 10, 1 / 100), "wrist_right": np.arange(0, 10, 1 / 90)}
    delays_ms = {"wrist_left": 37.0, "wrist_right": 12.0}
    streams = {}
    for name, at_s in t_s.items():
        Rs = shaken(at_s) @ any_rotation(rng)
        if not same_world and name == "wrist_left":
            Rs = any_rotation(rng) @ Rs
        poses = pose_from_transform(transform(Rs, rng.normal(scale=1e-4, size=(len(at_s), 3))))
        t_ns = np.rint(at_s * 1e9 + delays_ms[name] * 1e6).astype(np.int64)
        streams[name] = ("pose", "pose_m_wxyz", t_ns, poses)
    known = {
        "wrist_right_latency_ns": ((12e6,),),
        "wrist_right_latency_sigma_ns": ((0.5e6,),),
        # Of a former calibration, which was wrong.
        "wrist_left_latency_ns": ((20e6,),),
    }
    take = write_take(tmp_path / "take", streams, known)
    _, matrices = run("time", "--reference", "wrist_right", "--take", take, to=tmp_path / "to")
    assert matrices["wrist_left_latency_ns"][0][0] * 1e-6 == pytest.approx(37.0, abs=1.0)
    assert 0.5 <= matrices["wrist_left_latency_sigma_ns"][0][0] * 1e-6 < 2


@pytest.mark.parametrize("stream", ["wrist_left", "tactile_left"])
def test_latency_from_taps(tmp_path, stream):
    (t_glove_ns, kpa, t_tracker_ns, height_m), offset_s = taps(1)
    start_ns = min(t_glove_ns[0], t_tracker_ns[0])
    pressures = np.zeros((len(kpa), 320))
    pressures[:, 7] = kpa
    # A taxel that is never measured.
    pressures[:, 300] = np.nan
    poses = np.zeros((len(height_m), 7))
    poses[:, 2], poses[:, 3] = height_m, 1.0
    # Times that the tracker lost its target.
    poses[5:9] = 0.0
    streams = {
        "tactile_left": ("tactile", "kPa", t_glove_ns - start_ns, pressures),
        "wrist_left": ("pose", "pose_m_wxyz", t_tracker_ns - start_ns, poses),
    }
    take = write_take(tmp_path / "take", streams)
    reference = ({"wrist_left", "tactile_left"} - {stream}).pop()
    arguments = ["--stream", stream, "--reference", reference, "--take", take]
    report, _ = run("latency", *arguments, to=tmp_path / "to")
    # `offset_s` is to be added to the tracker's times: they are early by it.
    late_ms = -offset_s * 1e3 if stream == "wrist_left" else offset_s * 1e3
    assert report["latency_ms"] == pytest.approx(late_ms, abs=6)
    assert report["method"] == "taps"


def test_streams_without_common_motion_are_refused(tmp_path):
    t_ns = np.arange(400, dtype=np.int64) * 10_000_000
    still = np.tile([0.0, 0, 0, 1, 0, 0, 0], (400, 1))
    streams = dict.fromkeys(("wrist_left", "head"), ("pose", "pose_m_wxyz", t_ns, still))
    streams["joints_measured"] = ("robot_state", "rad", t_ns, np.zeros((400, 40)))
    take = str(write_take(tmp_path / "take", streams))
    with pytest.raises(DegenerateMotionError, match="brisk"):
        main(["time", "--take", take, "--to", str(tmp_path / "to")])
    common = ["latency", "--take", take, "--to", str(tmp_path / "to"), "--stream", "wrist_left"]
    for reference in ("head", "joints_measured"):
        with pytest.raises(InvalidInputError, match="expected a pose and a glove"):
            main([*common, "--reference", reference])
    assert command_line.main(["station", "calibrate", *common, "--reference", "none"]) == 3
    assert not load_or_none(tmp_path / "to")


def load_or_none(folder):
    return load_matrices(folder) if (folder / "calibration.json").exists() else None


def test_times_of_all_that_was_shaken_together(tmp_path, capsys):
    truth, rng = shake(5), np.random.default_rng(5)
    late_ms = {"wrist_left": 12.0, "wrist_right": 41.0, "head": 25.0}
    streams = {}
    for name, delay_ms in late_ms.items():
        t_s = np.arange(0.5, 10.5, 1 / 90)
        mount = Rotation.random(random_state=int(rng.integers(1 << 30)))
        quaternions = (truth(t_s) * mount).as_quat(scalar_first=True)
        poses = np.column_stack([np.tile([0.1, 0.2, 0.3], (len(t_s), 1)), quaternions])
        t_ns = np.rint((t_s + delay_ms / 1e3) * 1e9).astype(np.int64)
        streams[name] = ("pose", "pose_m_wxyz", t_ns, poses)
    hands = keypoints_at_rest(901)
    streams["keypoints_left"] = ("keypoints", "m", np.arange(901) * 11_111_111, hands)
    # A tracker that was switched off, and one that never saw its target.
    off = np.zeros((901, 7))
    streams["object_cup"] = ("pose", "pose_m_wxyz", np.arange(901) * 11_111_111, off)
    unseen = np.full((901, 25, 3), np.nan)
    streams["keypoints_right"] = ("keypoints", "m", np.arange(901) * 11_111_111, unseen)
    # The delay of one is known; what is found comes on top of what others are said to have.
    known = {
        "head_latency_ns": ((25e6,),),
        "head_latency_sigma_ns": ((0.2e6,),),
        "wrist_right_latency_ns": ((30e6,),),
    }
    frames = {"keypoints_right": "world"}
    take = write_take(tmp_path / "shake", streams, known, frames)
    report, matrices = run("time", "--take", take, to=tmp_path / "to")
    assert report["reference"] == "head"
    left_out = {"keypoints_left", "keypoints_right", "object_cup"}
    assert set(report["left_out"]) == left_out
    for name in ("wrist_left", "wrist_right"):
        assert matrices[f"{name}_latency_ns"][0][0] * 1e-6 == pytest.approx(late_ms[name], abs=0.5)
        assert 0.2 <= matrices[f"{name}_latency_sigma_ns"][0][0] * 1e-6 <= 0.6
    assert "head_latency_ns" not in matrices
    said = capsys.readouterr().out
    assert "3 pairs of streams" in said
    assert "left out: keypoints_left has keypoints in wrist axes" in said
    # What is known by now of the reference counts, though the take does not have it.
    _, matrices = run(
        "time", "--take", take, "--reference", "wrist_left", to=tmp_path / "to"
    )  # fmt: skip
    for name, late in late_ms.items():
        assert matrices[f"{name}_latency_ns"][0][0] * 1e-6 == pytest.approx(late, abs=0.7)
    with pytest.raises(InvalidInputError, match="keypoints_left has keypoints in wrist axes"):
        main(["time", "--take", str(take), "--to", str(tmp_path / "no"),
              "--reference", "keypoints_left"])  # fmt: skip
    only, _ = run(
        "time", "--take", take, "--streams", "head, wrist_left", "--reference", "wrist_left",
        to=tmp_path / "two",
    )  # fmt: skip
    assert list(only["streams"]) == ["head"]
    common = ["time", "--take", str(take), "--to", str(tmp_path / "no"), "--streams"]
    with pytest.raises(NotFoundError, match="has no table"):
        main([*common, "head,table"])
    with pytest.raises(InvalidInputError, match=r"1 of its streams .* keypoints_left has"):
        main([*common, "head,keypoints_left"])


def keypoints_at_rest(count):
    return np.repeat(flat_hand("left", np.random.default_rng(0), num_samples=1), count, axis=0)


@pytest.mark.long
@pytest.mark.parametrize("unit", ["rgb8", "jpeg"])
def test_times_of_a_camera(tmp_path, unit):
    truth, seen = shake(6), room(6)
    t_s = np.arange(0.5, 8.5, 1 / 30)
    pictures = [seen(truth(t)) for t in t_s]
    values = encoded_values([encode_jpeg(one) for one in pictures]) if unit == "jpeg" else None
    values = np.stack(pictures) if values is None else values
    quaternions = truth(np.arange(0.5, 8.5, 1 / 90)).as_quat(scalar_first=True)
    poses = np.column_stack([np.zeros((len(quaternions), 3)), quaternions])
    times_ns = {
        "head": np.rint(np.arange(0.5, 8.5, 1 / 90) * 1e9).astype(np.int64),
        "camera_head": np.rint((t_s + 0.033) * 1e9).astype(np.int64),
    }
    described = {
        "head": ("pose", (7,), "float64", "pose_m_wxyz", 90, poses),
        "camera_head": ("image", (240, 320, 3), "uint8", unit, 30, values),
    }
    attributes = RecordingAttributes(
        recording_id="take",
        task="calibrate-takes",
        instruction="",
        domain="human",
        station="test",
        calibration={"K_head": matrix_rows(K)},
    )
    store = EpisodeStore(tmp_path / "store")
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, (kind, shape, dtype, unit_of, rate_hz, samples) in described.items():
            writer.add_stream(
                StreamDescriptor(
                    name=name, kind=kind, shape=shape, dtype=dtype, unit=unit_of,
                    nominal_rate_hz=rate_hz,
                )
            )  # fmt: skip
            t_ns = times_ns[name] + START_NS
            writer.append(name, values=samples, t_host_ns=t_ns, t_device_ns=t_ns)
    words = ("time", "--take", "take", "--store", str(tmp_path / "store"), "--reference", "head")
    _, matrices = run(*words, to=tmp_path / "to")
    assert matrices["camera_head_latency_ns"][0][0] * 1e-6 == pytest.approx(33.0, abs=0.6)


@pytest.mark.parametrize("command", ["wrist", "profile", "robot-base", "latency"])
def test_each_command_has_help_with_an_example(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    said = capsys.readouterr().out
    assert f"dextouch station calibrate {command} " in said
    assert "--json" in said
