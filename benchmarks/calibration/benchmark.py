"""Entry point of the benchmark stage `calibration`."""

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.calibration.cameras import measure_cameras
from benchmarks.calibration.compare import compare
from benchmarks.calibration.refusals import try_scenes
from benchmarks.calibration.tables import notes, panels, requirements, tables
from benchmarks.report import StageReport
from benchmarks.simulated.board_scenes import Motion, make_scene
from benchmarks.stages import Amounts, Bar

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
            "hand_eye": {name: asdict(result) for name, result in results.items()},
            "cameras": [asdict(camera) for camera in cameras],
            "refusals": [asdict(scene) for scene in refusals],
        },
        notes=notes(results),
    )
