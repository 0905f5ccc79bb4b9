"""The benchmark stage `alignment`: takes aligned as in the service and by arrival times."""

import argparse
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.simulated.hand_motions import RATE_HZ as HAND_RATE_HZ
from benchmarks.simulated.hand_motions import robot_motion
from benchmarks.stages import Amounts, Bar
from dextouch.episodes import EpisodeReader, EpisodeStore, RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_vector
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import ClockReport, EpisodeAttributes, StoredAnchor
from dextouch.streams import StreamDescriptor, StreamKind
from dextouch.tactile.layout import NUM_TAXELS, SIDES
from services.acquisition.mock_station import MockTake
from services.alignment.jobs import align_recording
from services.alignment.retargeting.hand_retargeter import warm_up
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization.grid_actions import (
    ACTION_STREAMS,
    GriddedStreams,
    make_actions,
    place_streams,
)
from services.alignment.synchronization.recorded_streams import (
    Block,
    DatedStream,
    EpisodeStream,
    cut_stream,
    date_stream,
)
from services.alignment.synchronization.resampling import grid_times_ns
from services.alignment.synchronization.stream_clock import TimedStream, time_stream
from services.episode_store.committing import commit_spool
from services.pipelines.demo_takes import errors_of, record_take

POSE_RATE_HZ, GLOVE_RATE_HZ, IMAGE_RATE_HZ = 100.0, 60.0, 30.0
IMAGE_PX = 64
K_HEAD = ((60.0, 0.0, 32.0), (0.0, 60.0, 32.0), (0.0, 0.0, 1.0))
POSES = ("wrist_left", "wrist_right", "head")
SWING_M, TURN_RAD = 0.15, 0.6

Truth = tuple[StreamDescriptor, Int64[np.ndarray, " n"], np.ndarray]


@dataclass(frozen=True)
class RecordedTake:
    """A take in a station's spool, with the ground truth that the mock devices replayed."""

    seconds: float
    take: MockTake
    truth: EpisodeReader


def record(seconds: float, seed: int, folder: Path) -> RecordedTake:
    """Record a take of a two-handed station: gloves, keypoints, poses and a camera.

    The devices have the clock drift, jitter, delays, noise and losses of `FaultScript.first_light`,
    and the gloves are calibrated with a separate take. The hands are those of the robot, so that
    the true joint angles are known; only the ground truth contains them, as `joints_measured`.
    """
    store = EpisodeStore(folder / "truth")
    rng = np.random.default_rng([seed, 1])
    streams = list(_streams(seconds, seed, rng))
    sent = [stream for stream in streams if stream[0].name != "joints_measured"]
    _write(store, "truth", streams)
    _write(store, "played", sent)
    take, _ = record_take(store.open("played"), folder / "spool", seed=seed)
    return RecordedTake(seconds, take, store.open("truth"))


def _streams(seconds: float, seed: int, rng: np.random.Generator) -> Iterator[Truth]:
    joints = []
    for side in SIDES:
        t_ns = _times_ns(seconds, HAND_RATE_HZ)
        motion = robot_motion(side, len(t_ns), seed, natural=True)
        joints.append(motion.joints_rad)
        yield _stream(f"keypoints_{side}", "keypoints", "m", t_ns, motion.keypoints_m)
        glove_ns = _times_ns(seconds, GLOVE_RATE_HZ)
        yield _stream(f"tactile_{side}", "tactile", "kPa", glove_ns, _pressures_kpa(glove_ns, rng))
    yield _stream("joints_measured", "robot_state", "rad", t_ns, np.concatenate(joints, axis=1))
    for name in POSES:
        t_ns = _times_ns(seconds, POSE_RATE_HZ)
        q_wxyz = quaternion_from_rotation(rotation_from_vector(TURN_RAD * _waves(t_ns, 3, rng)))
        poses = np.concatenate([SWING_M * _waves(t_ns, 3, rng), q_wxyz], axis=1)
        yield _stream(name, "pose", "pose_m_wxyz", t_ns, poses)
    t_ns = _times_ns(seconds, IMAGE_RATE_HZ)
    yield _stream("camera_head", "image", "rgb8", t_ns, _images(t_ns, rng))


def _stream(name: str, kind: StreamKind, unit: str, t_ns: np.ndarray, values: np.ndarray) -> Truth:
    side = next((side for side in SIDES if kind != "pose" and name.endswith(side)), None)
    descriptor = StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": values.shape[1:],
            "dtype": values.dtype.name,
            "unit": unit,
            "nominal_rate_hz": round(1e9 / (t_ns[1] - t_ns[0])),
            "side": side,
        }
    )
    return descriptor, t_ns, values


def _times_ns(seconds: float, rate_hz: float) -> Int64[np.ndarray, " n"]:
    return np.rint(np.arange(int(seconds * rate_hz) + 1) * (1e9 / rate_hz)).astype(np.int64)


def _waves(t_ns: np.ndarray, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "n k"]:
    """Sines of 0.2 to 0.7 Hz, typical frequencies of manipulation."""
    turns = rng.uniform(0.2, 0.7, num) * (t_ns[:, None] * 1e-9) + rng.random(num)
    return np.sin(2 * np.pi * turns)


def _pressures_kpa(t_ns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A contact patch that moves over the taxels, appears and disappears."""
    centre, strength = np.split(_waves(t_ns, 2, rng), 2, axis=1)
    across = (np.arange(NUM_TAXELS) - 160 - 150 * centre) / 12
    return (30 * np.maximum(strength, 0) * np.exp(-(across**2))).astype(np.float32)


def _images(t_ns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A striped pattern that moves and changes its colours."""
    stripes = np.linspace(0, 3, IMAGE_PX)[:, None, None] + np.arange(3) / 3
    turns = rng.random() + 0.7 * t_ns[:, None, None, None] * 1e-9 + stripes
    rows = np.rint(128 + 100 * np.sin(2 * np.pi * turns)).astype(np.uint8)
    return np.repeat(rows, IMAGE_PX, axis=2)


def _write(store: EpisodeStore, episode_id: str, streams: list[Truth]) -> None:
    starts = {s.name: transform_from_pose(v[0]) for s, _, v in streams if s.kind == "pose"}
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task="move",
        instruction="move both hands",
        domain="human",
        origin="twin",
        anchor=StoredAnchor.from_poses(AnchorPoses(*(starts[name] for name in POSES))),
        K_head=K_HEAD,
    )
    with store.writer(kind="episode", attributes=attributes) as writer:
        for stream, t_ns, values in streams:
            writer.add_stream(stream)
            writer.append(stream.name, values=values, t_ref_ns=t_ns)


OURS, LINEAR, NEAREST = "ours", "arrivals, interpolated", "arrivals, nearest sample"
METHODS = (OURS, LINEAR, NEAREST)
STORING, FITS, CALIBRATION = "storing the upload", "clock fits", "calibration"
STEPS = (STORING, FITS, CALIBRATION, "resampling", "retargeting", "writing")
OPTIONS = AlignmentOptions()
# Arrival times are interpolated across every gap.
ANY_GAP_NS = 10**12


@dataclass(frozen=True)
class MethodResult:
    """One method on one take: processor seconds by step, wall time, errors against ground truth.

    `alignment_s` is all but the storing; `wall_s` is the wall time of the same.
    """

    method: str
    take_s: float
    steps_s: dict[str, Figure]
    alignment_s: Figure
    wall_s: Figure
    errors: dict[str, float]

    @property
    def speed(self) -> Figure:
        """Seconds of recording that are stored and aligned in a second of processor time."""
        steps = [figure.values for figure in self.steps_s.values()]
        return Figure.of([sum(values) for values in zip(*steps, strict=True)]).inverse(self.take_s)


@dataclass(frozen=True)
class _Run:
    steps_s: dict[str, float]
    wall_s: float
    errors: dict[str, float]


def compare(
    take: RecordedTake, num_rounds: int, folder: Path, *, bar: Bar
) -> dict[str, MethodResult]:
    """Align a take of the spool alternately with every method, each time in a new store."""
    subjects = {name: partial(_run, take, name, folder / "store") for name in METHODS}
    with bar(f"take of {take.seconds:g} s", num_rounds * len(subjects)) as step:
        found = interleaved(subjects, num_rounds, on_step=step)
    return {name: _result(name, take, runs) for name, runs in found.items()}


def _result(name: str, take: RecordedTake, runs: Sequence[_Run]) -> MethodResult:
    steps = {step: Figure.of([run.steps_s[step] for run in runs]) for step in STEPS}
    alignment = [sum(run.steps_s.values()) - run.steps_s[STORING] for run in runs]
    walls = Figure.of([run.wall_s for run in runs])
    return MethodResult(name, take.seconds, steps, Figure.of(alignment), walls, runs[0].errors)


def _run(recorded: RecordedTake, method: str, folder: Path, round_index: int) -> _Run:
    recording_id = recorded.take.recording_id
    store = EpisodeStore(folder)
    begin_s = time.process_time()
    spool = recorded.take.spool_path
    commit_spool(store, spool, SpoolReader(spool).attributes)
    storing_s = time.process_time() - begin_s
    marks: dict[str, float] = {}
    wall_s = time.perf_counter()
    begin_s = time.process_time()

    def on_stage(stage: str) -> None:
        marks.setdefault(stage, time.process_time())

    if method == OURS:
        report = align_recording(store, recording_id, OPTIONS, lambda at: on_stage(at.stage))
        episode_id = report.episode_id
    else:
        episode_id = align_by_arrivals(store, recording_id, on_stage, nearest=method == NEAREST)
    end_s, wall_s = time.process_time(), time.perf_counter() - wall_s
    # After the alignment, when the same files were just read.
    fits_s = _clock_fits_s(store.recording(recording_id))
    # These takes have no objects, whose stage therefore never begins.
    edges = [begin_s, *(marks[stage] for stage in ("placing", "retargeting", "writing")), end_s]
    dating_s, *others_s = np.diff(edges).tolist()
    times = [storing_s, fits_s if method == OURS else 0.0, max(dating_s - fits_s, 0.0), *others_s]
    errors = {} if round_index else _errors(store, recorded, episode_id)
    shutil.rmtree(folder)
    return _Run(dict(zip(STEPS, times, strict=True)), wall_s, errors)


def _clock_fits_s(recording: RecordingReader) -> float:
    """Processor time of reading the timestamps of all streams and fitting their clocks."""
    begin_s = time.process_time()
    for name, descriptor in recording.streams.items():
        time_stream(recording.stamps(name), descriptor)
    return time.process_time() - begin_s


def align_by_arrivals(
    store: EpisodeStore, recording_id: str, on_stage: Callable[[str], None], *, nearest: bool
) -> str:
    """Align a recording of a person as if every sample had been taken when it arrived.

    There is no clock model, no path delay and no gap; values are converted and hands retargeted as
    in the service. With `nearest`, steps take the nearest sample instead of interpolating. Returns
    the episode's id.
    """
    recording = store.recording(recording_id)
    # The clock fits inside are timed separately and subtracted.
    streams = {name: _by_arrival(date_stream(recording, name)) for name in recording.streams}
    on_stage("placing")
    start_ns, gridded = _on_grid(streams, nearest=nearest)
    on_stage("retargeting")
    source = recording.attributes
    actions = make_actions(gridded, "human", source.calibration)
    on_stage("writing")
    after_start_ns = start_ns - (source.started_t_host_ns or 0)
    attributes = EpisodeAttributes(
        episode_id=f"{recording_id}-arrivals",
        task=source.task,
        instruction=source.instruction,
        domain="human",
        origin="recorded",
        anchor=StoredAnchor.from_poses(actions.anchor),
        K_head=source.calibration.get("K_head"),
        quality={"origin_after_start_ns": float(after_start_ns)},
    )
    action = StreamDescriptor(
        name="action",
        kind="robot_state",
        shape=(67,),
        dtype="float64",
        unit="action",
        nominal_rate_hz=OPTIONS.model_rate_hz,
    )
    last_ns = int(gridded.grid_ns[-1])
    made = EpisodeStream(action, iter([Block(gridded.grid_ns, actions.measured)]))
    with store.writer(kind="episode", attributes=attributes) as writer:
        for stream in (made, *(cut_stream(one, start_ns, last_ns) for one in streams.values())):
            writer.add_stream(stream.descriptor)
            for block in stream.blocks:
                writer.append(stream.descriptor.name, values=block.values, t_ref_ns=block.t_ns)
    return attributes.episode_id


def _by_arrival(stream: DatedStream) -> DatedStream:
    """The stream with arrival times as sample times."""
    arrival_ns = stream.recording.stamps(stream.name).t_host_ns
    kept = first_arrivals(arrival_ns)
    report = ClockReport(stream=stream.name, method="arrival", num_samples=len(kept))
    return replace(stream, timing=TimedStream(kept, arrival_ns[kept], report))


def first_arrivals(arrival_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    """Indices of the samples that arrived after the one before: times must grow."""
    return np.flatnonzero(np.diff(arrival_ns, prepend=arrival_ns[0] - 1) > 0)


def _on_grid(streams: dict[str, DatedStream], *, nearest: bool) -> tuple[int, GriddedStreams]:
    parts = {name: streams[name].load() for name in ACTION_STREAMS["human"]}
    start_ns = max(int(part.t_ns[0]) for part in parts.values())
    stop_ns = min(int(part.t_ns[-1]) for part in parts.values())
    num_steps = int((stop_ns - start_ns) * 1e-9 * OPTIONS.model_rate_hz) + 1
    moved = {name: replace(part, t_ns=part.t_ns - start_ns) for name, part in parts.items()}
    grid_ns = grid_times_ns(num_steps, OPTIONS.model_rate_hz)
    gridded = place_streams(moved, grid_ns, max_gap_ns=ANY_GAP_NS)
    if nearest:
        at = {name: replace(at, weight=np.rint(at.weight)) for name, at in gridded.at.items()}
        gridded = replace(gridded, at=at)
    return start_ns, gridded


def _errors(store: EpisodeStore, recorded: RecordedTake, episode_id: str) -> dict[str, float]:
    _, found = errors_of(store, episode_id, recorded.truth, recorded.take)
    rms, left = found["clock_rms_ms"], found["latency_error_ms"]
    times = [float(np.hypot(rms[name], left[name])) for name in rms]
    return {
        "time of samples, worst stream (ms)": max(times),
        "time of samples, median stream (ms)": float(np.median(times)),
        "scatter of times, worst stream (ms)": max(rms.values()),
        "wrists (mm)": found["wrist_error_mm"],
        "wrists (deg)": found["wrist_error_deg"],
        "fingertips (mm)": found["fingertip_error_mm"],
        "pressure, mean (kPa)": found["taxel_mae_kpa"],
        "contact, 1 - IoU": 1.0 - found["taxel_iou"],
    }


Results = Mapping[str, MethodResult]
MIN_SPEED = 5.0
# Bounds of `tests/accuracy/test_alignment.py`.
BOUNDS = {
    "scatter of times, worst stream (ms)": 1.0,
    "time of samples, worst stream (ms)": 1.0,
    "wrists (mm)": 1.0,
    "wrists (deg)": 0.1,
    "fingertips (mm)": 2.5,
    "pressure, mean (kPa)": 0.05,
    "contact, 1 - IoU": 0.02,
}
CHARTS = {
    "Wrists": "wrists (mm)",
    "Fingertips": "fingertips (mm)",
    "Time of samples": "time of samples, worst stream (ms)",
}


def tables(takes: Sequence[Results]) -> list[ResultTable]:
    """Times and errors of each take."""
    return [table for results in takes for table in (_time_table(results), _error_table(results))]


def _time_table(results: Results) -> ResultTable:
    found = [results[name] for name in METHODS]
    rows = [(step, *(one.steps_s[step].text() for one in found)) for step in STEPS]
    rows += [
        ("alignment (all but the storing)", *(one.alignment_s.text() for one in found)),
        ("alignment, wall time", *(one.wall_s.text() for one in found)),
        ("all, times real time", *(one.speed.text() for one in found)),
    ]
    title = f"Take of {found[0].take_s:g} s: processor seconds by step"
    return ResultTable(title, ("", *METHODS), rows)


def _error_table(results: Results) -> ResultTable:
    found = [results[name].errors for name in METHODS]
    rows = [(what, *(f"{errors[what]:.3g}" for errors in found)) for what in found[0]]
    take_s = results[OURS].take_s
    return ResultTable(f"Take of {take_s:g} s: errors against ground truth", ("", *METHODS), rows)


def panels(results: Results) -> list[Panel]:
    """Time against error of one take, by kind of error."""
    return [
        Panel(
            f"{title}, take of {results[OURS].take_s:g} s",
            "processor seconds of the alignment",
            what,
            [
                Point.of(name, one.alignment_s, one.errors[what], is_ours=name == OURS)
                for name, one in results.items()
            ],
        )
        for title, what in CHARTS.items()
    ]


def requirements(results: Results) -> list[Requirement]:
    """Requirements on speed and errors of the alignment service, on one take."""
    ours = results[OURS]
    speed = at_least(
        "stored and aligned, times real time of one core", ours.speed.median, MIN_SPEED
    )
    errors = [at_most(what, ours.errors[what], BOUNDS[what]) for what in BOUNDS]
    return [speed, *errors]


QUICK_SECONDS, USUAL_SECONDS = "3", "10,60"
AMOUNTS = Amounts(usual={"rounds": 5}, quick={"rounds": 1})
# Shorter takes have no stretch of 17 steps.
MIN_SECONDS = 2.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument(
        "--seconds",
        metavar="A,B",
        help=f"lengths of the takes ({USUAL_SECONDS}; quick {QUICK_SECONDS})",
    )
    AMOUNTS.add_options(parser, rounds="rounds a take")
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record takes, then align each alternately with every method."""
    lengths_s = _lengths_s(options)
    num_rounds = AMOUNTS.of(options)["rounds"]
    takes = []
    with bar("recording", len(lengths_s)) as step:
        for seconds in lengths_s:
            step(f"{seconds:g} s")
            takes.append(record(seconds, options.seed, folder / f"take_{seconds:g}s"))
    warm_up()
    results = [compare(take, num_rounds, folder, bar=bar) for take in takes]
    longest = results[-1]
    return StageReport(
        stage="alignment",
        packages=("numpy", "numba", "scipy", "zstandard"),
        options={"seconds": lengths_s, "rounds": num_rounds, "seed": options.seed},
        tables=tables(results),
        panels=panels(longest),
        requirements=requirements(longest),
        data={"takes": results},
        notes=[
            "processor time of all threads, so multiples of real time refer to one core; clock "
            "fits are timed separately after the alignment and subtracted from the calibration",
            "gloves are calibrated with a take under known pressures and by time requests, other "
            "path delays have errors of 0.2 ms (sigma); the transfer over HTTP is not included",
        ],
    )


def _lengths_s(options: argparse.Namespace) -> list[float]:
    text = options.seconds or (QUICK_SECONDS if options.quick else USUAL_SECONDS)
    words = [word.strip() for word in text.split(",")]
    try:
        lengths_s = sorted({float(word) for word in words})
    except ValueError:
        lengths_s = []
    if not lengths_s or not MIN_SECONDS <= lengths_s[0] <= lengths_s[-1] < float("inf"):
        raise InvalidInputError(
            f"--seconds: got {text!r}, expected lengths of at least {MIN_SECONDS:g} s, like 10,60"
        )
    return lengths_s
