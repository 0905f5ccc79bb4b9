"""Detection of degenerate hand-eye scenes by each method, and acceptance of healthy ones."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

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
    told = f"no answer in {silent} of {len(scenes)}" if silent else ""
    if not solved:
        return told
    degrees = np.median([one.error_deg for one in solved])
    millimetres = np.median([one.error_mm for one in solved])
    return f"{degrees:.2g} deg, {millimetres:.3g} mm" + (f"; {told}" if told else "")


def _repeating(num_views: int) -> Maker:
    return lambda seed: make_scene(seed, Motion(num_views=4)).repeated(
        [index % num_views for index in range(20)]
    )
