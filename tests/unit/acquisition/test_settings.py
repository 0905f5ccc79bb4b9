import json

import pytest
from pydantic import ValidationError

from dextouch.errors import InvalidInputError, StorageError
from dextouch.serving import ServiceSettings, load_settings
from services.acquisition.app import create_app
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers, load_calibration
from services.acquisition.settings import AcquisitionSettings, MockLinks, SpoolSafety

OPTIONS = {
    "station",
    "spool",
    "flush_period_s",
    "min_free_bytes",
    "mock",
    "mock_store",
    "mock_episode_id",
    "mock_faults",
    "mock_links",
    "require_consent",
    "seed",
    "devices",
    "calibration",
    "episode_store_url",
    "episode_store_key",
    "enrolment",
    "upload_period_s",
    "keep_uploaded_days",
    "keep_uploaded_gb",
}
DEVICES = (
    {"kind": "tactile_glove", "side": "left", "serial_number": "G1"},
    {"kind": "tactile_glove", "side": "right", "port": "/dev/ttyACM0"},
    {"kind": "finger_tracker", "side": "left", "vendor_id": 1, "product_id": 2},
    {"kind": "pose_tracker", "stream": "head", "vendor_id": 1, "product_id": 3},
    {"kind": "camera", "stream": "camera_head", "port": 5000},
    {"kind": "robot_state", "port": 5001},
)


def test_options_are_these():
    assert set(AcquisitionSettings.model_fields) - set(ServiceSettings.model_fields) == OPTIONS


def test_a_mock_station_is_healthy_unless_asked():
    assert AcquisitionSettings(mock=True).mock_faults == "none"


def test_environment_and_flags(monkeypatch):
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_STATION", "desk_3")
    settings = load_settings(AcquisitionSettings, ["--mock", "--seed", "4"])
    assert (settings.station, settings.mock, settings.seed) == ("desk_3", True, 4)


def test_the_spools_safety_and_the_mocks_links_are_options_too(monkeypatch):
    defaults = AcquisitionSettings()
    assert isinstance(defaults, SpoolSafety)
    assert (defaults.flush_period_s, defaults.min_free_bytes) == (0.5, 64 * 2**20)
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_FLUSH_PERIOD_S", "0.1")
    monkeypatch.setenv("DEXTOUCH_ACQUISITION_MOCK_LINKS__TRACKERS", "bridge")
    flags = ["--min-free-bytes", "1000", "--mock-links.images", "h264"]
    settings = load_settings(AcquisitionSettings, flags)
    assert (settings.flush_period_s, settings.min_free_bytes) == (0.1, 1000)
    assert settings.mock_links == MockLinks(trackers="bridge", images="h264")


@pytest.mark.parametrize(
    "flags", [["--flush-period-s", "0"], ["--min-free-bytes", "-1"], ["--mock-links.gloves", "x"]]
)
def test_impossible_options_are_refused(flags):
    with pytest.raises(InvalidInputError):
        load_settings(AcquisitionSettings, flags)


def test_real_devices_become_drivers():
    drivers = build_drivers(AcquisitionSettings(devices=DEVICES).devices, StationClock())
    assert [driver.name for driver in drivers] == [
        "glove_left",
        "glove_right",
        "finger_tracker_left",
        "pose_tracker_head",
        "camera_head",
        "robot_state",
    ]
    assert len({d.name for driver in drivers for d in driver.descriptors}) == 11


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"mock": True, "mock_episode_id": "e"}, "both"),
        ({"mock": True, "mock_store": "s"}, "both"),
        ({"mock": True, "devices": DEVICES[:1]}, "tactile_glove.*one of the two"),
    ],
)
def test_options_that_would_be_ignored_are_refused(options, told):
    with pytest.raises(ValidationError, match=told):
        AcquisitionSettings(**options)


def test_a_spool_that_cannot_be_made_is_refused_by_name(tmp_path):
    (tmp_path / "file").write_text("")
    spool = tmp_path / "file" / "spool"
    with pytest.raises(StorageError, match=r"make the spool .*file/spool"):
        create_app(AcquisitionSettings(mock=True, spool=spool))


def test_two_devices_of_one_stream_are_refused_by_name():
    tracker = {"kind": "pose_tracker", "stream": "wrist_left", "vendor_id": 1, "product_id": 4}
    settings = AcquisitionSettings(devices=(*DEVICES, tracker))
    with pytest.raises(InvalidInputError, match=r"'wrist_left'.*'robot_state'.*pose_tracker_wri"):
        build_drivers(settings.devices, StationClock())


def test_a_robot_beside_trackers_gives_the_streams_that_it_is_asked_for():
    names = ("joints_measured", "joints_commanded")
    trackers = [
        {"kind": "pose_tracker", "stream": name, "vendor_id": 1, "product_id": 4 + index}
        for index, name in enumerate(("wrist_left", "wrist_right"))
    ]
    robot = {**DEVICES[-1], "streams": names}
    settings = AcquisitionSettings(devices=(*DEVICES[:-1], *trackers, robot))
    *_, driver = build_drivers(settings.devices, StationClock())
    assert tuple(d.name for d in driver.descriptors) == names


@pytest.mark.parametrize("streams", [[], ["elbow"], ["wrist_left", "wrist_left"]])
def test_a_robot_without_known_streams_is_refused(streams):
    flags = ["--devices", json.dumps([{**DEVICES[-1], "streams": streams}])]
    with pytest.raises(InvalidInputError):
        build_drivers(load_settings(AcquisitionSettings, flags).devices, StationClock())


@pytest.mark.parametrize(
    "devices", [(), DEVICES[:1] * 2, ({"kind": "tactile_glove", "side": "left"},)]
)
def test_impossible_stations_are_refused(devices):
    settings = AcquisitionSettings(devices=devices)
    with pytest.raises(InvalidInputError, match=r"station|serial_number"):
        build_drivers(settings.devices, StationClock())


def test_calibration_file(tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text('{"K_head": [[1, 0], [0, 1]]}')
    assert load_calibration(path) == {"K_head": ((1, 0), (0, 1))}
    assert load_calibration(None) == {}
    path.write_text("{")
    with pytest.raises(InvalidInputError, match="no JSON"):
        load_calibration(path)
    with pytest.raises(InvalidInputError, match="no JSON"):
        load_calibration(tmp_path / "nowhere.json")
