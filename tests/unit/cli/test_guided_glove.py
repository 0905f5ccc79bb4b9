"""`dextouch station calibrate glove --url`: a recorder, an operator who errs, a calibration."""

import json
from argparse import Namespace
from dataclasses import dataclass, field

import numpy as np
import pytest

from dextouch.clients import Reply
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas import SaveTake, TakeName, TakePrompt
from dextouch.streams import Sample
from services.acquisition.clock import VirtualClock
from services.acquisition.devices import load_calibration
from services.acquisition.devices.tactile_glove import TactileGloveDecoder
from services.acquisition.drivers.base import Driver
from services.acquisition.mocks.gloves import GloveCalibration
from services.acquisition.mocks.ports import PtyPort
from services.acquisition.recorder import Recorder
from services.acquisition.station import LiveView
from services.alignment.calibration.tactile_tare import TactileCalibration
from services.alignment.station_calibration import glove
from services.alignment.station_calibration.record import TakeRecorder
from services.pipelines.calibrate import main

TRUTH = GloveCalibration.seeded("left", 4)


@dataclass
class Bench:
    """A station's recorder behind its routes, its glove, and what lies on the glove."""

    recorder: Recorder
    clock: VirtualClock
    kpa: np.ndarray
    sent: list[str]
    uploaded: bool = False
    num_samples: int = 0
    creeps: bool = False
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def request(self, method, path, *, body=None):
        """As the station's routes."""
        self.sent.append(f"{method} {path}")
        if path == "/v1/uploads":
            take = {"recording_id": self.recorder.status().recording_id, "uploaded": self.uploaded}
            return Reply(200, {}, json.dumps([take]).encode())
        kinds = {"arm": TakePrompt, "save": SaveTake}
        action = path.removeprefix("/v1/recorder/")
        asked = kinds.get(action, TakeName).model_validate_json(body)
        argument = asked if action in kinds else asked.recording_id
        status = getattr(self.recorder, action)(argument)
        return Reply(200, {}, status.model_dump_json().encode())

    def wait(self, seconds):
        """The glove goes on sending while the command waits."""
        for _ in range(round(60 * seconds)):
            self.num_samples += 1
            kpa = self.kpa * (1 + 0.01 * self.num_samples * self.creeps)
            counts = TRUTH.counts(kpa[None], side="left")[0].astype(float)
            noise = self.rng.normal(scale=2.0, size=360)
            values = np.rint(counts + noise).clip(0, 65535).astype(np.uint16)
            now_ns = self.clock.now_ns()
            sample = Sample(now_ns, values, now_ns, self.num_samples)
            self.recorder.take.accept({"tactile_left": [sample]})
            waiter = self.clock.waiter(drives_time=True)
            waiter.wait_until(now_ns + 16_666_667)
            waiter.close()


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.setattr(glove, "REST_S", 2.0)
    monkeypatch.setattr(glove, "PRESS_S", 1.5)
    clock = VirtualClock(10**9)
    decoder = TactileGloveDecoder("left")
    driver = Driver("glove_left", transport=PtyPort("a").transport, decoder=decoder, clock=clock)
    recorder = Recorder(
        station="test",
        spool_root=tmp_path / "spool",
        drivers=[driver],
        clock=clock,
        calibration={},
    )
    return Bench(recorder, clock, np.zeros(320), [])


def options(tmp_path, **changed):
    given = {
        "side": "left",
        "to": tmp_path / "to",
        "url": "http://station",
        "key": None,
        "spool": tmp_path / "spool",
        "store": None,
        "rest": None,
        "presses": None,
        "pressure_sigma": 0.02,
        "full_scale": 65535.0,
    }
    return Namespace(**given | changed)


def operator(bench, script):
    """Answers questions; each answer comes with what then lies on the glove (None: as before)."""
    asked = []

    def ask(question):
        asked.append(question.text)
        if len(asked) > len(script):
            raise EOFError
        answer, kpa = script[len(asked) - 1]
        bench.kpa = bench.kpa if kpa is None else np.full(320, float(kpa))
        return answer

    return ask, asked


def recorder(bench, given, wait=None):
    return TakeRecorder(
        bench.request, glove.TASK, spool=given.spool, store=given.store, wait=wait or bench.wait
    )


def guide(bench, tmp_path, script, monkeypatch, **changed):
    """The whole command with a fake link and operator."""
    ask, asked = operator(bench, script)
    given = options(tmp_path, **changed)
    leads = glove.Guide(given, recorder(bench, given), ask=ask)
    record = glove.record_takes
    monkeypatch.setattr(glove, "record_takes", lambda o, _: record(o, leads))
    return glove.calibrate(given), asked


@pytest.mark.long
def test_an_operator_is_led_to_a_calibration(bench, tmp_path, monkeypatch, capsys):
    script = [
        ("", 0.0),
        ("ten", None),
        ("10 toe", None),
        ("10", None),
        # Forgot to press: told and asked again.
        ("", 0.0),
        ("10", None),
        ("", 10.0),
        # A slip of a digit, 3 kPa: told at once. One of 15 kPa: nothing fits.
        ("2kg/65.38cm2", None),
        ("", 30.0),
        ("2kg/13.08cm2", None),
        ("", 30.0),
        ("drop", None),
        ("2kg/6.538cm2", None),
        ("", 30.0),
        ("", None),
    ]
    report, asked = guide(bench, tmp_path, script, monkeypatch)
    said = capsys.readouterr().out
    assert len(asked) == len(script)
    assert "Lay the left glove down" in asked[0]
    assert "Put 10 kPa on all" in asked[4]
    assert "got 'ten', expected 30, or" in said
    assert "toe" in said
    assert "Not used: gain: no pressed taxel moved" in said
    assert "Not used: gain: the presses make" in said
    assert "times too low" in said
    assert "2 presses, not enough yet: gain: the response of all taxels" in said
    assert "pressures probably do not belong" in said
    assert "1 presses are left" in said
    assert "2 presses: 320 of 320 taxels known" in said
    assert report["num_by_state"] == {"ok": 320}
    assert f"CALIBRATION={tmp_path / 'to/calibration.json'}" in said
    found = TactileCalibration.from_record(
        load_calibration(tmp_path / "to/calibration.json"), "left"
    )
    gain_error = found.gain_counts_per_kpa / TRUTH.gain_counts_per_kpa[found.cells] - 1
    assert np.abs(gain_error).max() < 0.02
    # The good takes are there, the dropped one too; the kept list repeats the calibration.
    assert len(list((tmp_path / "spool").glob("*/"))) == 4
    rows = glove.read_presses(tmp_path / "to/presses_left.csv", 0.02)
    assert [round(row.pressure_kpa, 2) for row in rows] == [10.0, 30.0]
    arguments = [
        "glove",
        "--side",
        "left",
        "--rest",
        report["rest_take"],
        "--to",
        str(tmp_path / "b"),
    ]
    arguments += ["--presses", str(tmp_path / "to/presses_left.csv")]
    assert main(arguments) == 0
    again, first = (
        load_calibration(tmp_path / f"{where}/calibration.json") for where in ("b", "to")
    )
    name = "tactile_left_gain_counts_per_kpa"
    assert again[name] == first[name]


@pytest.mark.long
def test_a_glove_that_was_touched_rests_once_more(bench, tmp_path, monkeypatch, capsys):
    bench.creeps = True
    ask, _ = operator(bench, [("", 20.0), ("", 0.0), ("", None)])
    given = options(tmp_path)
    leads = glove.Guide(given, recorder(bench, given), ask=ask)
    rest, rows = glove.record_takes(given, leads)
    assert rows == []
    assert rest.endswith("-2")
    assert "Once more: rest take" in capsys.readouterr().out
    # What was not good was thrown away.
    kept = [take.name for take in (tmp_path / "spool").glob("*/")]
    assert kept == [rest.rsplit("/", 1)[-1]]


def test_presses_that_do_not_hold_are_not_used(bench, tmp_path, capsys):
    ask, _ = operator(bench, [("", 0.0), ("20", None), ("", 20.0), ("", None)])

    def creeping(question):
        bench.creeps = "Put" in question.text
        return ask(question)

    given = options(tmp_path)
    leads = glove.Guide(given, recorder(bench, given), ask=creeping)
    _, rows = glove.record_takes(given, leads)
    assert rows == []
    assert "changed while it lay" in capsys.readouterr().out


def test_interrupted_takes_are_discarded(bench, tmp_path):
    def interrupted(_):
        raise KeyboardInterrupt

    takes = recorder(bench, options(tmp_path), wait=interrupted)
    with pytest.raises(KeyboardInterrupt):
        takes.record("take-1", "rest", 1.0, str.upper)
    assert bench.recorder.status().state == "discarded"
    assert list((tmp_path / "spool").iterdir()) == []


def test_a_busy_recorder_is_left_alone(bench, tmp_path):
    bench.recorder.arm(TakePrompt(task="t", instruction="i"))
    bench.recorder.record("other")
    takes = recorder(bench, options(tmp_path))
    with pytest.raises(ConflictError, match="while recording"):
        takes.record("take-1", "rest", 1.0, str.upper)
    assert bench.recorder.status().recording_id == "other"


def test_takes_of_another_machine_come_from_the_store(bench, tmp_path):
    elsewhere = options(tmp_path, spool=tmp_path / "not-here")
    takes = recorder(bench, elsewhere)
    with pytest.raises(NotFoundError, match=r"--spool.*--store"):
        takes.record("take-1", "rest", 1.0, str.upper)
    bench.uploaded = True
    takes = recorder(bench, options(tmp_path, spool=tmp_path / "not-here", store="http://store"))
    assert takes.record("take-2", "rest", 1.0, str.upper) == ("take-2", "TAKE-2")
    assert bench.sent[-1] == "GET /v1/uploads"


def test_takes_of_practice_devices_on_another_machine_are_not_waited_for(bench, tmp_path):
    there = TakeRecorder(
        bench.request, "t", spool=tmp_path, store="s", is_practice=True, wait=bench.wait
    )
    with pytest.raises(NotFoundError, match="practice devices are not uploaded; run the alignment"):
        there.record("a", "words", 0.1, str)
    assert "GET /v1/uploads" not in bench.sent


def test_nobody_there_and_contradicting_options_are_refused(bench, tmp_path):
    given, ask = options(tmp_path), operator(bench, [])[0]
    leads = glove.Guide(given, recorder(bench, given), ask=ask)
    with pytest.raises(InvalidInputError, match="nobody answers"):
        glove.record_takes(given, leads)
    with pytest.raises(InvalidInputError, match="one of the two"):
        glove.calibrate(options(tmp_path, rest="take"))
    with pytest.raises(InvalidInputError, match="--url of a running station"):
        glove.calibrate(options(tmp_path, url=None))


@pytest.mark.parametrize(
    ("words", "kpa", "pads"),
    [
        ("30", 30.0, "all"),
        ("7.5 kPa palm", 7.5, "palm"),
        ("12 thumb+index", 12.0, "thumb+index"),
        ("2kg/90cm2 palm", 2 * 9.80665 / 9.0, "palm"),
    ],
)
def test_pressures_as_they_are_typed(words, kpa, pads):
    row = glove.parse_press(words, 0.02)
    assert row.pressure_kpa == pytest.approx(kpa)
    assert row.sigma_kpa == pytest.approx(0.02 * kpa)
    assert row.pads == pads


@pytest.mark.parametrize("words", ["0", "-3", "3 3", "1.2.3", "2kg", "2kg/0cm2", "palm", "kpa"])
def test_what_is_no_pressure_is_refused(words):
    with pytest.raises(InvalidInputError, match="pressure: got"):
        glove.parse_press(words, 0.02)
    with pytest.raises(UnknownNameError):
        glove.parse_press("3 toe", 0.02)


def test_a_station_starts_before_its_gloves_are_calibrated(bench):
    """Else nobody could record the takes that a calibration needs."""
    drivers = list(bench.recorder._drivers.values())
    assert LiveView(drivers, {})._gloves == {}
    tare = {"tactile_left_tare_counts": ((1.0,) * 360,)}
    assert LiveView(drivers, tare)._gloves == {}
    with pytest.raises(NotFoundError, match=r"tactile_left_gain.*got 3 numbers"):
        LiveView(drivers, tare | {"tactile_left_gain_counts_per_kpa": ((1.0,) * 3,)})


@pytest.mark.parametrize("share", [-0.02, float("nan"), float("inf")])
def test_a_share_that_is_no_sigma_is_refused(share):
    with pytest.raises(InvalidInputError, match="pressure sigma: got"):
        glove.PressRow(take="press", pressure_kpa=10).known_to(share)
