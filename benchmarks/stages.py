"""Registry of the benchmark stages by name, loaded lazily."""

import argparse
import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol, cast, runtime_checkable

from benchmarks.report import StageReport
from dextouch.errors import UnknownNameError

# Opens a progress bar: (what, number of steps) → a function that is called with each step's name.
Bar = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]


@runtime_checkable
class Stage(Protocol):
    """Interface of a benchmark stage, implemented by modules with these two functions."""

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add the stage's own options; every stage has --quick, --json, --out and --check."""

    def measure(self, options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
        """Run the benchmark.

        Args:
            options: parsed command line.
            folder: for temporary files; the caller removes it.
            bar: opens a progress bar.
        """


class StageEntry(NamedTuple):
    """Module, summary and help text of a stage."""

    module: str
    does: str
    teaches: str


STAGES = {
    "acquisition": StageEntry(
        "benchmarks.acquisition.benchmark",
        "decode packets of gloves over a bad line, time every driver",
        "Sends packets of three glove families over a line with bit errors and byte loss, and "
        "counts what our decoders and their rivals (the mark and a length; the mark alone) give "
        "that was never sent, and what they lose untouched. Times every way by the size of reads "
        "and the decoder of every driver (gloves, trackers, bridges, robot, cameras), and reads "
        "eight gloves at 60 Hz on pseudo terminals. Close other programs first: timings on a busy "
        "machine say little.",
    ),
    "store": StageEntry(
        "benchmarks.store.benchmark",
        "write and read a take: ours, zarr-python, MCAP",
        "Writes one take of a whole station (three cameras 640 by 480 at 30 Hz, two gloves, "
        "finger and pose trackers, actions) with every design in turn, then reads windows of it "
        "at random: 17 images of one camera with the touch of both hands and the actions of "
        "their time. Reports time, processor time, bytes and image error of each design, the "
        "latency of small appends to the spool, and a paced run that counts late rows; ends "
        "with what the store promises and whether it holds. Close other programs first: timings "
        "on a busy machine say little.",
    ),
    "loader": StageEntry(
        "benchmarks.loader",
        "read training windows from the disk as fast as training needs them",
        "Makes twin episodes (or reads --store) and times, in turns and with one thread: training "
        "steps of the world model on windows that are in memory, the loader of "
        "`dextouch train world-model --streaming` alone, and both together. Ends with how many "
        "times faster windows are read than learned from.",
    ),
    "evaluator": StageEntry(
        "benchmarks.evaluator.benchmark",
        "compare success that a world model imagines with that in the twin",
        "Rolls out a dense ladder of scripts, policies that cannot succeed (holding still, "
        "retreating, another scene's actions) and cloned policies in closed loop, in the twin and "
        "in the world model from the same first observations, on starts that nothing was trained "
        "on. The judge tells imagined success from the imagined ending alone. Reports the judge on "
        "true endings, imagined against real success for each rollout and for the policies, "
        "calibration, chained touch and images beside a copy, the warped start and true context, "
        "what another episode's actions cost, and hands that hold still for 1000 steps, with "
        "intervals over the starts; of several training seeds the mean and the worst. Everything "
        "is kept in --keep when it is computed, so a run that was broken off goes on where it "
        "stood.",
    ),
    "rollouts": StageEntry(
        "benchmarks.rollouts.benchmark",
        "time a chunk of a rollout beside an echo of the same bytes",
        "Serves rollouts of a world that computes nothing, a bare ASGI echo and a minimal "
        "WebSocket server of openpi's kind in a process of their own, and times chunks of 16 "
        "steps over HTTP and over the WebSocket, with the last image or all of them, in turns "
        "with what they are compared with; one way keeps its rollouts in Redis. Then advances 32 "
        "rollouts at once on a device that takes 5 ms for one, batched and one by one. Close "
        "other programs first: timings on a busy machine say little.",
    ),
    "agreement": StageEntry(
        "benchmarks.agreement",
        "check how often the intervals of an evaluation hold the truth",
        "Simulates studies of 3, 6 and 10 policies from ten starts whose true success rates are "
        "known in both worlds, and takes 95 % intervals of Pearson's r, MMRV and bias from the "
        "posterior of a random-effects model, as reports do, and from a hierarchical bootstrap. "
        "Reports how often the intervals hold the truth, how wide they are, and processor time.",
    ),
    "clocks": StageEntry(
        "benchmarks.clocks.benchmark",
        "date the samples of devices: ours, arrival stamps, regressions",
        "Simulates takes through paths that queue, poll, lose and congest, with clocks that drift, "
        "wander and jump, and dates every sample in several ways: our fits online and offline, "
        "arrival stamps, least squares, a smoothed offset regression, and a line through minima of "
        "one second. Reports errors against the truth and processor time a sample, also of streams "
        "that have no stamps; ends with what clocks promise and whether it holds.",
    ),
    "calibration": StageEntry(
        "benchmarks.calibration.benchmark",
        "find mounts and cameras of known places: ours beside OpenCV's methods",
        "Simulates views of a board with noise of pixels and tracker and finds the camera's mount "
        "with our weighted bundle and with every method of OpenCV, in turns on the same scenes; "
        "calibrates cameras from few and many views; and tries motion that shows no mount. "
        "Reports processor time, errors against the truth and how honest our sigmas are; ends with "
        "what calibration promises and whether it holds.",
    ),
    "alignment": StageEntry(
        "benchmarks.alignment.benchmark",
        "align takes from the spool to the episode: ours, arrival stamps",
        "Records takes of a simulated station (two gloves, keypoints of both hands, three poses "
        "and a camera; clocks that drift, paths that delay and lose; gloves calibrated by a "
        "take of their own), stores and aligns each in several ways, in turns: with fitted clocks "
        "as the alignment service does, and by arrival stamps, interpolated or with the nearest "
        "sample. Reports processor time by step (storing, clock fits, calibration, resampling, "
        "retargeting, writing) and errors against the truth in times of samples, wrists, "
        "fingertips and pressures; ends with what alignment promises and whether it holds.",
    ),
    "retargeting": StageEntry(
        "benchmarks.retargeting.benchmark",
        "follow hands with the robot: ours, dex-retargeting, dexi-rs",
        "Moves the robot's own hands (all joints at once, up to 9 rad/s, free of contact, without "
        "and with 1 mm of noise) and hands of people of five sizes who pinch, and finds the joint "
        "angles with our solver and with every objective of its rivals, on the same samples. "
        "Reports processor time a sample in turns, errors of tips and joints against the truth, "
        "how far pinches stay open, what is found from nothing and what becomes of samples that a "
        "tracker loses; ends with what retargeting promises and whether it holds. Rivals are an "
        "extra: pip install -c constraints.txt '.[bench]'.",
    ),
    "closure": StageEntry(
        "benchmarks.closure.benchmark",
        "play human takes of the twin again with its robot hand",
        "Records scripted human takes of the twin, retargets them, and plays them with the robot "
        "hand where the human found the objects: with the wrist copied, moved by one offset or by "
        "touch, with fingertips led to the human's, and with commands that press as hard as the "
        "human did. Reports success, and how early or late contacts begin and end "
        "(docs/twin_closure.md).",
    ),
    "twin": StageEntry(
        "benchmarks.twin.benchmark",
        "step the twin by cameras and steps asked, and with coarser solvers",
        "Steps one chunk of a demonstration with contact from the same state again and again, in "
        "turns, by the cameras and steps that are asked for; then plays every chunk with contact "
        "of held-out demonstrations with coarser solvers of MuJoCo. Reports processor time, and "
        "how far pad forces and objects are from those of the twin as it is served after one "
        "chunk.",
    ),
    "world-model": StageEntry(
        "benchmarks.world_model.benchmark",
        "imagine held-out demonstrations: sampling steps, precision, images asked",
        "Makes demonstrations of the twin that nothing was trained on and lets the world model "
        "imagine them from their first step, chunk after chunk, with 1, 2 and 4 Euler steps, in "
        "float32 and bfloat16, beside a world that repeats the first step; then times it by the "
        "images that are asked for and the rollouts that step together. Reports processor time a "
        "chunk and errors of images and touch over whole rollouts.",
    ),
    "stress": StageEntry(
        "benchmarks.stress.benchmark",
        "check every stage of the platform against numerical hazards",
        "Checks every stage of the platform with inputs that break numerical code (near-singular "
        "rotations, clock steps, NaN, saturated touch, 1000 steps, …) and reports the outcome: a "
        "named refusal, a bounded answer or a figure against its bound. Exits with status 1 if a "
        "cell fails, also without --check; --quick skips slow cells (docs/stress.md).",
    ),
}


def load_stage(name: str) -> Stage:
    """Import the module of a stage.

    Raises:
        UnknownNameError: no such stage.
    """
    if name not in STAGES:
        raise UnknownNameError("stage", name, list(STAGES))
    return cast("Stage", importlib.import_module(STAGES[name].module))
