"""The demo's takes: recorded in the twin, played through mock devices, aligned and compared."""

import json
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dextouch.clients import EpisodeStoreClient, HttpLink
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.episodes.maintenance import UPLOADS
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import ConflictError, InvalidInputError, UnavailableError
from dextouch.jobs import Workers, results_of, run_jobs
from dextouch.schemas import RecordingAttributes, TakePrompt
from services.acquisition.mock_station import MockTake
from services.acquisition.mocks.faults import Fate
from services.acquisition.mocks.replay import replay_streams
from services.acquisition.uploader import Uploader
from services.alignment.jobs import align_recording
from services.alignment.recording_error import compare_with_truth, match_streams
from services.alignment.schemas import AlignmentJob
from services.alignment.settings import AlignmentOptions
from services.episode_store.committing import commit_spool
from services.evaluation.progress import Progress
from services.pipelines.mock_takes import TakePlan, measure_gloves, origin_in_truth_ns, play_take
from services.pipelines.parsers import FIRST_HELD_OUT_SEED, TASKS, DemoPlan
from services.pipelines.training_data import Order, log_warnings, make_episode
from services.twin.names import CAMERAS, Domain
from services.twin.take_options import TakeOptions

# The human stands a bottle, the robot stacks bowls, to cover one-handed and bimanual tasks.
RECORDED: dict[Domain, str] = {"human": "stand_bottle", "robot": "stack_bowls"}
MAX_PROCESSES = 4
STATION = "demo"
UPLOAD_PERIOD_S = 1.0
# The first alignment on a machine compiles the solver, which takes minutes where others use it too.
ALIGNMENT_TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Take:
    """A recorded and aligned take with its end-to-end errors.

    `errors_true` are those of the same take aligned with the true calibration of its devices.
    """

    episode: EpisodeReader
    errors: dict[str, Any]
    errors_true: dict[str, Any]
    devices: list[dict[str, Any]]
    clock_residuals_ms: dict[str, np.ndarray]


def make_truth(plan: DemoPlan, store_folder: Path) -> tuple[list[str], list[str]]:
    """Record the true episodes in the twin, on all cores.

    Returns the ids of the two takes, and of demonstrations to predict.
    """
    store = str(store_folder)
    takes = [
        Order(task, domain, plan.take_seed, TakeOptions(), store)
        for domain, task in RECORDED.items()
    ]
    # At least two scenes, so that the actions of another one are available.
    scenes = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + plan.num_predicted)
    demonstrations = [
        Order(task, "robot", seed, TakeOptions(noise_m, images=CAMERAS[:1]), store)
        for noise_m in plan.predicted_noise_m
        for task in TASKS
        for seed in scenes
    ]
    orders = takes + demonstrations
    with Progress("episodes", len(orders)) as progress:
        workers = Workers(min(MAX_PROCESSES, os.cpu_count() or 1))
        for answer in results_of(run_jobs(make_episode, orders, workers, prepare=log_warnings)):
            if answer.refusal is not None:
                raise InvalidInputError(f"{answer.episode_id}: {answer.refusal}")
            progress.advance()
    return [order.episode_id for order in takes], [order.episode_id for order in demonstrations]


def record_take(
    truth: EpisodeReader, spool_root: Path, *, seed: int
) -> tuple[MockTake, list[dict[str, Any]]]:
    """Replay the truth through all mock devices, with the faults of an ordinary station.

    The gloves are calibrated first, by a take of their own. Returns the take in the spool, and for
    every device the mock's ledger beside the health counters.
    """
    attributes, streams = truth.attributes, replay_streams(truth)
    with tempfile.TemporaryDirectory(prefix="dextouch-calibration-") as folder:
        gloves = measure_gloves(streams, Path(folder), seed=seed)
    plan = TakePlan(
        streams,
        TakePrompt(
            task=attributes.task, instruction=attributes.instruction, domain=attributes.domain
        ),
        attributes.success,
        calibration={**truth.attributes.matrices(), **gloves},
        recording_id=f"demo-{attributes.domain}",
        seed=seed,
        unit_seed=seed,
    )
    take, devices = play_take(plan, spool_root, station=STATION)
    return take, [_device_row(take, device.model_dump()) for device in devices]


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

    Raises ConflictError if another station's take has this id; nothing is removed.
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
    """Send every take of the spool to the store service."""
    with EpisodeStoreClient(store_url) as client:
        uploader = Uploader(spool_root, client, period_s=UPLOAD_PERIOD_S)
        uploader.upload_all()
        left = [status for status in uploader.status() if not status.uploaded]
    if left:
        raise UnavailableError(f"upload of {left[0].recording_id}: {left[0].error}")


def align(alignment_url: str, recording_id: str) -> AlignmentJob:
    """Align a recording with the alignment service, and wait for the job.

    Raises what the service refused, with its reason, or UnavailableError if it does not answer.
    """
    link = HttpLink(alignment_url, timeout_s=ALIGNMENT_TIMEOUT_S)
    body = json.dumps({"recording_id": recording_id}).encode()
    try:
        answer = link.request("POST", "/v1/alignments?wait=true", body=body)
    except UnavailableError as error:
        raise UnavailableError(f"alignment of {recording_id}: {error.message}") from error
    finally:
        link.close()
    return AlignmentJob.model_validate_json(answer.body)


def align_truly(take: MockTake, store: EpisodeStore, options: AlignmentOptions) -> EpisodeReader:
    """Align a take of the spool as if its calibration had no error; a store gets both."""
    attributes = SpoolReader(take.spool_path).attributes
    calibration = {**attributes.calibration, **take.true_calibration}
    commit_spool(store, take.spool_path, attributes.model_copy(update={"calibration": calibration}))
    return store.open(align_recording(store, take.recording_id, options).episode_id)


def errors_of(
    store: EpisodeStore, episode_id: str, truth: EpisodeReader, take: MockTake
) -> tuple[int, dict[str, Any]]:
    """Time 0 of an aligned episode on the truth's time axis, and its errors against the truth."""
    episode = store.open(episode_id)
    started_ns = store.recording(take.recording_id).attributes.started_t_host_ns
    if started_ns is None:
        raise InvalidInputError(f"recording {take.recording_id}: no start time; record it again")
    origin_ns = origin_in_truth_ns(
        take, started_t_host_ns=started_ns, quality=episode.attributes.quality
    )
    return origin_ns, compare_with_truth(episode, truth, origin_in_truth_ns=origin_ns)


def clock_residuals_ms(
    episode: EpisodeReader, truth: EpisodeReader, origin_ns: int
) -> dict[str, np.ndarray]:
    """Times (s) of every stream's samples and their errors without the mean."""
    residuals = {}
    for name, match in match_streams(episode, truth, origin_ns).items():
        t_s = episode.read(name).t_ref_ns[match.index] * 1e-9
        residuals[name] = np.stack([t_s, (match.offset_ns - match.mean_offset_ns) * 1e-6])
    return residuals
