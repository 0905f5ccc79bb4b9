"""The benchmark stage `starts`: what the state model makes of starts unlike those of training."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.ndimage import gaussian_filter

from benchmarks.evaluator.playing import (
    play_in_imagination,
    play_in_twin,
    stage_poses,
    start_amid,
    start_in_twin,
)
from benchmarks.figures import Requirement, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.clients import PolicyStart
from dextouch.images import decode_jpeg, encode_jpeg
from dextouch.schemas import ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from services.evaluation.settings import DEFAULT_PROBE
from services.evaluation.success_classifier import SuccessClassifier
from services.twin.settings import TwinSettings
from services.twin.stage import Actions, script_name, scripted_actions
from services.twin.tasks import EVALUATED, named_tasks
from services.twin.world import TwinWorld
from services.world_model.checkpoints import read_state_checkpoint
from services.world_model.shipped_checkpoints import default_checkpoint
from services.world_model.state_world import StateWorld

FIRST_SEED = 45_000
AMOUNTS: Final = Amounts(usual={"starts": 20}, quick={"starts": 2})
STEPS: Final = (32, 64)
WIDTHS: Final = (0.8, 1.2)
_LAST = ReturnSelector(steps="last")
Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Camera:
    """A change of the head camera: of its image, and a shift that its matrix knows (px)."""

    change: Callable[[Float64[np.ndarray, "h w 3"], np.random.Generator], np.ndarray]
    shift_px: tuple[int, int] = (0, 0)


def _gain(factor: float, red: float = 1.0, blue: float = 1.0) -> Camera:
    return Camera(lambda image, _: image * factor * np.array([red, 1.0, blue]))


def _mild(image: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    changed = 0.5 + 0.9 * (image * 1.1 * np.array([1.06, 1.0, 0.94]) - 0.5)
    changed = gaussian_filter(changed, (0.4, 0.4, 0)) + draw.normal(scale=0.01, size=image.shape)
    return _jpeg(changed.clip(0, 1), 60)


def _jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    return decode_jpeg(encode_jpeg(_pixels(image), quality=quality)) / 255.0


CAMERAS: Final[dict[str, Camera]] = {
    "as in the twin": _gain(1.0),
    "brighter by 15 %": _gain(1.15),
    "darker by 15 %": _gain(0.85),
    "warmer": _gain(1.0, red=1.12, blue=0.88),
    "contrast less by 20 %": Camera(lambda image, _: image.mean() + 0.8 * (image - image.mean())),
    "blurred by 0.7 px": Camera(lambda image, _: gaussian_filter(image, (0.7, 0.7, 0))),
    "noise of 2 %": Camera(lambda image, draw: image + draw.normal(scale=0.02, size=image.shape)),
    "JPEG of quality 30": Camera(lambda image, _: _jpeg(image, 30)),
    "shifted by a known pixel": Camera(lambda image, _: image, (1, -1)),
    "all mild ones together": Camera(_mild, (1, 0)),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    files = {"--world": default_checkpoint(), "--probe": DEFAULT_PROBE}
    for flag, default in files.items():
        parser.add_argument(flag, type=Path, default=default, help="(%(default)s)")
    AMOUNTS.add_options(parser, starts="starts per task")
    tasks = ",".join(EVALUATED)
    parser.add_argument("--tasks", default=tasks, metavar="A,B", help="(%(default)s)")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED, help="(%(default)s)")


@dataclass(frozen=True)
class _Read:
    """What was read at one start: errors in mm with the expected ones, and a verdict."""

    error_mm: Float64[np.ndarray, " objects"]
    expected_mm: float
    verdict: str | None = None
    real: bool | None = None


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Start the state model from all kinds of starts of every task."""
    count = AMOUNTS.of(options)["starts"]
    tasks = named_tasks(options.tasks.split(","))
    judged = _Judged(options.world, SuccessClassifier.load(options.probe))
    found: dict[str, dict[str, list[_Read]]] = {}
    with bar("starting", len(tasks) * count) as step:
        for width in (1.0, *WIDTHS):
            settings = TwinSettings(cameras=(HEAD_CAMERA,), object_width=width)
            twin = TwinWorld(settings)
            for task in tasks:
                by_kind = found.setdefault(task, {})
                for seed in range(options.first_seed, options.first_seed + count):
                    reads = {}
                    if width == 1.0:
                        reads = judged.usual(twin, task, seed)
                        step(f"{task} {seed}")
                    elif task != "open_drawer":
                        name = f"objects {width:g} times as wide"
                        reads = {name: judged.played(twin, task, seed)}
                    for kind, read in reads.items():
                        by_kind.setdefault(kind, []).append(read)
    return StageReport(
        stage="starts",
        packages=("numpy", "mujoco", "torch"),
        options={"starts": count, "first seed": options.first_seed},
        tables=[_errors(found), _outcomes(found)],
        requirements=_requirements(found),
        data={
            task: {k: [r.error_mm.round(2).tolist() for r in reads] for k, reads in of.items()}
            for task, of in found.items()
        },
    )


class _Judged:
    """The state model with its judge."""

    def __init__(self, checkpoint: Path, probe: SuccessClassifier) -> None:
        self._world, self._probe = StateWorld(read_state_checkpoint(checkpoint)), probe

    def usual(self, twin: TwinWorld, task: str, seed: int) -> dict[str, _Read]:
        """Starts under every camera, and from later steps."""
        started, first, start = start_in_twin(twin, task, seed, "")
        actions = scripted_actions(twin.stage(task), seed, script_name(0.0))
        real = play_in_twin(twin, started, actions, start, shows_chunks=False).success
        truth = stage_poses(twin, started.state)
        found = {}
        for name, camera in CAMERAS.items():
            seen = _seen_by(first, camera, np.random.default_rng(seed))
            is_played = name in {"as in the twin", "all mild ones together"}
            verdict = self._verdict(seen, actions, start) if is_played else None
            found[name] = replace(self._read(seen, truth), verdict=verdict, real=real)
        state = started.state
        for before, step in pairwise((0, *STEPS)):
            stepped = twin.step(state, actions[before:step], seed=0, selector=_LAST)
            state = stepped.state
            newest = stepped.observation
            image = newest.images[HEAD_CAMERA][-1]
            later = start_amid(first, image, newest.tactile_kpa[-1], newest.action_reached[-1])
            found[f"at step {step}"] = self._read(later, stage_poses(twin, state))
        return found

    def played(self, twin: TwinWorld, task: str, seed: int) -> _Read:
        """A start with the exact script, whose author does not know the sizes."""
        started, first, start = start_in_twin(twin, task, seed, "")
        actions = scripted_actions(twin.stage(task), seed, script_name(0.0))
        real = play_in_twin(twin, started, actions, start, shows_chunks=False).success
        read = self._read(first, stage_poses(twin, started.state))
        return replace(read, verdict=self._verdict(first, actions, start), real=real)

    def _read(self, first: RolloutStart, truth: np.ndarray) -> _Read:
        started = self._world.reset(first)
        poses = started.observation.object_poses
        if poses is None:
            raise ValueError("the state model gives object poses with every start")
        error_mm = 1e3 * np.linalg.norm(poses[0, :, :3] - truth[:, :3], axis=-1)
        expected = started.state.memory.start.sd_m[:, 0, : len(truth)]
        return _Read(error_mm, float(1e3 * expected.mean()))

    def _verdict(self, first: RolloutStart, actions: Actions, start: PolicyStart) -> str:
        imagined = play_in_imagination(self._world, first, actions, start, shows_chunks=False)
        return self._probe.verdict(imagined.ending(first.task)).decision


def _seen_by(first: RolloutStart, camera: Camera, draw: np.random.Generator) -> RolloutStart:
    if first.observation is None or first.K_head is None:
        raise ValueError("the twin gives an observation with every start")
    image = first.observation.images[HEAD_CAMERA][0] / 255.0
    changed = shifted(_pixels(camera.change(image, draw)), camera.shift_px)
    K = first.K_head.copy()
    K[:2, 2] += camera.shift_px
    seen = replace(first.observation, images={HEAD_CAMERA: changed[None]})
    return replace(first, observation=seen, K_head=K)


def shifted(image: Image, shift_px: tuple[int, int]) -> Image:
    """The content moved right and down by whole pixels; borders are repeated."""
    (right, down), most = shift_px, max(map(abs, shift_px))
    padded = np.pad(image, ((most, most), (most, most), (0, 0)), mode="edge")
    (height, width), (top, left) = image.shape[:2], (most - down, most - right)
    return np.ascontiguousarray(padded[top : top + height, left : left + width])


def _pixels(image: np.ndarray) -> Image:
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


Found = Mapping[str, Mapping[str, list[_Read]]]


def _errors(found: Found) -> ResultTable:
    kinds = list(dict.fromkeys(kind for of in found.values() for kind in of))
    rows = []
    for kind in kinds:
        reads = {task: of.get(kind, []) for task, of in found.items()}
        cells = [_median_90(each) for each in reads.values()]
        all_reads = [read for each in reads.values() for read in each]
        expected = np.mean([read.expected_mm for read in all_reads])
        rows.append((kind, *cells, _median_90(all_reads), f"{expected:.1f}"))
    title = "Error of an object's position at the start, median / 90 % in mm; sd expected an axis"
    return ResultTable(title, ("", *found, "all", "expected"), rows)


def _median_90(reads: list[_Read]) -> str:
    if not reads:
        return "-"
    errors = np.concatenate([read.error_mm for read in reads])
    return f"{np.median(errors):.1f} / {np.quantile(errors, 0.9):.1f}"


def _outcomes(found: Found) -> ResultTable:
    rows = []
    for task, of in found.items():
        for kind, reads in of.items():
            judged = [read for read in reads if read.verdict is not None]
            if judged:
                rows.append((f"{task}: {kind}", *(f"{value:.2f}" for value in _rates(judged))))
    columns = ("", "real", "imagined, of the decided", "decided", "wrong, of the decided")
    return ResultTable("Success of the exact script", columns, rows)


def _rates(judged: list[_Read]) -> tuple[float, float, float, float]:
    """Real success, imagined success and share of the decided rollouts, wrong ones of these."""
    real = float(np.mean([bool(read.real) for read in judged]))
    decided = [read for read in judged if read.verdict != "cannot tell"]
    if not decided:
        return real, float("nan"), 0.0, float("nan")
    said = np.array([read.verdict == "success" for read in decided])
    true = np.array([bool(read.real) for read in decided])
    return real, float(said.mean()), len(decided) / len(judged), float((said != true).mean())


def _requirements(found: Found) -> list[Requirement]:
    def median_mm(kind: str) -> float:
        reads = [read for of in found.values() for read in of.get(kind, [])]
        return float(np.median(np.concatenate([read.error_mm for read in reads])))

    bounds = {"as in the twin": 5.0, "all mild ones together": 5.0}
    bounds |= {f"at step {step}": 6.0 for step in STEPS}
    return [
        at_most(f"median error, {kind} (mm)", median_mm(kind), bound)
        for kind, bound in bounds.items()
    ]
