"""Guided runs and the overview of a station's calibration, on a station that answers from here."""

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from dextouch.clients import Reply
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from services.alignment.station_calibration.record import judge, write_entry
from services.alignment.station_calibration.routes import overview
from services.alignment.station_calibration.runs import CalibrationRuns, RunRequest, StationLocation

GLOVE = RunRequest(kind="glove", subject="left")
SHAKEN = ("head", "wrist_left", "camera_head", "tactile_left", "keypoints_left")
STREAMS = ("head", "tactile_left", "camera_head", "keypoints_left")


class FakeLink:
    """A station's routes; the tests read what was asked."""

    def __init__(self, simulated):
        self.asked = []
        stream = {"level": "OK", "reasons": [], "rate_hz": 1.0, "nominal_rate_hz": 1.0}
        stream |= {"age_s": 0.0, "received": 1, "lost": 0, "device": "one"}
        counted = ("packets", "lost", "crc_errors", "length_errors", "resync_bytes", "refused")
        device = dict.fromkeys((*counted, "reconnects"), 0) | {"device": "one", "connected": True}
        device |= {"address": "", "last_error": None, "simulated": simulated}
        self.health = {"station": "desk", "level": "OK", "devices": [device]}
        self.health["streams"] = [stream | {"stream": name} for name in STREAMS]

    def request(self, method, path, **_):
        self.asked.append(f"{method} {path}")
        replies = {"/v1/health": self.health, "/v1/practice": {"state": "unavailable"}}
        return Reply(200, {}, json.dumps(replies[path]).encode())

    def close(self):
        pass


@dataclass(frozen=True)
class FakePlace(StationLocation):
    simulated: bool = False
    links: list = field(default_factory=list)

    def link(self):
        self.links.append(FakeLink(self.simulated))
        return self.links[-1]


@pytest.fixture
def facts(tmp_path):
    return {"key": None, "folder": tmp_path / "calibration", "spool": tmp_path, "store_url": "s"}


@pytest.fixture
def place(facts):
    return FakePlace(url="http://station", **facts)


@pytest.fixture
def runs(place):
    runs = CalibrationRuns(place)
    yield runs
    runs.close()


def until(runs, state):
    """Wait for a run's state; the run itself is in a thread."""
    import threading

    waiter = threading.Event()
    for _ in range(3000):
        if runs.status().state == state:
            return runs.status()
        waiter.wait(0.01)
    raise AssertionError(f"the run is {runs.status()}")


def test_one_run_at_a_time_and_none_writes_when_it_is_ended(runs, place):
    assert runs.status() is None
    with pytest.raises(NotFoundError, match="none was begun"):
        runs.present()
    runs.start(GLOVE)
    asking = until(runs, "asking")
    assert asking.question.startswith("Lay the left glove down")
    with pytest.raises(ConflictError, match="not done"):
        runs.start(GLOVE)
    assert runs.present().cancel().state == "cancelled"
    assert not place.folder.exists()
    with pytest.raises(ConflictError, match="asks nothing"):
        runs.present().answer("")
    runs.start(GLOVE)
    until(runs, "asking")


def test_a_text_is_refused_where_the_question_takes_none(runs):
    runs.start(GLOVE)
    until(runs, "asking")
    with pytest.raises(InvalidInputError, match="got the answer 'drop', expected one of"):
        runs.present().answer("drop")
    assert runs.status().state == "asking"


@pytest.mark.parametrize(
    ("request_", "error", "why"),
    [
        (RunRequest(kind="glove", subject="head"), InvalidInputError, "left or right"),
        (RunRequest(kind="camera", subject="left", board="chessboard:9x6:25mm"), InvalidInputError,
         "got 'left'"),
        (RunRequest(kind="camera", subject="head", board="paper"), UnknownNameError, "board"),
        (RunRequest(kind="time", subject="head"), InvalidInputError, "expected all"),
        (RunRequest(kind="mount", subject="head", board="chessboard:8x6:25mm"), InvalidInputError,
         "half a turn"),
        (RunRequest(kind="mount", subject="head", board="chessboard:9x6:25mm"), NotFoundError,
         "calibrate camera"),
    ],
)  # fmt: skip
def test_what_cannot_be_calibrated_is_refused_at_once(runs, request_, error, why):
    with pytest.raises(error, match=why):
        runs.start(request_)
    assert runs.status() is None


def test_without_a_station_nothing_is_begun_and_the_rest_is_shown(facts):
    place = StationLocation(url=None, **facts)
    with pytest.raises(InvalidInputError, match="DEXTOUCH_ALIGNMENT_STATION_URL"):
        CalibrationRuns(place).start(GLOVE)
    seen = overview(place)
    assert "DEXTOUCH_ALIGNMENT_STATION_URL" in seen.note
    assert [(item.name, item.state) for item in seen.items] == [("K_head", "missing")]


def test_simulated_devices_need_no_calibration_and_have_a_folder_of_their_own(facts):
    simulated = overview(FakePlace(url="http://station", simulated=True, **facts))
    assert simulated.folder == str(facts["folder"] / "practice")
    assert simulated.is_simulated
    assert {item.state for item in simulated.items} == {"simulated", "optional"}
    assert {item.run for item in simulated.items} == {None}
    assert overview(FakePlace(url="http://station", **facts)).folder == str(facts["folder"])


def test_what_is_there_is_judged_and_what_the_devices_need_is_missing(place):
    facts = {"rms_px": 0.213, "views_by_region": [[2, 3, 4], [5, 6, 7], [8, 9, 1]]}
    matrices = {"K_head": 500 * np.eye(3), "K_head_sigma_px": np.full(4, 0.5)}
    write_entry(place.folder, "K_head", matrices, facts)
    items = {item.name: item for item in overview(place).items}
    assert {name: item.state for name, item in items.items()} == {
        "tactile_left_tare_counts": "missing",
        "tactile_left_gain_counts_per_kpa": "missing",
        "K_head": "good",
        "T_tracker_head_camera_head": "missing",
        "hand_profile_left": "optional",
    }
    lens = items["K_head"]
    assert (lens.residual, lens.sigma) == ("0.21 px", "focal length 0.10%")
    assert "does not measure accuracy" in lens.meaning
    assert lens.views_by_region == ((2, 3, 4), (5, 6, 7), (8, 9, 1))
    assert lens.run == RunRequest(kind="camera", subject="head")
    mount = items["T_tracker_head_camera_head"]
    assert mount.run == RunRequest(kind="mount", subject="head")
    assert mount.num_kept_places == 0
    assert not overview(place).is_simulated


def test_a_delay_of_a_glove_is_measured_by_taps_and_does_not_stand_for_others(place, monkeypatch):
    monkeypatch.setattr("tests.unit.alignment.test_station_calibration.STREAMS", SHAKEN)

    def items(*streams):
        for stream in streams:
            write_entry(place.folder, f"{stream}_latency", {f"{stream}_latency_ns": 1e6}, {})
        return {item.name: item for item in overview(place).items}

    known = items("tactile_left", "keypoints_left")
    assert known["path_delays"].run == RunRequest(kind="time", subject="all")
    for name in ("tactile_left_latency_ns", "keypoints_left_latency_ns"):
        assert known[name].run is None
        assert "station calibrate latency --stream" in known[name].step
    known = items("camera_head")
    assert "path_delays" not in known
    assert known["camera_head_latency_ns"].run == RunRequest(kind="time", subject="all")


@pytest.mark.parametrize(
    ("stream", "command"),
    [("tactile_left", "latency"), ("keypoints_right", "latency"), ("head", "time")],
)
def test_the_advice_for_a_delay_of_unknown_age_names_the_command_that_measures_it(stream, command):
    (finding,) = judge({f"{stream}_latency_ns": ((1e6,),)})
    assert finding.reasons[0].endswith(f"dextouch station calibrate {command}")


def test_what_is_older_than_a_week_is_due(place):
    matrices = {"K_head": 500 * np.eye(3), "K_head_sigma_px": np.full(4, 0.5)}
    write_entry(place.folder, "K_head", matrices, {})
    path = place.folder / "calibration.json"
    stored = json.loads(path.read_text())
    old = datetime.now(UTC) - timedelta(days=9)
    stored["K_head_calibrated_at_unix_s"] = [[float(int(old.timestamp()))]]
    path.write_text(json.dumps(stored))
    (lens,) = (item for item in overview(place).items if item.name == "K_head")
    assert lens.state == "due"
    assert lens.age_days == pytest.approx(9, abs=0.01)
    assert "9 days old" in lens.reasons[0]
