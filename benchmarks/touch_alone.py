"""The stage `touch`: a world model of takes whose objects touch, and some clicks, have located."""

import argparse
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.figures import at_least
from benchmarks.object_places import GRIPS, clicked_image, described_objects
from benchmarks.report import ResultTable, StageReport
from benchmarks.reproduction.steps import Step, run, step_with_result
from benchmarks.stages import Bar
from dextouch.episodes import EpisodeGrid, EpisodeStore, split_of
from dextouch.errors import ConflictError
from dextouch.schemas import EpisodeClicks, ObjectClicks, SceneObject

NUM_TAKES: Final = 84
_OBJECTS, _LAB, _RECORDED = "objects.json", "lab", "recorded"
_MODEL, _JUDGE, _SCORES = "model.safetensors", "judge.safetensors", "scores.json"
# Steps of readers, cores and the judge, and CPU s of the renderer.
_STEPS, _QUICK_STEPS = (2000, 1500, 600, 150), (2, 2, 5, 1)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    add = parser.add_argument
    add("--takes", type=int, default=NUM_TAKES, help="takes a task (%(default)s)")
    add("--tasks", default=",".join(GRIPS), metavar="A,B", help="(%(default)s)")
    init = "state model of other tasks to adapt, such as `evaluator/pretrained/model/"
    add("--init", type=Path, metavar="PATH", help=init + "model.safetensors` of a reproduction")
    add("--clicks", type=int, default=0, help="first images a task that are clicked (%(default)s)")
    members = "members of the model (as many as the initial model has, or 3)"
    add("--members", type=int, metavar="N", help=members)
    keep = Path("runs/touch")
    add("--keep", type=Path, default=keep, help="folder of data and results (%(default)s)")
    add("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record takes, leave their objects out, train on them, and replay held-out takes."""
    keep: Path = options.keep
    data = step_with_result(
        _RECORDED,
        f"train data --store {_RECORDED}/store --tasks {options.tasks} --count {options.takes} "
        f"--images 4 --jobs {options.jobs}",
        "store",
        exits=(0, 1),
    )
    _run([data], keep)
    _strip(keep, options.clicks)
    _run(_trainings(options, data), keep)
    scores = json.loads((keep / "scored" / _SCORES).read_text(encoding="utf-8"))
    trust: dict[str, dict[str, Any]] = scores["trust"]
    return StageReport(
        stage="touch",
        packages=("numpy", "torch", "mujoco-core"),
        options={
            "takes": options.takes,
            "tasks": options.tasks,
            "clicks": options.clicks,
            "init": options.init is not None,
            "members": options.members,
        },
        tables=[_table(trust)],
        requirements=[
            at_least(f"AUC, {task}", float(one.get("auc") or "nan"), 0.80)
            for task, one in trust.items()
        ],
        data={"trust": trust},
    )


def _run(steps: list[Step], keep: Path) -> None:
    if failed := run(steps, keep, 1):
        raise ConflictError(f"touch: {failed[0]} failed; its log is in {keep / failed[0]}")


def _strip(keep: Path, num_clicked: int) -> None:
    """The takes as a lab has them, and the file of their objects, with clicks on some first images.

    Of the twin remain what devices recorded, the outcome, and the seed, which names the scene.
    """
    source, lab = EpisodeStore(keep / _RECORDED / "store"), EpisodeStore(keep / _LAB)
    hidden: dict[str, Any] = {
        "streams": (),
        "object_names": (),
        "object_boxes_m": (),
        "event_times_s": {},
    }
    tasks: dict[str, tuple[SceneObject, ...]] = {}
    clicks: dict[str, EpisodeClicks] = {}
    counts: Counter[str] = Counter()
    draw = np.random.default_rng(0)
    for name in source.list():
        reader = source.open(name)
        about, take = reader.attributes, EpisodeGrid(reader)
        if about.task not in tasks:
            tasks[about.task] = described_objects(take)
        if counts[about.task] < num_clicked and split_of(about) in ("A", "B"):
            clicks[name] = clicked_image(take, tasks[about.task], draw)
            counts[about.task] += 1
        if lab.exists(name):
            continue
        with lab.writer(kind="episode", attributes=about.model_copy(update=hidden)) as writer:
            for stream in about.streams:
                if not stream.name.startswith("object"):
                    kept = reader.read(stream.name)
                    writer.add_stream(stream)
                    writer.append(stream.name, values=kept.values, t_ref_ns=kept.t_ref_ns)
    described = ObjectClicks(tasks=tasks, episodes=clicks)
    (keep / _OBJECTS).write_text(described.model_dump_json(), encoding="utf-8")


def _trainings(options: argparse.Namespace, data: Step) -> list[Step]:
    reader, core, judge, drawing_s = _QUICK_STEPS if options.quick else _STEPS
    base = "world-model" if options.init is None else f"adapt --init {options.init.resolve()}"
    members = "" if options.members is None else f"--num-members {options.members} "
    model = step_with_result(
        "model",
        f"train {base} --episodes {_LAB} --clicks {_OBJECTS} --splits A,B --heldout-share 0.1 "
        f"--reader.num-steps {reader} --core.num-steps {core} --drawing.cpu-budget-s {drawing_s} "
        f"{members}--jobs {options.jobs} --output model/{_MODEL}",
        _MODEL,
        needs=(data,),
    )
    imagined = step_with_result(
        "imagined",
        f"train imagined --episodes {_LAB} --store imagined/store --checkpoint model/{_MODEL} "
        f"--jobs {options.jobs}",
        "store",
        needs=(model,),
    )
    judged = step_with_result(
        "judge",
        f"train judge --episodes {_LAB},imagined/store --splits A,B --output judge/{_JUDGE} "
        f"--training.num-training-steps {judge} --training.held-out-share 0.2 "
        "--training.development-share 0.25",
        _JUDGE,
        needs=(imagined,),
    )
    scored = Step(
        "scored",
        f"evaluate recorded --episodes {_LAB} --split C --checkpoint model/{_MODEL} "
        f"--probe judge/{_JUDGE} --hold --json scored/{_SCORES}",
        (_SCORES,),
        needs=(judged,),
    )
    return [model, imagined, judged, scored]


def _table(trust: dict[str, dict[str, Any]]) -> ResultTable:
    rows = [
        (
            task,
            str(one["takes"]),
            f"{one['real']:.2f}",
            _share(one.get("imagined")),
            str(one["decided"]),
            _share(one.get("wrong")),
            _area(one),
        )
        for task, one in trust.items()
    ]
    columns = ("task", "takes", "real", "imagined", "decided", "wrong of these", "AUC (95 %)")
    return ResultTable("Recorded takes of split C, replayed in the world model", columns, rows)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _area(one: dict[str, Any]) -> str:
    if one.get("auc") is None:
        return "-"
    low, high = one["auc_interval"]
    return f"{one['auc']:.2f} ({low:.2f} … {high:.2f})"
