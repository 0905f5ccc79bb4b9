"""Detection of degenerate hand-eye scenes by each method, and acceptance of healthy ones."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.calibration.compare import score
from benchmarks.calibration.rivals import METHODS, OURS, Method
from benchmarks.simulated.board_scenes import TURN_AXES, Motion, Scene, make_scene
from benchmarks.stages import Bar
from dextouch.errors import InvalidInputError
from services.alignment.calibration.motion import DegenerateMotionError

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
        makers[f"turns about the camera's {axis} only"] = (
            _maker(Motion(tilt_deg=40.0, axes=axes)),
            False,
        )
    makers["turns of 4 degrees at most"] = (_maker(Motion(tilt_deg=4.0)), False)
    makers["no turns"] = (_maker(Motion(tilt_deg=0.0)), False)
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
    causes = [cause for scene in scenes if (cause := _refusal(ours, scene)) is not None]
    named = [cause for cause in causes if _names_axes(cause)]
    return SceneResult(
        name,
        is_healthy,
        len(scenes),
        num_refused=len(causes),
        num_named=len(named),
        cause=causes[0].message if causes else "",
        rivals={m.name: _what_it_does(m, scenes) for m in METHODS if m.name in RIVALS},
    )


def _names_axes(cause: InvalidInputError) -> bool:
    return isinstance(cause, DegenerateMotionError) and bool(cause.details["missing_axes"])


def _refusal(method: Method, scene: Scene) -> InvalidInputError | None:
    try:
        method.solve(scene)
    except InvalidInputError as refusal:
        return refusal
    return None


def _what_it_does(method: Method, scenes: list[Scene]) -> str:
    """Median error of a method, and how often it gives no result."""
    solved = []
    for scene in scenes:
        try:
            solved.append(score(method, scene))
        except InvalidInputError:
            continue
    silent = len(scenes) - len(solved)
    told = f"no answer in {silent} of {len(scenes)}" if silent else ""
    if not solved:
        return told
    degrees = np.median([one.error_deg for one in solved])
    millimetres = np.median([one.error_mm for one in solved])
    return f"{degrees:.2g} deg, {millimetres:.3g} mm" + (f"; {told}" if told else "")


def _maker(motion: Motion) -> Maker:
    return lambda seed: make_scene(seed, motion)


def _repeating(num_views: int) -> Maker:
    return lambda seed: make_scene(seed, Motion(num_views=4)).repeated(
        [index % num_views for index in range(20)]
    )
