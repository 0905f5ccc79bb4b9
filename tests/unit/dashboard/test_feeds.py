"""Feeds turn what services answer into views, and absence into words, never into old numbers."""

import json
import re
from pathlib import Path

import httpx
import numpy as np
import pytest
from dashboard_fakes import PRESSURES, broken_upstream

from dextouch.errors import ConflictError, NotFoundError, UnavailableError, UnknownNameError
from dextouch.schemas.station import HealthEvents
from dextouch.streams import pack
from services.dashboard import app
from services.dashboard.feeds import Feeds
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream


@pytest.fixture
def feeds(upstreams):
    return Feeds(upstreams, DashboardSettings())


async def test_station(feeds):
    view = await feeds.station()
    assert (view.reachable, view.level, view.summary) == (True, "OK", "1 of 1 streams OK")
    (stream,) = view.streams
    assert (stream.name, stream.dropped, stream.drop_percent) == ("tactile_left", 2, 0.2)
    assert (stream.skew_ppm, stream.clock_error_ms) == (None, None)
    assert view.recorder.actions == ("arm",)


async def test_worst_level_leads(feeds, services):
    levels = ("OK", "STALE", "WARN")
    devices = ("head", "glove_left", "camera_head")
    streams = zip(levels, devices, strict=True)
    services.health["streams"] = [services.stream | {"level": a, "device": b} for a, b in streams]
    view = await feeds.station()
    assert (view.level, view.summary) == ("STALE", "1 of 3 streams OK")


def raised(code, level, message):
    return {"code": code, "level": level, "message": message, "advice": "Move.", "lasted_s": 1.0}


async def test_what_follows_from_a_cause_is_folded_below_it(feeds, services):
    findings = [raised("gap", "ERROR", "0.6 s without a sample"), raised("nan", "WARN", "2 % nan")]
    findings.append(raised("rate", "WARN", "55 Hz, expected 60 Hz"))
    services.health["streams"] = [
        services.stream | {"level": "ERROR", "findings": findings},
        services.stream | {"stream": "head", "device": "tracker", "level": "OK"},
    ]
    cause = {"code": "host", "subject": "", "level": "ERROR", "message": "Overloaded: 9 tasks"}
    cause |= {"advice": "Close programs.", "lasted_s": 7.0, "streams": ["tactile_left"]}
    services.health["causes"] = [cause | {"findings": ["gap", "rate", "overload"]}]
    services.health["figures"] = {"host_cpu_ratio": 0.98, "disk_free_bytes": 5e9}
    view = await feeds.station()
    (shown,) = view.causes
    assert (shown.level, shown.message) == ("ERROR", "Overloaded: 9 tasks")
    assert (shown.advice, shown.lasted_s) == ("Close programs.", 7.0)
    assert shown.streams == ("tactile_left",)
    assert shown.findings == ("tactile_left: 0.6 s without a sample · 55 Hz, expected 60 Hz",)
    assert view.summary == "1 cause · 1 of 2 streams OK"
    assert (view.host.level, view.host.cpu_percent, view.host.wake_ms) == ("ERROR", 98.0, None)
    assert view.host.disk_free_gb == 5.0


async def test_a_cause_that_says_all_has_nothing_folded(feeds, services):
    services.stream |= {"level": "STALE", "findings": [raised("silent", "STALE", "no data")]}
    services.device |= {"reconnects": 3, "last_error": "gone", "suspects": 4}
    cause = {"code": "gone", "subject": "glove_left", "level": "STALE", "lasted_s": 7.0}
    cause |= {"message": "glove_left: no data", "advice": "Look.", "streams": ["tactile_left"]}
    services.health["causes"] = [cause | {"findings": ["silent"]}]
    view = await feeds.station()
    assert view.causes[0].findings == ()
    assert view.streams[0].note == "3 reconnects · 4 packets held back · gone"


async def test_the_stations_own_finding_is_a_cause_and_sets_the_level(feeds, services):
    services.health["findings"] = [raised("disk", "ERROR", "the disk is full in 4 minutes")]
    cause = {"code": "station", "subject": "disk", "level": "ERROR", "lasted_s": 7.0}
    cause |= {"message": "the disk is full in 4 minutes", "advice": "Delete takes."}
    services.health["causes"] = [cause]
    view = await feeds.station()
    assert (view.level, view.host.level, view.streams[0].level) == ("ERROR", "ERROR", "OK")
    assert view.causes[0].streams == ()


async def test_trends_are_shares_of_the_nominal_rate(feeds, services):
    rows = np.full((2, 2, 5), np.nan, np.float32)
    rows[0, 1] = [60, 60, 30, 60, 66]
    rows[1, 1, 3:] = [100, 90]
    fields = {"stream_series": ["level", "rate_hz"]}
    fields["nominal_rate_hz"] = {"tactile_left": 60.0, "head": 100.0}
    services.history = pack(fields, {"streams": rows})
    (message,) = await feeds.topics["trends"].newest()
    trends = json.loads(message)["data"]
    assert trends == {"tactile_left": [0.5, 1.0], "head": [None, 0.9]}


async def test_incomplete_take_is_shown(feeds, services):
    problem = {"stream": "head", "code": "gap", "level": "ERROR", "message": "head: 0.4 s gap"}
    services.recorder = {
        "state": "checking",
        "actions": ["save", "discard"],
        "recording_id": "take-7",
        "duration_s": 5.5,
        "check": {"complete": False, "duration_s": 5.5, "streams": [], "problems": [problem]},
    }
    recorder = (await feeds.station()).recorder
    assert (recorder.complete, recorder.level, recorder.elapsed_s) == (False, "ERROR", 5.5)
    # Without a cause from the station, its worst finding stands in.
    assert (recorder.cause, recorder.advice) == ("head: 0.4 s gap", "")
    assert (recorder.recording_id, recorder.problems) == ("take-7", ("head: 0.4 s gap",))


async def test_the_worst_of_a_take_leads(feeds, services):
    levels = {"b: 2 % lost": "WARN", "head: 0.4 s gap": "ERROR", "a: 1 % lost": "WARN"}
    levels["head: 9 Hz"] = "WARN"
    problems = [
        {"stream": text.partition(":")[0], "code": "gap", "level": level, "message": text}
        for text, level in levels.items()
    ]
    services.recorder = {
        "state": "checking",
        "actions": ["save", "discard"],
        "recording_id": "take-7",
        # The check's findings are repeated here, after what the recorder says itself.
        "problems": ["the disk is full", *levels],
        "check": {"complete": False, "duration_s": 5.5, "streams": [], "problems": problems}
        | {"cause": {"message": "hub 1: nothing comes", "advice": "Plug it in again."}},
    }
    recorder = (await feeds.station()).recorder
    assert (recorder.cause, recorder.advice) == ("hub 1: nothing comes", "Plug it in again.")
    assert recorder.num_findings == 5
    assert recorder.problems == (
        "the disk is full",
        "head: 0.4 s gap · 9 Hz",
        "b: 2 % lost",
        "a: 1 % lost",
    )


async def test_absent_station_shows_no_numbers():
    view = await Feeds(
        {"acquisition": broken_upstream("acquisition")}, DashboardSettings()
    ).station()
    assert (view.reachable, view.level, view.streams) == (False, "STALE", ())
    (cause,) = view.causes
    assert (view.note, cause.level) == ("", "STALE")
    assert cause.message == "This station does not answer."
    assert "(http://fake)" in cause.advice
    assert "acquisition: no answer to GET" in cause.findings[0]


async def test_answer_of_another_form_is_named(feeds, services):
    services.stream["level"] = "FINE"
    view = await feeds.station()
    assert not view.reachable
    (cause,) = view.causes
    assert "unexpected response to GET /v1/health (streams.0.level: " in cause.message


async def test_services(upstreams):
    upstreams["twin"] = broken_upstream("twin")
    views = await Feeds(upstreams, DashboardSettings()).services()
    assert [(view.name, view.level) for view in views] == [
        ("acquisition", "OK"),
        ("episode_store", "OK"),
        ("twin", "ERROR"),
    ]
    assert views[2].message == "no answer (ConnectError)"


async def test_takes(feeds):
    (take,) = (await feeds.takes()).takes
    assert (take.kind, take.name, take.outcome) == ("episode", "take-0001", "not judged")
    assert (take.operator, take.consent, take.size) == (None, None, "5.4 s, 81 steps")
    assert take.clocks == "skew to 50 ppm, residual to 0.06 ms, 3 samples lost"


async def test_an_episode_is_asked_about_once(feeds, services):
    await feeds.takes()
    await feeds.takes()
    assert services.asked.count("/v1/episodes/take-0001") == 1


async def test_the_newest_of_many_are_shown(feeds, services):
    (episode,) = services.episodes
    # The last hours of a day, whose names are not in the order of time.
    services.episodes = [
        episode | {"episode_id": f"take-{n * 7 % 20:04d}", "created_at": f"2026-05-04T{n:02d}:00Z"}
        for n in range(20)
    ]
    takes = (await feeds.takes()).takes
    names = ["take-0013", "take-0006", "take-0019", "take-0012", "take-0005", "take-0018"]
    assert [take.name for take in takes] == names


async def test_a_foreign_list_is_no_crash(feeds, services):
    services.episodes = [{"name": "?"}]
    view = await feeds.takes()
    assert view.takes == ()
    assert view.note.startswith("The store does not list its takes: episode_store: unexpected")


async def test_why_no_take_is_shown_is_said(feeds, services):
    services.episodes = []
    assert (await feeds.takes()).note == "Nothing stored yet."
    without = await Feeds({}, DashboardSettings()).takes()
    assert "DEXTOUCH_DASHBOARD_EPISODE_STORE_URL" in without.note


async def test_a_recording_is_shown_with_its_labels(feeds, services):
    services.recordings = [
        {
            "recording_id": "take-2",
            "task": "stack_bowls",
            "domain": "human",
            "station": "desk",
            "operator": "p7",
            "consent": True,
            "success": False,
            "num_samples": {"head": 300, "wrist_left": 200},
            "duration_s": 3.0,
            "content_sha256": "b" * 64,
        }
    ]
    take = (await feeds.takes()).takes[-1]
    assert (take.name, take.operator, take.consent, take.outcome) == (
        "take-2",
        "p7",
        True,
        "failure",
    )
    assert take.size == "3.0 s, 500 samples, 2 streams"


async def test_operate(feeds, services):
    answer = await feeds.operate("arm", {"task": "stack_bowls", "instruction": "stack"})
    assert (answer.state, answer.actions) == ("armed", ("record", "discard"))
    assert services.asked[-1] == {"task": "stack_bowls", "instruction": "stack"}


async def test_refusal_keeps_its_class(feeds):
    with pytest.raises(ConflictError, match="got state idle, expected armed"):
        await feeds.operate("record", {})


async def test_unknown_action(feeds):
    with pytest.raises(
        UnknownNameError, match="valid: arm, discard, record, rerecord, save, session, stop"
    ):
        await feeds.operate("../health", {})


async def test_missing_service_is_named():
    feeds = Feeds({}, DashboardSettings())
    with pytest.raises(NotFoundError, match="DEXTOUCH_DASHBOARD_ACQUISITION_URL"):
        feeds.upstream("acquisition")


async def test_taxel_messages_carry_the_pressures(feeds):
    messages = await feeds.topics["taxels"].newest()
    assert [message[0] for message in messages] == [1, 1]
    for index, side in enumerate(("left", "right")):
        message = messages[index]
        assert message[1] == index
        assert int.from_bytes(message[2:4], "little") == 320
        np.testing.assert_array_equal(np.frombuffer(message[4:], "<f4"), PRESSURES[side])


async def test_a_glove_that_is_not_heard_clears_its_map(feeds, services):
    services.pressures.pop("left")
    left, right = await feeds.topics["taxels"].newest()
    assert left == bytes([1, 0, 0, 0])
    assert len(right) == 4 + 4 * 320


@pytest.mark.parametrize("topic", ["taxels", "poses"])
async def test_lost_live_data_is_said(topic):
    feeds = Feeds({"acquisition": broken_upstream("acquisition")}, DashboardSettings())
    (message,) = await feeds.topics[topic].newest()
    assert json.loads(message)["topic"] == f"{topic}_lost"


async def test_pose_messages_say_the_age_of_every_tracker(feeds):
    (message,) = await feeds.topics["poses"].newest()
    length = int.from_bytes(message[2:4], "little")
    assert (message[0], length % 4) == (2, 0)
    rows = json.loads(message[4 : 4 + length])
    assert rows == [["head", None, 0], ["wrist_left", 0.02, 16]]
    np.testing.assert_array_equal(np.frombuffer(message[4 + length :], "<f4"), np.eye(4).ravel())


def test_the_page_draws_every_topic(feeds):
    page = Path(app.STATIC / "station.js").read_text(encoding="utf-8")
    handlers = page.split("const topics = {")[1].split("\n};")[0]
    # Taxels and poses are bytes, with handlers of their own; studies are on other pages.
    assert set(feeds.topics) - {"taxels", "poses", "studies"} <= set(
        re.findall(r"^  (\w+):", handlers, re.MULTILINE)
    )


async def test_a_station_of_a_later_release_may_say_more():
    """Unknown fields, nested ones too, are left out; missing ones are an answer of another form."""
    event = {"t_host_ns": 1, "stream": "head", "code": "silent", "level": "WARN"}

    def answer(request):
        events = [event | {"colour": "red"}] if request.url.path == "/more" else [{"code": "x"}]
        return httpx.Response(200, json={"events": events, "now_ns": 2, "page": 2})

    transport = httpx.MockTransport(answer)
    station = Upstream("station", httpx.AsyncClient(transport=transport, base_url="http://fake"))
    assert (await station.read(HealthEvents, "/more")).events[0].stream == "head"
    with pytest.raises(UnavailableError, match="station"):
        await station.read(HealthEvents, "/less")
