"""Registry of the benchmark stages by name, loaded lazily."""

import argparse
import importlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

from benchmarks.report import StageReport
from dextouch.errors import InvalidInputError, UnknownNameError

T = TypeVar("T")
# Opens a progress bar: (what, number of steps) → a function that is called with each step's name.
Bar = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]


@runtime_checkable
class Stage(Protocol):
    """Interface of a benchmark stage, implemented by modules with these two functions."""

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add the stage's own options; every stage has --quick, --json, --out and --check."""

    def measure(self, options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
        """Run the benchmark; the folder is for temporary files, which the caller removes.

        Raises:
            InvalidInputError: options that measure nothing, such as no round, or do not fit.
            UnknownNameError: a name in the options that there is not.
            ConflictError: a command that the stage runs failed.
        """


@dataclass(frozen=True)
class Amounts:
    """Amounts that a stage measures by name: usual and quick ones, and options for some."""

    usual: dict[str, Any]
    quick: dict[str, Any]

    def add_options(self, parser: argparse.ArgumentParser, **what: str) -> None:
        """Add an option for each of these amounts; the texts say of what."""
        for name, text in what.items():
            usual, quick = self.usual[name], self.quick[name]
            flag = f"--{name.replace('_', '-')}"
            parser.add_argument(flag, type=type(usual), help=f"{text} ({usual:g}; quick {quick:g})")

    def of(self, options: argparse.Namespace, **least: int | float) -> dict[str, Any]:
        """The amounts of a run, those that options set instead of the default ones.

        Raises:
            InvalidInputError: an option that is less than 1, or than `least` says.
        """
        plan = {}
        for name, default in (self.quick if options.quick else self.usual).items():
            given = getattr(options, name, None)
            plan[name] = default if given is None else given
            if not plan[name] >= (bound := least.get(name, 1)):
                flag = name.replace("_", "-")
                raise InvalidInputError(
                    f"--{flag}: got {plan[name]:g}, expected at least {bound:g}"
                )
        return plan


class StageEntry(NamedTuple):
    """Module, summary and help text of a stage."""

    module: str
    does: str
    teaches: str


STAGES = {
    "acquisition": StageEntry(
        "benchmarks.acquisition.benchmark",
        "decode glove packets from a noisy line and time every driver",
        "Sends packets of three glove families over a line with bit errors and byte loss, and "
        "counts wrong packets and lost undamaged ones, for our decoders and for simple baselines "
        "(start mark and length; end mark only). Times every decoder by size of the reads, and "
        "every driver (gloves, trackers, bridges, robot, cameras), and reads eight gloves at 60 Hz "
        "on pseudo-terminals. Close other programs first: timings on a busy machine are not "
        "meaningful.",
    ),
    "store": StageEntry(
        "benchmarks.store.benchmark",
        "write and read a take, compared with zarr-python and MCAP",
        "Writes one take of a full station (three cameras 640 by 480 at 30 Hz, two gloves, "
        "finger and pose trackers, actions) with every design alternately, then reads random "
        "windows: 17 images of one camera with the touch of both hands and the actions of the "
        "same interval. Reports wall time, processor time, bytes and image error of each design, "
        "the latency of small appends to the spool, late rows of a recording in real time, and "
        "the requirements on the store. Close other programs first: timings on a busy machine are "
        "not meaningful.",
    ),
    "loader": StageEntry(
        "benchmarks.loader",
        "read training windows from disk, compared with what training consumes",
        "Records twin episodes (or reads --store) and times, alternately and with one thread: "
        "training steps of the world model on windows in memory, the loader of "
        "`dextouch train world-model --streaming` alone, and both together. Reports the ratio of "
        "the loader's throughput to that of training.",
    ),
    "evaluator": StageEntry(
        "benchmarks.evaluator.benchmark",
        "compare imagined success with success in the twin",
        "Rolls out scripts with graded position errors, scripts with mistakes of other kinds, "
        "policies that cannot succeed (holding still, retreating, another scene's actions) and "
        "cloned policies in closed loop, in the twin and in the world model, from the same "
        "held-out first observations. The success classifier (judge) decides imagined success from "
        "the imagined ending alone. Reports the judge's accuracy on "
        "true endings, imagined against real success of rollouts and of policies, calibration, "
        "errors of chained touch and images compared with baselines, the effect of another "
        "episode's actions, and hands that hold still for 1000 steps, with intervals over the "
        "starts, and mean and worst of several training seeds. Results are kept in --keep, so an "
        "interrupted run resumes.",
    ),
    "direct-judge": StageEntry(
        "benchmarks.direct_judge",
        "train the evaluator's baseline, which imagines nothing",
        "Trains a judge that predicts success from the first observation and the commands alone, "
        "on the true robot episodes of some stores: a start reader like the world model's on the "
        "poses of objects, then a recurrent network on outcomes. A share of the scenes is held out "
        "for early stopping, calibration and the reported metrics. `python -m benchmarks evaluator "
        "--direct` compares imagined endings with it (docs/evaluation.md).",
    ),
    "objects": StageEntry(
        "benchmarks.objects",
        "find objects by markers, clicks and touch, compared with the usual recipes",
        "Renders takes of the twin whose objects carry ArUco markers, sharp and with blur and "
        "noise, and compares the poses that alignment measures (all markers of an object, edges "
        "fitted, the two solutions told apart) with those of the usual recipe (the largest marker, "
        "corners refined by gradients) and with the truth: errors, share of images in which "
        "objects were found, and time an image. Errors of clicks by their noise, and of touch in "
        "takes that succeeded, compared with the place of the first contact.",
    ),
    "touch": StageEntry(
        "benchmarks.touch_alone",
        "train a world model on takes whose objects nothing but touch has located",
        "Records takes of the twin with mistakes, leaves the poses of their objects and the times "
        "of events out, and trains a world model and a judge on the rest, with a file that says "
        "how objects are held. Replays the takes of split C: AUC of imagined success against the "
        "recorded outcomes. Finished steps are kept in --keep, so an interrupted run resumes.",
    ),
    "starts": StageEntry(
        "benchmarks.starts",
        "read starts under other cameras, amid episodes and with objects of other sizes",
        "Starts the state model from observations of the twin whose image another camera might "
        "have taken (exposure, colour, contrast, blur, noise, JPEG, a shift), from steps 32 and 64 "
        "of a take, and with objects of other widths. Reports the error of every object's "
        "position at the start, whether it is within what the readers expect of themselves, and "
        "the success of the exact script, real and imagined, with how much of it is decided.",
    ),
    "rollouts": StageEntry(
        "benchmarks.rollouts.benchmark",
        "time a chunk of a rollout, compared with an echo of the same bytes",
        "Serves rollouts of a world that computes nothing, a bare ASGI echo and a minimal "
        "WebSocket server like openpi's in a separate process, and times chunks of 16 steps over "
        "HTTP and over the WebSocket, with the last image or all of them, alternating with the "
        "servers they are compared with; one variant keeps its rollouts in Redis. Then advances 32 "
        "concurrent rollouts on a device that takes 5 ms per step, batched and one at a time. "
        "Close other programs first: timings on a busy machine are not meaningful.",
    ),
    "agreement": StageEntry(
        "benchmarks.agreement",
        "measure how often an evaluation's intervals contain the true value",
        "Simulates studies of 3, 6 and 10 policies from ten starts with known success rates in "
        "both worlds, and computes 95 % intervals of Pearson's r, MMRV and bias from the "
        "posterior of a random-effects model, as reports do, and from a hierarchical bootstrap. "
        "Reports coverage and width of the intervals, and processor time.",
    ),
    "clocks": StageEntry(
        "benchmarks.clocks.benchmark",
        "synchronize device clocks, compared with arrival times and regressions",
        "Simulates takes with queueing, polling, packet loss and congestion, and with clocks that "
        "drift, wander and jump, and estimates the time of every sample by several methods: our "
        "fits online and offline, arrival times, least squares, a smoothed offset regression, and "
        "a line through the minima of each second. Reports errors against ground truth and "
        "processor time per sample, also for streams without timestamps, and the requirements on "
        "clocks.",
    ),
    "calibration": StageEntry(
        "benchmarks.calibration.benchmark",
        "calibrate camera mounts and cameras, compared with OpenCV",
        "Simulates views of a board with pixel and tracker noise and estimates the camera's mount "
        "with our weighted bundle adjustment and with every method of OpenCV on the same scenes; "
        "calibrates cameras from few and many views; and tries degenerate motion. "
        "Reports processor time, errors against ground truth, the consistency of our standard "
        "deviations, and the requirements on calibration.",
    ),
    "alignment": StageEntry(
        "benchmarks.alignment.benchmark",
        "align takes from the spool to the episode, compared with arrival times",
        "Records takes of a simulated station (two gloves, keypoints of both hands, three poses "
        "and a camera, with clock drift, delays and packet loss; gloves calibrated with a separate "
        "take), and stores and aligns each by several methods: with fitted clocks as the alignment "
        "service does, and with arrival times, interpolated or with the nearest sample. Reports "
        "processor time by step (storing, clock fits, calibration, resampling, retargeting, "
        "writing), errors of sample times, wrists, fingertips and pressures against ground truth, "
        "and the requirements on alignment.",
    ),
    "retargeting": StageEntry(
        "benchmarks.retargeting.benchmark",
        "retarget hands, compared with dex-retargeting and dexi-rs",
        "Simulates motions of the robot's own hands (all joints at once, up to 9 rad/s, without "
        "contact, without and with 1 mm of noise) and pinches of people of five sizes, and "
        "computes joint angles with our solver and with every objective of the other libraries, on "
        "the same samples. Reports processor time per sample, errors of fingertips and joints "
        "against ground truth, gaps of pinches, cold starts, behaviour on lost samples, and the "
        "requirements on retargeting. The other libraries are an extra: "
        "pip install -c constraints.txt '.[bench]'.",
    ),
    "closure": StageEntry(
        "benchmarks.closure.benchmark",
        "replay human takes of the twin with its robot hand",
        "Records scripted human takes of the twin, retargets them, and replays them with the robot "
        "hand and the same object poses: with the wrist copied, shifted by a constant or by a "
        "touch-dependent offset, with fingertips moved to the human's, and with commands that "
        "reproduce the human's forces. Reports success and the timing of contacts "
        "(docs/twin_closure.md).",
    ),
    "twin": StageEntry(
        "benchmarks.twin.benchmark",
        "step the twin with different requested images and coarser solvers",
        "Steps one chunk of a demonstration with contact repeatedly from the same state, with "
        "different requested cameras and steps; then replays every chunk with contact of held-out "
        "demonstrations with coarser MuJoCo solvers. Reports processor time, and errors of pad "
        "forces and object positions after one chunk relative to the default solver.",
    ),
    "world-model": StageEntry(
        "benchmarks.world_model.benchmark",
        "predict held-out demonstrations with different settings",
        "Records held-out demonstrations of the twin and predicts them with the world model from "
        "their first step, chunk after chunk, with 1, 2 and 4 Euler steps, in float32 and "
        "bfloat16, compared with repeating the first step; then times it by requested images and "
        "batch size, and likewise the state model. Reports processor time per chunk and errors of "
        "images and touch over whole rollouts.",
    ),
    "reproduction": StageEntry(
        "benchmarks.reproduction.benchmark",
        "reproduce the paper's tables in miniature, in the twin",
        "Records data in the twin, trains world models, adapts them, evaluates and trains "
        "policies, and writes the tables beside the paper's numbers (docs/reproduction.md). Every "
        "step is a dextouch command. A stopped run is continued by the same command; steps that "
        "are done are not run again unless their commands changed. Exits with status 1 if a step "
        "fails, also without --check; --quick has very small sizes, to try the steps.",
    ),
    "stress": StageEntry(
        "benchmarks.stress.benchmark",
        "check every stage of the platform against numerical hazards",
        "Checks every stage of the platform with inputs that break numerical code (near-singular "
        "rotations, clock steps, NaN, saturated touch, 1000 steps, …) and reports the outcome: a "
        "specific error, or a result within its bound. Exits with status 1 if a "
        "cell fails, also without --check; --quick skips slow cells (docs/stress.md).",
    ),
}


def named(kind: str, known: Mapping[str, T], names: str) -> dict[str, T]:
    """Those of the comma-separated names.

    Raises:
        UnknownNameError: a name that there is not.
    """
    found = [name.strip() for name in names.split(",")]
    for name in found:
        if name not in known:
            raise UnknownNameError(kind, name, list(known))
    return {name: known[name] for name in found}


def load_stage(name: str) -> Stage:
    """Import the module of a known stage."""
    return cast("Stage", importlib.import_module(STAGES[name].module))
