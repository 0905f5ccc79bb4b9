"""The benchmark stage `calibration`: hand-eye methods on known scenes, and calibrated cameras."""

import argparse
import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from benchmarks.figures import Figure, Requirement, at_least, at_most, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.simulated.board_scenes import (
    DISTORTION,
    TURN_AXES,
    K,
    Motion,
    Scene,
    make_scene,
    mount_difference,
    simulated_boards,
)
from benchmarks.stages import Amounts, Bar
from dextouch.errors import DegenerateRotationError, InvalidInputError
from dextouch.geometry import invert, transform
from services.alignment.calibration.hand_eye import HandEyeNoise, solve_hand_eye
from services.alignment.calibration.intrinsics import FoundBoards, calibrate_found
from services.alignment.calibration.motion import DegenerateMotionError, park, twist

OURS = "ours"
OURS_POSES = "ours, poses only"
# Its rivals rely on the size of the board that was entered.
OURS_SIZE_KNOWN = "ours, size within 0.2 %"
PARK = "park"


@dataclass(frozen=True)
class Answer:
    """A mount, with the covariance of its twist where available."""

    T_tracker_camera: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "6 6"] | None = None


class Method(NamedTuple):
    """A method that estimates the mount of a scene.

    `solve` raises InvalidInputError: the method refuses the scene, or returns no finite mount.
    """

    name: str
    solve: Callable[[Scene], Answer]


def _ours(scene: Scene, *, with_corners: bool, noise: HandEyeNoise | None = None) -> Answer:
    """Our weighted bundle adjustment, with the corners or with the board's poses alone."""
    views = scene.views if with_corners else None
    result = solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board, views=views, noise=noise)
    return Answer(result.T_tracker_camera, result.covariance)


def _opencv_hand_eye(scene: Scene, *, name: str) -> Answer:
    """`cv2.calibrateHandEye` with one of its methods."""
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    return Answer(_opencv("calibrateHandEye", "CALIB_HAND_EYE", name, tracker, board))


def _opencv_robot_world(scene: Scene, *, name: str) -> Answer:
    """`cv2.calibrateRobotWorldHandEye` with one of its methods, which finds the board, too."""
    board, tracker = scene.Ts_camera_board, invert(scene.Ts_world_tracker)
    solver, prefix = "calibrateRobotWorldHandEye", "CALIB_ROBOT_WORLD_HAND_EYE"
    return Answer(invert(_opencv(solver, prefix, name, board, tracker)))


METHODS = (
    Method(OURS, partial(_ours, with_corners=True)),
    Method(OURS_POSES, partial(_ours, with_corners=False)),
    Method(
        OURS_SIZE_KNOWN, partial(_ours, with_corners=True, noise=HandEyeNoise(board_scale=2e-3))
    ),
    # The solution that initializes our bundle adjustment.
    Method(
        "our closed form",
        lambda scene: Answer(park(scene.Ts_world_tracker, scene.Ts_camera_board)),
    ),
    *(
        Method(name, partial(_opencv_hand_eye, name=name))
        for name in ("tsai", PARK, "horaud", "andreff", "daniilidis")
    ),
    *(Method(name, partial(_opencv_robot_world, name=name)) for name in ("shah", "li")),
)


def _opencv(
    solver: str, prefix: str, name: str, first: np.ndarray, second: np.ndarray
) -> Float64[np.ndarray, "4 4"]:
    """The last transform that a solver of OpenCV gives for two series of poses."""
    import cv2

    # Failures are in the table.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    poses = [list(part) for Ts in (first, second) for part in (Ts[:, :3, :3], Ts[:, :3, 3])]
    try:
        # By keyword: the fifth positional argument is an output, not the method.
        *_, R, t = getattr(cv2, solver)(*poses, method=getattr(cv2, f"{prefix}_{name.upper()}"))
    except cv2.error as error:
        raise InvalidInputError(f"{name}: OpenCV gives up ({error})") from error
    T = transform(np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64).ravel())
    if not np.isfinite(T).all():
        raise DegenerateRotationError(f"{name}: OpenCV returns NaN without an error")
    return T


class Solved(NamedTuple):
    """One method on one scene; `nees` per degree of freedom and `sigma` where available."""

    ms: float
    error_deg: float
    error_mm: float
    nees: float | None = None
    sigma_deg: float | None = None
    sigma_mm: float | None = None


@dataclass(frozen=True)
class MethodResult:
    """Results of one method on all scenes, in the order of the seeds."""

    name: str
    num_seeds: int
    ms: Figure
    error_deg: Figure
    error_mm: Figure
    nees: Figure | None
    sigma_deg: Figure | None
    sigma_mm: Figure | None


def compare(scenes: Sequence[Scene], bar: Bar) -> dict[str, MethodResult]:
    """Run every method on every scene, after a warm-up on the first one."""
    for method in METHODS:
        method.solve(scenes[0])
    gc.collect()
    with bar("hand-eye", len(METHODS) * len(scenes)) as step:
        rounds = interleaved(
            {m.name: partial(lambda m, index: score(m, scenes[index]), m) for m in METHODS},
            len(scenes),
            on_step=step,
        )
    results = {}
    for name, solved in rounds.items():
        columns: dict[str, Any] = {
            key: None if None in values else Figure.of(values)
            for key, values in zip(Solved._fields, zip(*solved, strict=True), strict=True)
        }
        results[name] = MethodResult(name, len(solved), **columns)
    return results


def score(method: Method, scene: Scene) -> Solved:
    """Time (of this thread's processor) and error of one method on one scene.

    Raises InvalidInputError if the method refuses the scene, or gives no finite mount.
    """
    begun_s = time.thread_time()
    answer = method.solve(scene)
    ms = (time.thread_time() - begun_s) * 1e3
    angle_rad, distance_m = mount_difference(answer.T_tracker_camera, scene.T_tracker_camera)
    error_deg, error_mm = float(np.rad2deg(angle_rad)), distance_m * 1e3
    if answer.covariance is None:
        return Solved(ms, error_deg, error_mm)
    error = twist(invert(answer.T_tracker_camera) @ scene.T_tracker_camera)
    variances = np.diag(answer.covariance)
    return Solved(
        ms,
        error_deg,
        error_mm,
        nees=float(error @ np.linalg.solve(answer.covariance, error) / 6),
        sigma_deg=float(np.rad2deg(np.sqrt(variances[:3].sum()))),
        sigma_mm=float(np.sqrt(variances[3:].sum()) * 1e3),
    )


def not_worse_share(
    ours: MethodResult, rival: MethodResult, *, tolerance_sigmas: float
) -> tuple[float, float]:
    """Share of seeds with an error of at most the rival's plus a tolerance in our sigmas.

    Returns the share by rotation and that by translation. Raises InvalidInputError if ours has no
    sigma.
    """
    if ours.sigma_deg is None or ours.sigma_mm is None:
        raise InvalidInputError(f"{ours.name}: has no sigma to define the tolerance")

    def share(errors: Figure, others: Figure, sigmas: Figure) -> float:
        limits = np.array(others.values) + tolerance_sigmas * np.array(sigmas.values)
        return float(np.mean(np.array(errors.values) <= limits))

    return (
        share(ours.error_deg, rival.error_deg, ours.sigma_deg),
        share(ours.error_mm, rival.error_mm, ours.sigma_mm),
    )


Results = Mapping[str, MethodResult]

Maker = Callable[[int], Scene]
RIVALS = ("tsai", "park", "daniilidis", "li")


@dataclass(frozen=True)
class SceneResult:
    """One kind of scene, and how ours and the other methods treat it.

    Of `num_refused` refusals by ours, `num_named` name axes to add, and `cause` is the message of
    the first; `rivals` has the median errors of the other methods, or that they refuse or return
    NaN.
    """

    name: str
    is_healthy: bool
    num_seeds: int
    num_refused: int
    num_named: int
    cause: str
    rivals: dict[str, str]


def scene_makers() -> dict[str, tuple[Maker, bool]]:
    """Kind of scene → factory by seed, and whether it is healthy."""
    makers: dict[str, tuple[Maker, bool]] = {"healthy": (make_scene, True)}
    for axis, axes in TURN_AXES.items():
        make = partial(make_scene, motion=Motion(tilt_deg=40.0, axes=axes))
        makers[f"turns about the camera's {axis} only"] = (make, False)
    small, none = (partial(make_scene, motion=Motion(tilt_deg=tilt)) for tilt in (4.0, 0.0))
    makers["turns of 4 degrees at most"] = (small, False)
    makers["no turns"] = (none, False)
    makers["one view, repeated"] = (_repeating(1), False)
    makers["two views, repeated"] = (_repeating(2), False)
    return makers


def try_scenes(num_seeds: int, num_healthy: int, bar: Bar) -> list[SceneResult]:
    """Try every kind of scene, with seeds not used elsewhere in the stage."""
    makers = scene_makers()
    ours = next(method for method in METHODS if method.name == OURS)
    results = []
    with bar("refusals", len(makers)) as step:
        for name, (make, is_healthy) in makers.items():
            step(name)
            num = num_healthy if is_healthy else num_seeds
            scenes = [make(10_000 + seed) for seed in range(num)]
            results.append(_try(name, scenes, ours, is_healthy=is_healthy))
    return results


def _try(name: str, scenes: list[Scene], ours: Method, *, is_healthy: bool) -> SceneResult:
    causes: list[InvalidInputError] = []
    for scene in scenes:
        try:
            ours.solve(scene)
        except InvalidInputError as refusal:
            causes.append(refusal)
    named = [
        cause
        for cause in causes
        if isinstance(cause, DegenerateMotionError) and cause.details["missing_axes"]
    ]
    return SceneResult(
        name,
        is_healthy,
        len(scenes),
        num_refused=len(causes),
        num_named=len(named),
        cause=causes[0].message if causes else "",
        rivals={m.name: _what_it_does(m, scenes) for m in METHODS if m.name in RIVALS},
    )


def _what_it_does(method: Method, scenes: list[Scene]) -> str:
    """Median error of a method, and how often it gives no result."""
    solved = []
    for scene in scenes:
        try:
            solved.append(score(method, scene))
        except InvalidInputError:
            continue
    silent = len(scenes) - len(solved)
    unanswered = f"no answer in {silent} of {len(scenes)}" if silent else ""
    if not solved:
        return unanswered
    degrees = np.median([one.error_deg for one in solved])
    millimetres = np.median([one.error_mm for one in solved])
    return f"{degrees:.2g} deg, {millimetres:.3g} mm" + (f"; {unanswered}" if unanswered else "")


def _repeating(num_views: int) -> Maker:
    return lambda seed: make_scene(seed, Motion(num_views=4)).repeated(
        [index % num_views for index in range(20)]
    )


NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# Below this number of cameras the spread is too uncertain to compare.
MIN_SEEDS = 10


@dataclass(frozen=True)
class CameraResult:
    """Cameras calibrated from `num_views` views, in the order of the seeds.

    `focal_error` is |df| / f, `centre_px` the distance of the principal point, `rms_px` the
    residual, which is no measure of accuracy, `coverage` the share of the image that corners cover,
    `ms` processor time of this thread. `sigma_over_spread` is, by parameter, the reported sigma
    (RMS over the seeds) over the spread of the errors; ideally 1, empty for few seeds.
    """

    num_views: int
    focal_error: Figure
    centre_px: Figure
    rms_px: Figure
    coverage: Figure
    ms: Figure
    sigma_over_spread: dict[str, float]


def measure_cameras(counts: tuple[int, ...], num_seeds: int, bar: Bar) -> list[CameraResult]:
    """Cameras from each number of views, for each seed."""
    with bar("intrinsics", len(counts) * num_seeds) as step:
        results = []
        for num_views in counts:
            rows = []
            for seed in range(num_seeds):
                step(f"{num_views} views")
                rows.append(_calibrate(simulated_boards(20_000 + seed, num_views)))
            results.append(_result(num_views, np.array(rows)))
        return results


def _calibrate(boards: FoundBoards) -> Float64[np.ndarray, "21"]:
    """Errors (9), sigmas (9), residual, coverage, time."""
    begun_s = time.thread_time()
    found = calibrate_found(boards)
    ms = (time.thread_time() - begun_s) * 1e3
    place = [0, 1, 0, 1], [0, 1, 2, 2]
    return np.array(
        [
            *(found.K[place] - K[place]),
            *(found.distortion - DISTORTION),
            *found.sigma_fxfycxcy_px,
            *found.sigma_distortion,
            found.rms_px,
            found.coverage,
            ms,
        ]
    )


def _result(num_views: int, rows: np.ndarray) -> CameraResult:
    errors, sigmas = rows[:, :9], rows[:, 9:18]
    ratios: dict[str, float] = {}
    if len(rows) >= MIN_SEEDS:
        shares = np.sqrt(np.square(sigmas).mean(axis=0)) / errors.std(axis=0)
        ratios = dict(zip(NAMES, (float(share) for share in shares), strict=True))
    focal = np.abs(errors[:, :2] / K[[0, 1], [0, 1]]).max(axis=1)
    return CameraResult(
        num_views,
        focal_error=Figure.of(focal.tolist()),
        centre_px=Figure.of(np.linalg.norm(errors[:, 2:4], axis=1).tolist()),
        rms_px=Figure.of(rows[:, 18].tolist()),
        coverage=Figure.of(rows[:, 19].tolist()),
        ms=Figure.of(rows[:, 20].tolist()),
        sigma_over_spread=ratios,
    )


PROMISED_VIEWS = 25
# Differences below half of the uncertainty are insignificant.
TOLERANCE_SIGMAS = 0.5


def tables(
    results: Results, cameras: Sequence[CameraResult], refusals: Sequence[SceneResult]
) -> list[ResultTable]:
    """All tables of the stage."""
    noise = "0.3 px, tracker 0.5 mm and 0.05 degrees an axis"
    return [
        ResultTable(
            f"Hand-eye, {noise}: median (9 of 10 seeds below)",
            ("method", "time (ms)", "rotation (deg)", "translation (mm)", "NEES / dof"),
            [
                (
                    result.name,
                    _spread(result.ms),
                    _spread(result.error_deg),
                    _spread(result.error_mm),
                    "" if result.nees is None else f"{np.mean(result.nees.values):.2f}",
                )
                for result in results.values()
            ],
        ),
        ResultTable(
            "Intrinsics by number of views: median (9 of 10 seeds below)",
            (
                "views",
                "focal error (%)",
                "centre (px)",
                "left over (px)",
                "sigma / spread",
                "time (ms)",
            ),
            [
                (
                    str(camera.num_views),
                    _spread(camera.focal_error.scaled(100)),
                    _spread(camera.centre_px),
                    f"{camera.rms_px.median:.2f}",
                    _range(list(camera.sigma_over_spread.values())),
                    _spread(camera.ms),
                )
                for camera in cameras
            ],
        ),
        ResultTable(
            "Degenerate scenes (other methods: median error of their results)",
            ("scene", "ours refuses", "axes named", *RIVALS),
            [
                (
                    scene.name,
                    f"{scene.num_refused} of {scene.num_seeds}",
                    f"{scene.num_named} of {scene.num_refused}" if scene.num_refused else "",
                    *(scene.rivals[name] for name in RIVALS),
                )
                for scene in refusals
            ],
        ),
    ]


def _spread(figure: Figure) -> str:
    return f"{figure.median:.3g} ({np.percentile(figure.values, 90):.3g})"


def _range(ratios: list[float]) -> str:
    return f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else ""


def requirements(
    results: Results, cameras: Sequence[CameraResult], refusals: Sequence[SceneResult]
) -> list[Requirement]:
    """Build the table of requirements; some may be unmeasured in this run."""
    known, park = results[OURS_SIZE_KNOWN], results[PARK]
    shares = not_worse_share(known, park, tolerance_sigmas=TOLERANCE_SIGMAS)
    worse = f"seeds not worse than Park by {TOLERANCE_SIGMAS:g} sigma"
    promised = [camera for camera in cameras if camera.num_views == PROMISED_VIEWS]
    focal = promised[0].focal_error.median if promised else None
    ratios = promised[0].sigma_over_spread.values() if promised else ()
    least, most = min(ratios, default=None), max(ratios, default=None)
    what = f"intrinsics, {PROMISED_VIEWS} views"
    bad = [scene for scene in refusals if not scene.is_healthy]
    num_bad = sum(scene.num_seeds for scene in bad)
    axes_named = sum(scene.num_named for scene in bad) / num_bad if num_bad else None
    healthy = [scene.num_refused for scene in refusals if scene.is_healthy]
    return [
        *_mount(results[OURS]),
        *_mount(results[OURS_POSES]),
        *(
            at_least(f"hand-eye, {kind}: {worse}", share, 0.9)
            for kind, share in zip(("rotation", "translation"), shares, strict=True)
        ),
        at_most(f"{what}: focal error, median", focal, 0.003),
        at_least(f"{what}: sigma over spread, smallest of 9", least, 0.5),
        at_most(f"{what}: sigma over spread, largest of 9", most, 2.0),
        at_least("degenerate scenes refused, axes to add named", axes_named, 1.0),
        at_most("healthy scenes refused", float(sum(healthy)) if healthy else None, 0.0),
    ]


def _mount(ours: MethodResult) -> list[Requirement]:
    what = f"hand-eye, {ours.name}"
    nees = None if ours.nees is None else float(np.mean(ours.nees.values))
    return [
        at_most(f"{what}: rotation, median", ours.error_deg.median, 0.06, "deg"),
        at_most(f"{what}: translation, median", ours.error_mm.median, 0.8, "mm"),
        at_least(f"{what}: NEES by degree of freedom", nees, 0.5),
        at_most(f"{what}: NEES by degree of freedom", nees, 2.0),
        at_most(f"{what}: processor time, median", ours.ms.median, 100.0, "ms"),
    ]


def notes(results: Results) -> list[str]:
    """Notes on results that the requirements do not show."""
    texts = []
    for name in (OURS, OURS_POSES, OURS_SIZE_KNOWN):
        rotation, translation = not_worse_share(results[name], results[PARK], tolerance_sigmas=0.0)
        texts.append(
            f"{name}: without tolerance its error is at most Park's in {rotation:.0%} of the seeds "
            f"(rotation) and {translation:.0%} (translation). Both use the same noisy data, so "
            "even the better estimator does not have the smaller error in every seed."
        )
    return texts


AMOUNTS = Amounts(
    usual={"seeds": 100, "camera_seeds": 20, "scenes": 20, "healthy": 50},
    quick={"seeds": 4, "camera_seeds": 2, "scenes": 2, "healthy": 2},
)
USUAL_COUNTS, QUICK_COUNTS = (8, 15, 25, 40), (8, 25)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, seeds="hand-eye scenes")
    parser.add_argument("--views", type=int, default=20, help="views per scene (%(default)s)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Solve scenes of known mounts and cameras with every method, then degenerate scenes."""
    plan = AMOUNTS.of(options)
    motion = Motion(num_views=options.views)
    with bar("making scenes", plan["seeds"]) as step:
        scenes = []
        for seed in range(plan["seeds"]):
            step(f"seed {seed}")
            scenes.append(make_scene(seed, motion))
    results = compare(scenes, bar)
    counts = QUICK_COUNTS if options.quick else USUAL_COUNTS
    cameras = measure_cameras(counts, plan["camera_seeds"], bar)
    refusals = try_scenes(plan["scenes"], plan["healthy"], bar)
    return StageReport(
        stage="calibration",
        packages=("numpy", "scipy", "opencv-contrib-python-headless"),
        options={**plan, "motion": asdict(motion)},
        tables=tables(results, cameras, refusals),
        requirements=requirements(results, cameras, refusals),
        data={
            "hand_eye": results,
            "cameras": cameras,
            "refusals": refusals,
        },
        notes=notes(results),
    )
