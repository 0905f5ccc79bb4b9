"""The demo's takes: recorded in the twin, played through mock devices, aligned and compared.

The path is the real one: mock devices send packets, real drivers decode them, the recorder spools,
the uploader sends over HTTP, the alignment service creates the episode. The mock gloves know their
own tare and gain, and their script its path delay; all are measured the same as at a station, by a
rest take, known pressures and answers to time requests, so that errors contain those of a
calibration.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from dextouch.clients import EpisodeStoreClient, HttpLink
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.episodes.care import UPLOADS
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import ConflictError, InvalidInputError, UnavailableError
from dextouch.schemas import Matrix, RecordingAttributes, SaveTake, TakePrompt, matrix_rows
from dextouch.tactile.layout import NUM_TAXELS, SIDES, Side
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.mock_station import MockStation, MockTake
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.ledger import Fate
from services.acquisition.mocks.replay import ReplayStream, replay_calibration, replay_streams
from services.acquisition.path_latency import add_latencies
from services.acquisition.uploader import Uploader
from services.alignment.calibration.tactile_gain import TaxelPress, calibrate_glove
from services.alignment.calibration.tactile_tare import measure_tare
from services.alignment.recording_error import compare_with_truth, match_streams
from services.alignment.schemas import AlignmentJob
from services.cli.demo.settings import FIRST_HELD_OUT_SEED, TASKS, DemoPlan
from services.cli.training_data import Order, in_processes, make_episode
from services.evaluation.progress import Progress
from services.twin.cameras import CAMERAS
from services.twin.hands import Domain
from services.twin.take_options import TakeOptions

# The human stands a bottle, the robot stacks bowls, to cover one-handed and bimanual tasks.
RECORDED: dict[Domain, str] = {"human": "stand_bottle", "robot": "stack_bowls"}
MAX_PROCESSES = 4
STATION = "demo"
UPLOAD_PERIOD_S = 1.0
# The first alignment on a machine compiles the solver, which takes minutes where others use it too.
ALIGNMENT_TIMEOUT_S = 1800.0
PRESSURES_KPA = (10.0, 20.0, 40.0)
# A weight on an area is known to about this share.
PRESSURE_SIGMA = 0.01
PART_S = 2.0
# Readings next to a change of pressure are left out.
MARGIN_S = 0.2
MAX_MORE_TAKES = 3
CALIBRATION = TakePrompt(task="calibration", instruction="press all taxels")


@dataclass(frozen=True)
class Take:
    """A recorded and aligned take with its end-to-end errors."""

    episode: EpisodeReader
    errors: dict[str, Any]
    devices: list[dict[str, Any]]
    clock_residuals_ms: dict[str, np.ndarray]


def make_truth(plan: DemoPlan, store_folder: Path) -> tuple[list[str], list[str]]:
    """Record the true episodes in the twin, on all cores.

    Returns:
        Ids of the two takes, and of demonstrations to predict.
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
        for answer in in_processes(make_episode, orders, min(MAX_PROCESSES, os.cpu_count() or 1)):
            if answer.refusal is not None:
                raise InvalidInputError(f"{answer.episode_id}: {answer.refusal}")
            progress.advance()
    return [order.episode_id for order in takes], [order.episode_id for order in demonstrations]


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
    """Send every take of the spool to the store service."""
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
    link = HttpLink(alignment_url, timeout_s=ALIGNMENT_TIMEOUT_S)
    body = json.dumps({"recording_id": recording_id}).encode()
    try:
        answer = link.request("POST", "/v1/alignments?wait=true", body=body)
    except UnavailableError as error:
        raise UnavailableError(f"alignment of {recording_id}: {error.message}") from error
    finally:
        link.close()
    return AlignmentJob.model_validate_json(answer.body)


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
    for name, match in match_streams(episode, truth, origin_in_truth_ns).items():
        t_s = episode.read(name).t_ref_ns[match.index] * 1e-9
        residuals[name] = np.stack([t_s, (match.offset_ns - match.mean_offset_ns) * 1e-6])
    return Take(episode, errors, devices, residuals)


def measure_gloves(
    streams: Sequence[ReplayStream], spool_root: Path, *, seed: int
) -> dict[str, Matrix]:
    """Calibration matrices of the mock gloves that play these streams, path delays included.

    The take runs in real time, in which the station asks its gloves for their time.

    Args:
        streams: of the take that follows; its gloves are calibrated.
        spool_root: folder for the calibration takes.
        seed: of the mock station, whose gloves differ by seed, and of the errors of the pressures.

    Raises:
        UnavailableError: a glove's path delay could not be measured in several takes.
    """
    gloves = {side: s for s in streams for side in SIDES if s.descriptor.name == f"tactile_{side}"}
    if not gloves:
        return {}
    errors = np.random.default_rng([seed, len(PRESSURES_KPA)]).normal(size=len(PRESSURES_KPA))
    true_kpa = np.array([0.0, *(PRESSURES_KPA * (1 + PRESSURE_SIGMA * errors))])
    with MockStation(
        [_pressed(stream, true_kpa) for stream in gloves.values()],
        FaultScript.first_light(),
        seed,
        StationClock(),
        spool_root=spool_root,
    ) as station:
        take = station.run_take(CALIBRATION)
        found = _path_delays(station, [f"tactile_{side}" for side in gloves])
    for side in gloves:
        rest, *pressed = _parts(take, side)
        tare = measure_tare(rest, side=side)
        everywhere = np.ones(NUM_TAXELS, dtype=np.bool_)
        presses = [
            TaxelPress(kpa, PRESSURE_SIGMA * kpa, counts, everywhere)
            for kpa, counts in zip(PRESSURES_KPA, pressed, strict=True)
        ]
        matrices = calibrate_glove(tare, presses).matrices()
        found |= {name: matrix_rows(matrix) for name, matrix in matrices.items()}
    return found


def _path_delays(station: MockStation, names: list[str]) -> dict[str, Matrix]:
    """What the station measured by the answers of its gloves; a busy host may need more takes."""
    for _ in range(MAX_MORE_TAKES):
        if set(names) <= set(station.station.paths.latencies()):
            break
        station.run_take(CALIBRATION)
    measured = station.station.paths.latencies()
    missing = sorted(set(names) - set(measured))
    if missing:
        raise UnavailableError(
            f"demo: the path delays of {', '.join(missing)} could not be measured within "
            f"{1 + MAX_MORE_TAKES} takes; close other programs and run it again"
        )
    return add_latencies({}, {name: measured[name] for name in names}, stated=())


def _pressed(stream: ReplayStream, true_kpa: Float64[np.ndarray, " parts"]) -> ReplayStream:
    """The glove of a stream under one pressure after the other, the same on all taxels."""
    period_ns = stream.descriptor.period_ns()
    per_part = round(PART_S * 1e9 / period_ns)
    values = np.repeat(true_kpa.astype(np.float32), per_part)[:, None]
    t_ns = np.arange(len(values), dtype=np.int64) * period_ns
    return ReplayStream(stream.descriptor, t_ns, np.repeat(values, NUM_TAXELS, axis=1))


def _parts(take: MockTake, side: Side) -> Iterator[Float64[np.ndarray, "time 360"]]:
    """Counts of the rest and of every press."""
    spool, name = SpoolReader(take.spool_path), f"tactile_{side}"
    batch = spool.read(name)
    # By the number of the sample: when it came depends on the machine's other work.
    t_s = batch.sequence * (spool.streams[name].period_ns() * 1e-9)
    for part in range(1 + len(PRESSURES_KPA)):
        since_s = t_s - part * PART_S
        inside = (since_s >= MARGIN_S) & (since_s <= PART_S - MARGIN_S)
        yield batch.values[inside].astype(np.float64)
