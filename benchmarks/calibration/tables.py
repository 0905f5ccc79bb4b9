"""Tables and charts of the calibration benchmark."""

from collections.abc import Sequence

import numpy as np

from benchmarks.calibration.cameras import CameraResult
from benchmarks.calibration.compare import Results
from benchmarks.calibration.refusals import RIVALS, SceneResult
from benchmarks.chart import Panel, Point
from benchmarks.figures import Figure
from benchmarks.report import ResultTable


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
