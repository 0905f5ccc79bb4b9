"""Recording and alignment of true episodes through mock devices, with end-to-end errors.

The path is the real one: mock devices send packets, real drivers decode them, the recorder spools,
the uploader sends over HTTP, the alignment service creates the episode.
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.episodes.care import UPLOADS
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import ConflictError, InvalidInputError, UnavailableError
from dextouch.schemas import Problem, RecordingAttributes, SaveTake, TakePrompt, error_from_problem
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation, MockTake
from services.acquisition.mocks.episode import replay_calibration, replay_streams
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.ledger import Fate
from services.acquisition.uploader import Uploader
from services.alignment.recording_error import NEAR_NS, compare_with_truth, match_samples
from services.alignment.schemas import AlignmentJob
from services.cli.demo.calibrating import measure_gloves

# The first alignment on a machine compiles the solver, which takes minutes where others use it too.
ALIGNMENT_TIMEOUT_S = 1800.0
UPLOAD_PERIOD_S = 1.0
STATION = "demo"


@dataclass(frozen=True)
class Take:
    """A recorded and aligned take with its end-to-end errors."""

    episode: EpisodeReader
    errors: dict[str, Any]
    devices: list[dict[str, Any]]
    clock_residuals_ms: dict[str, np.ndarray]


def record_take(
    truth: EpisodeReader, spool_root: Path, *, seed: int
) -> tuple[MockTake, list[dict[str, Any]]]:
    """Replay the truth through all mock devices, with the faults of an ordinary station.

    The gloves are calibrated first, by a take of their own.

    Returns:
        The take in the spool, and for every device the mock's ledger beside the health counters.
    """
    attributes, streams = truth.attributes, replay_streams(truth)
    with tempfile.TemporaryDirectory(prefix="dextouch-calibration-") as folder:
        gloves = measure_gloves(streams, Path(folder), seed=seed)
    with MockStation(
        streams,
        FaultScript.first_light(),
        seed,
        VirtualClock(),
        spool_root=spool_root,
        name=STATION,
        calibration={**replay_calibration(truth), **gloves},
    ) as mock:
        take = mock.run_take(
            TakePrompt(
                task=attributes.task, instruction=attributes.instruction, domain=attributes.domain
            ),
            recording_id=f"demo-{attributes.domain}",
            how=SaveTake(success=attributes.success, accept_incomplete=True),
        )
        health = mock.station.health.report()
    return take, [_device_row(take, device.model_dump()) for device in health.devices]


def _device_row(take: MockTake, counters: dict[str, Any]) -> dict[str, Any]:
    ledger = take.ledger.of(counters["device"])
    return {
        "device": counters["device"],
        "sent": ledger.count(Fate.SENT),
        "dropped": ledger.count(Fate.DROPPED),
        "corrupted": ledger.count(Fate.CORRUPTED),
        "ledger_lost": ledger.count_lost_between(),
        "counted_packets": counters["packets"],
        "counted_lost": counters["lost"],
        "counted_crc_errors": counters["crc_errors"],
    }


def forget_take(store: EpisodeStore, recording_id: str) -> None:
    """Delete a take of an earlier run, complete or partial, and its derived episodes.

    Raises:
        ConflictError: another station's take has this id; nothing is removed.
    """
    half_sent = store.root / UPLOADS / recording_id
    if half_sent.exists():
        _check_own(SpoolReader(half_sent).attributes)
    if store.exists(recording_id, kind="recording"):
        _check_own(store.recording(recording_id).attributes)
    shutil.rmtree(half_sent, ignore_errors=True)
    for episode_id in store.list():
        if episode_id.startswith(f"{recording_id}-"):
            lineage = store.open(episode_id).attributes.lineage
            if recording_id in {entry.id for entry in lineage if entry.kind == "recording"}:
                store.delete(episode_id, for_good=True)
    if store.exists(recording_id, kind="recording"):
        store.delete(recording_id, kind="recording", for_good=True)


def _check_own(attributes: RecordingAttributes) -> None:
    if attributes.station != STATION:
        raise ConflictError(
            f"the demo would replace recording {attributes.recording_id!r}, which station "
            f"{attributes.station!r} made; name another folder by the variable DEXTOUCH_DATA"
        )


def upload(spool_root: Path, store_url: str) -> None:
    """Send every take of the spool to the store service.

    Raises:
        UnavailableError: a take could not be sent and remains in the spool.
    """
    with EpisodeStoreClient(store_url) as client:
        uploader = Uploader(spool_root, client, period_s=UPLOAD_PERIOD_S)
        uploader.upload_all()
        left = [status for status in uploader.status() if not status.uploaded]
    if left:
        raise UnavailableError(f"upload of {left[0].recording_id}: {left[0].error}")


def align(alignment_url: str, recording_id: str) -> AlignmentJob:
    """Align a recording with the alignment service, and wait for the job.

    Raises:
        DexTouchError: what the service refused, with its reason.
        UnavailableError: it does not answer.
    """
    try:
        answer = httpx.post(
            f"{alignment_url}/v1/alignments",
            params={"wait": "true"},
            json={"recording_id": recording_id},
            timeout=ALIGNMENT_TIMEOUT_S,
            trust_env=False,
        )
    except httpx.TransportError as error:
        raise UnavailableError(
            f"alignment of {recording_id}: no answer within {ALIGNMENT_TIMEOUT_S:.0f} s ({error!r})"
        ) from error
    if answer.is_error:
        raise error_from_problem(Problem.model_validate_json(answer.content))
    return AlignmentJob.model_validate_json(answer.content)


def measure(
    store: EpisodeStore,
    truth: EpisodeReader,
    take: MockTake,
    episode_id: str,
    *,
    devices: list[dict[str, Any]],
) -> Take:
    """Errors of the aligned episode against its truth."""
    episode = store.open(episode_id)
    started_ns = store.recording(take.recording_id).attributes.started_t_host_ns
    if started_ns is None:
        raise InvalidInputError(f"recording {take.recording_id}: no start time; record it again")
    origin_ns = started_ns + round(episode.attributes.quality["origin_after_start_ns"])
    origin_in_truth_ns = origin_ns - take.ledger.start_host_ns
    errors = compare_with_truth(episode, truth, origin_in_truth_ns=origin_in_truth_ns)
    residuals = {}
    for name in errors["clock_rms_ms"]:
        match = match_samples(episode, truth, name, origin_in_truth_ns, NEAR_NS)
        t_s = episode.read(name).t_ref_ns[match.index] * 1e-9
        residuals[name] = np.stack([t_s, (match.offset_ns - match.mean_offset_ns) * 1e-6])
    return Take(episode, errors, devices, residuals)
