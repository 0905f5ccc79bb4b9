"""The benchmark stage `calibration`: its measurements, tables and requirements."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.calibration.compare import (
    OURS,
    OURS_POSES,
    OURS_SIZE_KNOWN,
    PARK,
    RIVALS,
    CameraResult,
    MethodResult,
    Results,
    SceneResult,
    compare,
    measure_cameras,
    not_worse_share,
    try_scenes,
)
from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure, Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.simulated.board_scenes import Motion, make_scene
from benchmarks.stages import Amounts, Bar

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


def panels(results: Results) -> list[Panel]:
    """Time against rotation error, time against translation error; medians of all seeds."""
    errors = (
        ("Hand-eye, rotation", "median error (degrees)", "error_deg"),
        ("Hand-eye, translation", "median error (mm)", "error_mm"),
    )
    return [
        Panel(
            title,
            "processor ms a mount",
            label,
            [
                Point(
                    label=result.name,
                    time=result.ms.median,
                    time_low=float(np.percentile(result.ms.values, 10)),
                    time_high=float(np.percentile(result.ms.values, 90)),
                    error=getattr(result, key).median,
                    is_ours=result.name.startswith("our"),
                )
                for result in results.values()
            ],
        )
        for title, label, key in errors
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
    told = []
    for name in (OURS, OURS_POSES, OURS_SIZE_KNOWN):
        rotation, translation = not_worse_share(results[name], results[PARK], tolerance_sigmas=0.0)
        told.append(
            f"{name}: without tolerance its error is at most Park's in {rotation:.0%} of the seeds "
            f"(rotation) and {translation:.0%} (translation). Both use the same noisy data, so "
            "even the better estimator does not have the smaller error in every seed."
        )
    return told


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
        panels=panels(results),
        requirements=requirements(results, cameras, refusals),
        data={
            "hand_eye": results,
            "cameras": cameras,
            "refusals": refusals,
        },
        notes=notes(results),
    )
