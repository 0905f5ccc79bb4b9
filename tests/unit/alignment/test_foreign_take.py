"""A take that other tools recorded as MCAP is imported, aligned and played."""

import json

import numpy as np
import pytest

from dextouch.bridges.import_mcap import import_any_mcap
from dextouch.bridges.import_recording import ImportAttributes
from dextouch.episodes import EpisodeStore, needs
from dextouch.geometry import transform_from_pose
from dextouch.hands.actions import poses_from_actions
from dextouch.images import decode_jpeg
from dextouch.streams import unpack
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.cli.main import main
from services.episode_store.reading import (
    ImagesQuery,
    SignalsQuery,
    _images,
    playback_of,
    reduce_signals,
)
from tests.unit.bridges.test_import_mcap import PIXELS, T0, Recorder, encoded
from tests.unit.world_model.test_other_gloves import LAYOUT

SECONDS = 4.0
MAPS = {
    "camera_head": "/camera/color",
    "head": "/tf:head_optical",
    "wrist_left": "/tf:left_hand",
    "wrist_right": "/tf:right_hand",
    "joints_measured": "/joint_states",
    "tactile_left": "/glove/left",
    "tactile_right": "/glove/right",
}


def place(child, t_s):
    """Where a body is: it moves along x, at a height of its own."""
    height = {"head_optical": 1.6, "left_hand": 1.0, "right_hand": 0.9}[child]
    return [0.1 * t_s, 0.0, height]


def robot_take(path):
    recorder = Recorder(path)
    for side in ("left", "right"):
        recorder.channel(f"/glove/{side}", "Glove", "jsonschema", b'{"type": "object"}')
    turn = {"w": 0.8, "z": 0.6}
    for k in range(round(SECONDS * 100)):
        t_s = k / 100
        t = T0 + k * 10_000_000
        moves = [
            {
                "parent_frame_id": "world",
                "child_frame_id": child,
                "translation": dict(zip("xyz", place(child, t_s), strict=True)),
                "rotation": turn,
                "timestamp": {"seconds": t // 10**9, "nanos": t % 10**9},
            }
            for child in ("head_optical", "left_hand", "right_hand")
        ]
        recorder.add("/tf", "FrameTransforms", t, transforms=moves, log_ns=t + 2_000_000)
        joints = [{"name": f"j{i}", "position": 0.25 + i / 1000} for i in range(40)]
        recorder.add("/joint_states", "JointStates", t, joints=joints, log_ns=t + 2_000_000)
        if k % 3 == 0:
            image = {"data": encoded(PIXELS[k % 8], "jpeg"), "format": "jpeg", "frame_id": "cam"}
            recorder.add("/camera/color", "CompressedImage", t, **image)
        if k % 2 == 0:
            for side in ("left", "right"):
                recorder.raw(f"/glove/{side}", {"kpa": [1.5] * 320}, t + 2_000_000)
    K = [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1]
    about = {"width": 64, "height": 48, "frame_id": "cam", "distortion_model": "plumb_bob"}
    recorder.add("/camera/info", "CameraCalibration", T0, K=K, D=[0] * 5, **about)
    return recorder.done()


@pytest.fixture
def imported(tmp_path):
    words = ["import", str(robot_take(tmp_path / "take.mcap")), "--domain", "robot"]
    words += ["--task", "wipe", "--instruction", "Wipe.", "--store", str(tmp_path / "store")]
    words += [f"--map={name}={source}" for name, source in MAPS.items()]
    assert main([*words, "--json", str(tmp_path / "report.json")]) == 0
    (report,) = json.loads((tmp_path / "report.json").read_text())["reports"]
    assert {one["stream"] for one in report["imported"]} == set(MAPS)
    assert report["refused"] == []
    return EpisodeStore(tmp_path / "store")


def test_it_becomes_an_episode_for_learners(imported):
    episode_id = align_recording(imported, "take", AlignmentOptions()).episode_id
    episode = imported.open(episode_id)
    about = episode.attributes
    assert (about.task, about.domain, about.absent) == ("wipe", "robot", ())
    assert about.K_head == ((50, 0, 32), (0, 50, 24), (0, 0, 1))
    for need in (needs.ACTIONS, needs.EVERY_PART, needs.TOUCH, needs.IMAGES, needs.EVERY_IMAGE):
        assert need.is_met(episode), need.lack
    assert {one.method for one in about.clocks if one.stream == "head"} == {"device"}
    window = episode.window(0, num_steps=17)
    np.testing.assert_allclose(window.tactile_kpa, 1.5)
    # The left hand moves by 10 cm/s along x, turned by 2 atan2(0.6, 0.8) about z.
    poses = poses_from_actions(window.actions, window.anchor)
    T = poses.Ts_world_wrist_left
    start = T[0, 0, 3]
    np.testing.assert_allclose(T[:, 0, 3] - start, 0.1 * np.arange(17) / 15, atol=1e-3)
    expected = transform_from_pose(np.array([0, 0, 1.0, 0.8, 0, 0, 0.6]))
    np.testing.assert_allclose(T[:, :3, :3], expected[None, :3, :3].repeat(17, 0), atol=1e-6)
    np.testing.assert_allclose(T[:, 2, 3], 1.0, atol=1e-6)
    np.testing.assert_allclose(
        window.actions[:, 18:58], 0.25 + np.arange(40) / 1000 + np.zeros((17, 1)), atol=1e-6
    )


def test_touch_of_another_glove_has_its_layout(tmp_path):
    recorder = Recorder(tmp_path / "glove.mcap")
    recorder.channel("/glove", "Glove", "jsonschema", b'{"type": "object"}')
    recorder.raw("/glove", {"kpa": [2.5] * LAYOUT.num_taxels}, T0)
    recorder.done()
    (tmp_path / "layout.json").write_text(LAYOUT.model_dump_json())
    words = ["import", str(tmp_path / "glove.mcap"), "--map", "tactile_left=/glove"]
    words += ["--store", str(tmp_path / "store")]
    assert main(words) == 3
    assert main([*words, "--layout", str(tmp_path / "layout.json")]) == 0
    stream = EpisodeStore(tmp_path / "store").recording("glove").streams["tactile_left"]
    assert (stream.layout, stream.unit, stream.side) == (LAYOUT, "kPa", "left")


def test_the_player_shows_the_recording(imported):
    reader = imported.recording("take")
    about = playback_of(reader)
    assert {one.name for one in about.streams} == set(MAPS)
    # The start of the take is known to the microsecond, and both of its times are of that one.
    assert (about.start_ns, about.started_t_host_ns) == (T0 + 5, T0)
    query = ImagesQuery(start_ns=T0, stop_ns=T0 + 10**8)
    _, images = unpack(_images(reader, "camera_head", query, 1 << 24), max_bytes=1 << 24)
    assert bytes(images["data"][: images["num_bytes"][0]]) == encoded(PIXELS[0], "jpeg")
    names = "wrist_left.0,tactile_left.max,joints_measured.3"
    span = {"start_ns": T0, "stop_ns": T0 + 4 * 10**9, "points": 4}
    _, curves = unpack(reduce_signals(reader, SignalsQuery(names=names, **span)), max_bytes=1 << 20)
    np.testing.assert_allclose(curves["wrist_left.0/low"], [0, 0.1, 0.2, 0.3], atol=2e-3)
    np.testing.assert_allclose(curves["tactile_left.max/high"], 1.5)


def test_the_player_shows_gray_images(tmp_path):
    recorder = Recorder(tmp_path / "depth.mcap")
    deep = (PIXELS[0, ..., 0].astype("<u2") * 4).tobytes()
    size = {"width": 64, "height": 48, "step": 128}
    recorder.add("/depth", "RawImage", T0, data=deep, encoding="16UC1", **size)
    store = EpisodeStore(tmp_path / "store")
    import_any_mcap(recorder.done(), store, ImportAttributes())
    for half_size in (False, True):
        query = ImagesQuery(half_size=half_size)
        answer = _images(store.recording("depth"), "depth", query, 1 << 24)
        shown = decode_jpeg(unpack(answer, max_bytes=1 << 24)[1]["data"].tobytes())
        expected = PIXELS[0, ..., :1].astype(float) * 255 / PIXELS[0, ..., 0].max()
        assert np.abs(shown.astype(float) - expected).mean() < 6
