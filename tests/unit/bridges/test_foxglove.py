"""Layouts for Foxglove: panels that the app has, an arrangement that it opens, exported topics."""

import json
from pathlib import Path

from mcap.reader import make_reader

from dextouch.bridges.foxglove import foxglove_layout
from dextouch.bridges.mcap import export_mcap
from dextouch.episodes import EpisodeStore
from services import dashboard
from tests.unit.bridges.takes import descriptor, write_episode, write_recording

# Settings of panels as Foxglove's documentation names them, by panel
# (https://docs.foxglove.dev/docs/visualization/panels, Layout API of foxglove-sdk 0.30).
SETTINGS = {
    "Image": {"imageMode"},
    "3D": {"followMode", "followTf", "topics", "layers"},
    "Plot": {"paths", "showLegend", "isSynced"},
}
SERIES = {"label", "value", "enabled", "timestampMethod"}


def leaves(tree):
    """Panels of an arrangement, whose nodes have the form of react-mosaic."""
    if isinstance(tree, str):
        return [tree]
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in {"row", "column"}
    assert 0 < tree["splitPercentage"] < 100
    return leaves(tree["first"]) + leaves(tree["second"])


def check(layout):
    """Topics that the panels of a layout show."""
    assert set(layout) == {
        "configById", "globalVariables", "userNodes", "playbackConfig", "layout"
    }  # fmt: skip
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    topics = set()
    for name, settings in panels.items():
        assert set(settings) <= SETTINGS[name.split("!")[0]], name
        topics |= set(settings.get("imageMode", {}).values()) | set(settings.get("topics", {}))
        for series in settings.get("paths", ()):
            assert set(series) == SERIES
            topics.add(series["value"].split(".")[0])
    return topics


def topics_of(path):
    with path.open("rb") as file:
        return {channel.topic for channel in make_reader(file).get_summary().channels.values()}


def test_actions_of_other_robots_have_no_plots_of_ours():
    arm = descriptor("action", "robot_state", (7,), "float64", "rad", 30)
    assert not [name for name in foxglove_layout([arm])["configById"] if name.startswith("Plot")]


def test_every_topic_of_a_layout_is_in_the_file(tmp_path):
    store = EpisodeStore(tmp_path)
    for reader in (write_episode(store), write_recording(store)):
        path = tmp_path / f"{reader.item_id}.mcap"
        export_mcap(reader, path)
        layout = foxglove_layout(reader.attributes.streams)
        topics = check(layout)
        assert topics <= topics_of(path)
        assert {"/camera_head", "/tactile_left/image", "/wrist_left"} <= topics
    joints = foxglove_layout(store.open("stand-bottle-0003").attributes.streams)
    paths = [one["value"] for one in joints["configById"]["Plot!joints"]["paths"]]
    assert '/joints_measured.joints[:]{name=="l_index_finger_mcp_flex"}.position' in paths
    assert len(paths) == 10


def test_a_file_without_cameras_and_touch_has_a_layout():
    assert foxglove_layout([])["layout"] == "3D!world"
    button = descriptor("button", "scalar", (1,), "int64", "count", 10)
    assert check(foxglove_layout([button])) == set()


def test_the_dashboard_offers_the_layout_of_our_own_robot(tmp_path):
    path = Path(dashboard.__path__[0]) / "static/player/foxglove_layout.json"
    streams = write_episode(EpisodeStore(tmp_path)).attributes.streams
    assert json.loads(path.read_text()) == foxglove_layout(streams)
