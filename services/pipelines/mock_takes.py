"""Takes of the twin recorded by a mock station: packets, real drivers, recorder and spool.

Tare, gain and path delay are measured as at a station, by a rest take, known pressures and answers
to time requests, so that errors contain those of a calibration.
"""

import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import EpisodeStore
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError, UnavailableError
from dextouch.geometry import nearest_index
from dextouch.schemas import (
    DeviceHealth,
    EpisodeAttributes,
    Matrix,
    SaveTake,
    SceneObjects,
    TakePrompt,
    matrix_rows,
    object_stream,
)
from dextouch.tactile.layout import SIDES, Side
from services.acquisition.clock import StationClock, VirtualClock
from services.acquisition.mock_station import MockStation, MockTake
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.mocks.pattern import pattern_streams
from services.acquisition.mocks.replay import PLAYED_KINDS, ReplayStream
from services.acquisition.watches import add_latencies
from services.alignment.calibration.tactile_gain import TaxelPress, calibrate_glove
from services.alignment.calibration.tactile_tare import measure_tare, reading_step
from services.alignment.retargeting import warm_up
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.episode_builder import build_episode
from services.alignment.synchronization.recorded_streams import EpisodeStream
from services.episode_store.committing import commit_spool
from services.twin.episodes import NUM_LAST_SHOWN_STEPS, TruthEpisode, TruthStream
from services.twin.simulation import MODEL_RATE_HZ
from services.twin.take_options import TakeOptions

PRESSURES_KPA = (10.0, 20.0, 40.0)  # chosen: up to the 40 kPa of heat maps
# A weight on an area is known to about this share.
PRESSURE_SIGMA = 0.01
PART_S = 2.0
# Readings next to a change of pressure are left out.
MARGIN_S = 0.2
MAX_MORE_TAKES = 3
CALIBRATION = TakePrompt(task="calibration", instruction="press all taxels")
STATION: Final = "twin"
# Seeds in a row that share a station: its gloves are calibrated once.
SESSION_SEEDS: Final = 20
# As in docs/twin_closure.md: with wrists as tracked, the robot's hand touches something else.
ALIGNMENT: Final = AlignmentOptions(wrist="touch")
LABELS: Final = "object_poses"
_warm_up_once = lru_cache(maxsize=1)(warm_up)
# What training reads, beside images.
_TRAINED: Final = ("action", "action_commanded", "tactile_left", "tactile_right", LABELS)


@dataclass(frozen=True)
class TakePlan:
    """A take to record: what the devices play, what is said about it, and what is calibrated.

    Takes with one `unit_seed` are of one station, with the same gloves and calibration; `seed`
    draws all other errors.
    """

    streams: Sequence[ReplayStream]
    prompt: TakePrompt
    success: bool | None
    calibration: Mapping[str, Matrix]
    recording_id: str
    seed: int
    unit_seed: int


def play_take(
    plan: TakePlan, spool_root: Path, *, station: str
) -> tuple[MockTake, Sequence[DeviceHealth]]:
    """Play a take through all mock devices, with the faults of an ordinary station.

    The clock is virtual, so that equal plans give equal takes. Returns the take in the spool, and
    the health counters of every device.
    """
    with MockStation(
        plan.streams,
        FaultScript.first_light(),
        plan.seed,
        VirtualClock(),
        spool_root=spool_root,
        name=station,
        calibration=plan.calibration,
        unit_seed=plan.unit_seed,
    ) as mock:
        take = mock.run_take(
            plan.prompt,
            recording_id=plan.recording_id,
            how=SaveTake(success=plan.success, accept_incomplete=True),
        )
        return take, mock.station.health.report().devices


def measure_gloves(
    streams: Sequence[ReplayStream],
    spool_root: Path,
    *,
    seed: int,
    clock: StationClock | None = None,
) -> dict[str, Matrix]:
    """Calibration matrices of the mock gloves that play these streams.

    By default the take runs in real time, in which the station asks its gloves for their time, and
    path delays are measured, too. With a virtual clock they are not (a mock station knows them with
    an error), but equal arguments give equal matrices. The seed is that of the mock station, whose
    gloves differ by it, and of the errors of the pressures; `spool_root` is for calibration takes.
    Raises UnavailableError if a glove's path delay could not be measured in several takes.
    """
    gloves = {side: s for s in streams for side in SIDES if s.descriptor.name == f"tactile_{side}"}
    if not gloves:
        return {}
    errors = np.random.default_rng([seed, len(PRESSURES_KPA)]).normal(size=len(PRESSURES_KPA))
    true_kpa = np.array([0.0, *(PRESSURES_KPA * (1 + PRESSURE_SIGMA * errors))])
    found: dict[str, Matrix] = {}
    with MockStation(
        [_pressed(stream, true_kpa) for stream in gloves.values()],
        FaultScript.first_light(),
        seed,
        clock or StationClock(),
        spool_root=spool_root,
    ) as station:
        take = station.run_take(CALIBRATION)
        if not isinstance(clock, VirtualClock):
            found = _path_delays(station, [f"tactile_{side}" for side in gloves])
    for side, glove in gloves.items():
        layout = glove.descriptor.tactile_layout
        rest, *pressed = (part / reading_step(layout) for part in _parts(take, side))
        tare = measure_tare(rest, side=side, layout=layout)
        everywhere = np.ones(layout.num_taxels, dtype=np.bool_)
        presses = [
            TaxelPress(kpa, PRESSURE_SIGMA * kpa, counts, everywhere)
            for kpa, counts in zip(PRESSURES_KPA, pressed, strict=True)
        ]
        matrices = calibrate_glove(tare, presses).matrices()
        found |= {name: matrix_rows(matrix) for name, matrix in matrices.items()}
    return found


def origin_in_truth_ns(
    take: MockTake, *, started_t_host_ns: int, quality: Mapping[str, float]
) -> int:
    """Time 0 of an aligned episode on the time axis of the streams that the devices played."""
    origin_ns = started_t_host_ns + round(quality["origin_after_start_ns"])
    return origin_ns - take.ledger.start_host_ns


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
            f"mock station: the path delays of {', '.join(missing)} could not be measured within "
            f"{1 + MAX_MORE_TAKES} takes; close other programs and run it again"
        )
    return add_latencies({}, {name: measured[name] for name in names}, stated=())


def _pressed(stream: ReplayStream, true_kpa: Float64[np.ndarray, " parts"]) -> ReplayStream:
    """The glove of a stream under one pressure after the other, the same on all taxels."""
    period_ns = stream.descriptor.period_ns()
    per_part = round(PART_S * 1e9 / period_ns)
    values = np.repeat(true_kpa.astype(np.float32), per_part)[:, None]
    t_ns = np.arange(len(values), dtype=np.int64) * period_ns
    (num_taxels,) = stream.descriptor.shape
    return ReplayStream(stream.descriptor, t_ns, np.repeat(values, num_taxels, axis=1))


def _parts(take: MockTake, side: Side) -> Iterator[Float64[np.ndarray, "time cells"]]:
    spool, name = SpoolReader(take.spool_path), f"tactile_{side}"
    batch = spool.read(name)
    # By the number of the sample: when it came depends on the machine's other work.
    t_s = batch.sequence * (spool.streams[name].period_ns() * 1e-9)
    for part in range(1 + len(PRESSURES_KPA)):
        since_s = t_s - part * PART_S
        inside = (since_s >= MARGIN_S) & (since_s <= PART_S - MARGIN_S)
        yield batch.values[inside].astype(np.float64)


def device_options(options: TakeOptions) -> TakeOptions:
    """Options of the ground truth that the devices play: every stream, images at 30 Hz."""
    return replace(options, image_every=None, streams="all")


def write_by_station(
    store: EpisodeStore,
    truth: TruthEpisode,
    objects: SceneObjects | None = None,
    *,
    episode_id: str,
    options: TakeOptions,
) -> None:
    """Record a take of the twin with a mock station, and write what alignment makes of it.

    By default the episode also has the twin's labels, and equal takes give equal episodes. With
    `objects`, poses of objects are those of the markers in the images, and of the twin's truth the
    episode has only the outcome, which an operator would see. The recording itself is not kept.

    The truth is recorded with `device_options`, with `objects` by a stage that shows the markers;
    `streams` and `image_every` of the options say what the episode has. Raises ConflictError if it
    exists, InvalidInputError if the take could not be aligned, DeviceError if a mock device failed.
    """
    alignment = ALIGNMENT.model_copy(update={"objects": objects}) if objects else ALIGNMENT
    attributes, streams, origin_ns = _aligned(truth, alignment, episode_id)
    if objects is None:
        streams = [_label(truth.streams[LABELS], origin_ns, streams[0].t_ref_ns), *streams]
        attributes = _with_truth(attributes, truth.attributes, origin_ns)
    else:
        # The recording is not kept, and the wall clock would differ each time.
        attributes = attributes.model_copy(update={"created_at": None, "lineage": ()})
    written = streams
    if options.streams == "training":
        names = (*_TRAINED, *options.images, *map(object_stream, attributes.object_names))
        written = [one for one in written if one.descriptor.name in names]
    if options.image_every is not None:
        grid_ns = next(one.t_ref_ns for one in streams if one.descriptor.name == "action")
        written = [_thinned(one, grid_ns, options.image_every) for one in written]
    with store.writer(kind="episode", attributes=attributes) as to:
        for one in written:
            to.add_stream(one.descriptor)
            to.append(one.descriptor.name, values=one.values, t_ref_ns=one.t_ref_ns)


def _aligned(
    truth: TruthEpisode, alignment: AlignmentOptions, episode_id: str
) -> tuple[EpisodeAttributes, list[TruthStream], int]:
    """Attributes and streams of an episode, and its time 0 (ns) on the axis of the truth."""
    about = truth.attributes
    if about.seed is None:
        raise InvalidInputError(f"device takes: {episode_id} has no seed; expected a twin's take")
    _warm_up_once()
    session = about.seed // SESSION_SEEDS
    plan = TakePlan(
        _played(truth.streams),
        TakePrompt(task=about.task, instruction=about.instruction, domain=about.domain),
        about.success,
        about.matrices() | _session_gloves(session),
        recording_id="take",
        seed=zlib.crc32(episode_id.encode()),
        unit_seed=session,
    )
    with tempfile.TemporaryDirectory(prefix="dextouch-take-") as name:
        folder = Path(name)
        take, _ = play_take(plan, folder / "spool", station=STATION)
        local = EpisodeStore(folder / "store")
        commit_spool(local, take.spool_path, SpoolReader(take.spool_path).attributes)
        recording = local.recording(take.recording_id)
        built = build_episode(recording, episode_id=episode_id, options=alignment)
        streams = [_in_memory(stream) for stream in built.streams]
        started_ns = recording.attributes.started_t_host_ns
    attributes = built.complete_attributes()
    if started_ns is None:
        raise InvalidInputError(f"device takes: {episode_id} has no start time; record it again")
    origin_ns = origin_in_truth_ns(take, started_t_host_ns=started_ns, quality=attributes.quality)
    return attributes, streams, origin_ns


@lru_cache(maxsize=4)
def _session_gloves(session: int) -> dict[str, Matrix]:
    gloves = [stream for stream in pattern_streams(1.0) if stream.descriptor.kind == "tactile"]
    with tempfile.TemporaryDirectory(prefix="dextouch-calibration-") as folder:
        return measure_gloves(gloves, Path(folder), seed=session, clock=VirtualClock())


def _played(streams: Mapping[str, TruthStream]) -> list[ReplayStream]:
    return [
        ReplayStream(stream.descriptor, stream.t_ref_ns, stream.values)
        for name, stream in streams.items()
        if stream.descriptor.kind in PLAYED_KINDS
        and name != LABELS
        and stream.descriptor.unit != "action_m_rad"
    ]


def _in_memory(stream: EpisodeStream) -> TruthStream:
    blocks = list(stream.blocks)
    return TruthStream(
        stream.descriptor,
        np.concatenate([block.t_ns for block in blocks]),
        np.concatenate([block.values for block in blocks]),
    )


def _label(truth: TruthStream, origin_ns: int, grid_ns: np.ndarray) -> TruthStream:
    """True object poses with the time axis of the episode, from its first to its last step."""
    t_ns = truth.t_ref_ns - origin_ns
    period_ns = truth.descriptor.period_ns()
    inside = (t_ns > grid_ns[0] - period_ns) & (t_ns < grid_ns[-1] + period_ns)
    return TruthStream(truth.descriptor, t_ns[inside], truth.values[inside])


def _thinned(stream: TruthStream, grid_ns: np.ndarray, image_every: int) -> TruthStream:
    if stream.descriptor.kind != "image":
        return stream
    steps = sorted(
        {*range(0, len(grid_ns), image_every), *range(len(grid_ns))[-NUM_LAST_SHOWN_STEPS:]}
    )
    kept = np.unique(nearest_index(stream.t_ref_ns, grid_ns[steps]))
    rate_hz = MODEL_RATE_HZ / image_every
    descriptor = stream.descriptor.model_copy(update={"nominal_rate_hz": rate_hz})
    return TruthStream(descriptor, stream.t_ref_ns[kept], stream.values[kept])


def _with_truth(
    aligned: EpisodeAttributes, truth: EpisodeAttributes, origin_ns: int
) -> EpisodeAttributes:
    """Attributes of the aligned episode with the twin's, whose command repeats the ground truth."""
    return aligned.model_copy(
        update={
            "origin": truth.origin,
            "seed": truth.seed,
            "generator_command": truth.generator_command,
            "object_names": truth.object_names,
            "object_boxes_m": truth.object_boxes_m,
            "event_times_s": {
                name: max(0.0, t_s - origin_ns * 1e-9) for name, t_s in truth.event_times_s.items()
            },
            "quality": truth.quality | aligned.quality,
            # The recording is not kept, and the wall clock would differ each time.
            "lineage": truth.lineage,
            "created_at": truth.created_at,
        }
    )
