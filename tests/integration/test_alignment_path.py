"""Truth → mock station → bytes → spool → store → alignment: the errors of the whole path."""

import sys

import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.schemas import TakePrompt
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.replay import ReplayStream
from services.alignment.jobs import align_recording
from services.alignment.recording_error import compare_with_truth
from services.alignment.settings import AlignmentOptions
from tests.accuracy.test_alignment import K_HEAD, write_truth


@pytest.mark.parametrize("domain", ["human", pytest.param("robot", marks=pytest.mark.slow)])
def test_whole_path_keeps_the_truth(domain, tmp_path, capsys):
    store = EpisodeStore(tmp_path / "store")
    streams = [ReplayStream(*stream) for stream in write_truth(store, domain).values()]
    with MockStation(
        streams,
        FaultScript.first_light(),
        1,
        VirtualClock(),
        spool_root=tmp_path / "spool",
        calibration={"K_head": K_HEAD},
    ) as station:
        prompt = TakePrompt(task="stand-bottle", instruction="stand it up", domain=domain)
        take = station.run_take(prompt, recording_id="take")
    spool = SpoolReader(take.spool_path)
    torn = {"complete": False, "incomplete_cause": "head: 0.3 s without a sample"}
    attributes = spool.attributes.model_copy(update={"streams": ()} | torn)
    with store.writer(kind="recording", attributes=attributes) as writer:
        for name, stream in spool.streams.items():
            batch = spool.read(name)
            writer.add_stream(stream)
            writer.append(
                name,
                values=batch.values,
                t_host_ns=batch.t_host_ns,
                t_device_ns=batch.t_device_ns,
                sequence=batch.sequence,
            )
    report = align_recording(store, "take", AlignmentOptions())
    start_ns = attributes.started_t_host_ns + round(report.quality["origin_after_start_ns"])
    errors = compare_with_truth(
        store.open(report.episode_id),
        store.open(f"truth-{domain}"),
        origin_in_truth_ns=start_ns - take.ledger.start_host_ns,
    )
    rows = [
        ("clock RMS, worst stream, ms", max(errors["clock_rms_ms"].values()), 1.0),
        ("1 - taxel IoU", 1 - errors["taxel_iou"], 0.02),
        ("wrist, mm", errors["wrist_error_mm"], 1.0),
        ("wrist, deg", errors["wrist_error_deg"], 0.1),
        ("fingertip, mm", errors["fingertip_error_mm"], 2.5),
    ]
    with capsys.disabled():
        for name, error, bound in rows:
            sys.stdout.write(f"\npath {domain:5s} {name:28s} {error:8.4f} | bound {bound}")
    assert all(error <= bound for _, error, bound in rows)
    assert report.num_steps >= 80
    about = store.open(report.episode_id).attributes
    assert {name: getattr(about, name) for name in torn} == torn
