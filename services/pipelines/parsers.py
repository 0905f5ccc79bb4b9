"""Parsers of commands that join services; importing them imports none of the work."""

import argparse
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from dextouch.bridges.formats import FORMATS
from dextouch.command_line import RAY_HELP, CommandParser, add_json, add_workers, positive
from dextouch.data_folder import default_store
from dextouch.episodes import SPLITS
from dextouch.errors import InvalidInputError
from services.evaluation.bundled_policies import BUNDLED
from services.evaluation.prediction_names import BASELINES, DEFAULT_BASELINES, METRIC_NAMES
from services.twin.names import (
    DEFAULT_MIX,
    EVALUATED,
    MIX_NAMES,
    STREAM_CHOICES,
    TAKE_PATHS,
    TASK_SETS,
)
from services.world_model.shipped_checkpoints import default_checkpoint

# Descriptions and examples by command.
_WORDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
TASKS = ("stand_bottle", "stack_bowls")
# No training or tuning uses seeds from 30000 on; the evaluator benchmark takes the first ones.
FIRST_HELD_OUT_SEED = 31_000


def comma_separated(text: str) -> tuple[str, ...]:
    """Parse names, for argparse."""
    return tuple(name for name in text.split(",") if name)


def seed_range(text: str) -> range:
    """Parse seeds given as FIRST:LAST+1, for argparse."""
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop)):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected FIRST:LAST+1 such as 0:100")
    return range(int(first), int(stop))


def _named_path(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not (separator and name and path):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=CHECKPOINT")
    return name, Path(path)


def _whole_fps(text: str) -> int:
    """Frames per second of a LeRobot dataset, whose format counts whole ones."""
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not math.isfinite(rate_hz) or rate_hz != round(rate_hz):
        near = f"; {round(rate_hz)} is the nearest" if math.isfinite(rate_hz) else ""
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a whole number, since LeRobot counts whole frames{near}"
        )
    return round(rate_hz)


def _moment(text: str) -> datetime:
    """A day, which begins at midnight here, or a time, which is that of here if it has no zone."""
    try:
        return datetime.fromisoformat(text).astimezone()
    except (ValueError, OverflowError) as error:
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected a day or a time such as 2026-05-04 or 2026-05-04T12:30+02:00"
        ) from error


def _parsed(text: str, *, form: Any, expected: str) -> Any:  # noqa: ANN401 - of this form
    try:
        return TypeAdapter(form).validate_json(text)
    except ValidationError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}") from error


_keywords = partial(_parsed, form=dict[str, Any], expected="a JSON object")
_keywords_by_name = partial(
    _parsed, form=dict[str, dict[str, Any]], expected="an object of objects"
)


# Options that choose items, as on the dashboard's list.
EXPORT_FILTERS: dict[str, dict[str, Any]] = {
    "text": {"metavar": "TEXT", "help": "in id, task, instruction, operator, station or trace"},
    "task": {"metavar": "TASK", "help": "of this task"},
    "operator": {"metavar": "P", "help": "of this operator"},
    "station": {"metavar": "NAME", "help": "of this station"},
    "domain": {"choices": ("human", "robot"), "help": "of this domain"},
    "outcome": {"choices": ("success", "failure", "not_judged"), "help": "with this outcome"},
    "origin": {"choices": ("recorded", "twin", "imagined"), "help": "of this origin"},
    "review": {"choices": ("accepted", "rejected", "not_reviewed"), "help": "with this review"},
    "after": {"type": _moment, "metavar": "DAY", "help": "recorded on this day or later"},
    "before": {"type": _moment, "metavar": "DAY", "help": "recorded before this day"},
}


def training_data_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch train data`."""
    parser = _parser("train data")
    add = parser.add_argument
    add("--store", required=True, help="folder of the episode store")
    add("--first", type=int, default=0, help="first seed (%(default)s)")
    add("--count", type=int, default=130, help="seeds per task (%(default)s)")
    tasks = f"tasks, or sets of tasks: {', '.join(TASK_SETS)} (default: {','.join(EVALUATED)})"
    add("--tasks", type=comma_separated, default=EVALUATED, metavar="A,B", help=tasks)
    add("--domains", type=comma_separated, default=("robot",), help="robot,human (robot)")
    path = (
        "write takes as they are, by devices and alignment with the twin's labels, or as a station "
        "records them, with poses from markers (robot: direct, human: devices)"
    )
    add("--path", choices=TAKE_PATHS, help=path)
    mixes = parser.add_mutually_exclusive_group()
    kinds = "kinds of takes (%(default)s)"
    mixes.add_argument("--mix", choices=MIX_NAMES, default=DEFAULT_MIX, help=kinds)
    for name, effect in (("exact", "without errors"), ("ladder", "with errors of 0 … 40 mm")):
        short = mixes.add_argument(f"--{name}", dest="mix", action="store_const", const=name)
        short.help = f"only scripts {effect}"
    add("--miss-fraction", type=float, help="share of misses (default: the mix's)")
    add("--still-fraction", type=float, help="share of takes that stop or never start")
    add("--policy", metavar="[NAME=]MODULE:FACTORY", help="record rollouts of this policy instead")
    arguments = "arguments of the factory, as a JSON object"
    add("--policy-arguments", type=_keywords, default={}, help=arguments)
    images = "images of every N-th step (%(default)s)"
    add("--images", type=int, default=1, metavar="N", help=images)
    wrists = "the wrist cameras, too, for --network.further-views (in a store without such takes)"
    add("--wrist-cameras", action="store_true", help=wrists)
    looks = "share of scenes with other colours, light and head camera (%(default)s)"
    add("--varied", type=float, default=0.0, metavar="SHARE", help=looks)
    sizes = "share of takes whose objects are wider, narrower, higher or lower (%(default)s)"
    add("--resized", type=float, default=0.0, metavar="SHARE", help=sizes)
    add("--streams", choices=STREAM_CHOICES, default="training", help="(%(default)s)")
    add_workers(parser)
    add_json(parser)
    return parser


def _parser(command: str) -> CommandParser:
    return CommandParser(prog=f"dextouch {command}", **_WORDS[command])


def _imagination_parser(command: str) -> CommandParser:
    parser = _parser(command)
    add = parser.add_argument
    add("--episodes", required=True, metavar="URL", help="store of the episodes to imagine")
    add("--store", required=True, metavar="URL", help="store for the imagined episodes")
    model = "world model (default: the package's)"
    add("--checkpoint", type=Path, default=default_checkpoint(), metavar="PATH", help=model)
    add("--tasks", type=comma_separated, metavar="TASK,…", help="default: all")
    add("--seeds", type=seed_range, metavar="FIRST:LAST+1", help="default: all")
    add("--split", choices=SPLITS, help="only scenes of this split (default: all)")
    add_workers(parser)
    add_json(parser)
    return parser


def imagined_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch train imagined`."""
    return _imagination_parser("train imagined")


def generate_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch generate`."""
    parser = _imagination_parser("generate")
    add = parser.add_argument
    add("--count", type=positive, metavar="N", help="largest number of episodes, over all tasks")
    add("--with-failures", action="store_true", help="also imagine episodes that failed")
    add("--strips", type=Path, metavar="PATH", help="HTML page of recorded and imagined images")
    strips = "episodes on that page (%(default)s)"
    add("--num-strips", type=positive, default=12, metavar="N", help=strips)
    return parser


def prediction_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch evaluate prediction`."""
    parser = _parser("evaluate prediction")
    add = parser.add_argument
    add("--episodes", required=True, metavar="STORE", help="store of held-out episodes")
    add("--checkpoint", type=Path, metavar="PATH", help="world model (default: the package's)")
    add("--tasks", type=comma_separated, default=(), help="comma-separated (default: the model's)")
    horizon = "only windows or only rollouts (default: both)"
    add("--horizon", choices=("windows", "rollouts"), help=horizon)
    names = f"comma-separated, of {', '.join(METRIC_NAMES)} (default: all)"
    add("--metrics", type=comma_separated, default=(), help=names)
    weights = "folder of pretrained networks for the metrics that need them (docs/evaluation.md)"
    add("--weights", type=Path, metavar="PATH", help=weights)
    names = f"comma-separated, of {', '.join(BASELINES)} (default: without instructions)"
    add("--baselines", type=comma_separated, default=DEFAULT_BASELINES, help=names)
    steps = "network calls per chunk of a flow-matching model"
    add("--sampling-steps", type=int, metavar="N", help=steps)
    add_json(parser)
    return parser


def recorded_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch evaluate recorded`."""
    # Settings need a package that reading and writing files does not.
    from services.evaluation.settings import DEFAULT_PROBE

    parser = _parser("evaluate recorded")
    add = parser.add_argument
    stores = "stores of the takes"
    add("--episodes", required=True, type=comma_separated, metavar="URL,…", help=stores)
    add("--tasks", type=comma_separated, default=(), metavar="A,B", help="default: all")
    add("--split", choices=SPLITS, help="only scenes of this split (default: all)")
    add("--count", type=positive, metavar="N", help="takes a task (default: all)")
    model = "world model (default: the package's)"
    add("--checkpoint", type=Path, default=default_checkpoint(), metavar="PATH", help=model)
    judge = "checkpoint of `dextouch train judge` (default: the package's)"
    add("--probe", type=Path, default=DEFAULT_PROBE, metavar="PATH", help=judge)
    own = "a policy of yours, [NAME=]MODULE:FACTORY; repeat for more"
    add("--policy", action="append", default=[], metavar="ADDRESS", help=own)
    keywords = "arguments of the factories, as a JSON object by policy name"
    add("--policy-arguments", type=_keywords_by_name, default={}, metavar="JSON", help=keywords)
    cloned = "a policy of `dextouch train policy`, NAME=CHECKPOINT; repeat for more"
    add("--cloned", action="append", type=_named_path, default=[], metavar="POLICY", help=cloned)
    add("--builtin", action="append", choices=BUNDLED, default=[], help="built-in; repeatable")
    add("--hold", action="append_const", dest="builtin", const="hold", help="--builtin hold")
    add_json(parser)
    return parser


def study_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch study`."""
    parser = CommandParser(
        prog="dextouch study",
        description="Score policies in real and imagined worlds from matched starts.",
        epilog="`dextouch study serve` shows the results on the dashboard.",
    )
    words = parser.add_subparsers(dest="word", required=True, metavar="COMMAND")
    run = words.add_parser("run", help="run a study, or continue it", **_WORDS["study run"])
    add = run.add_argument
    add("study", type=Path, metavar="STUDY", help="study file (TOML)")
    results = "folder of results, rollouts and reports (default: the study file without .toml)"
    add("--folder", type=Path, metavar="PATH", help=results)
    store = "episode store of the rollouts; with the dashboard's store, it plays them (default: "
    add("--store", metavar="URL", help=f"{store}rollouts/ in the folder)")
    add("--retry-failed", action="store_true", help="run rollouts again that failed before")
    add("--ray", metavar="ADDRESS", help=RAY_HELP)
    about = "write the report of a study's results so far"
    report = words.add_parser("report", help=about, **_WORDS["study report"])
    report.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the study")
    for one in (run, report):
        add_json(one)
    return parser


def _bridge_parser(command: str) -> argparse.ArgumentParser:
    parser = _parser(command)
    store = "the store (%(default)s)"
    parser.add_argument("--store", metavar="URL", default=default_store(), help=store)
    add_json(parser)
    return parser


def _add_filters(parser: argparse.ArgumentParser) -> None:
    about = "only items that match all of them; a DAY may be a time, too"
    add = parser.add_argument_group("filters", about).add_argument
    for name, words in EXPORT_FILTERS.items():
        add(f"--{name}", **words)


def export_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch export`."""
    parser = _bridge_parser("export")
    add = parser.add_argument
    add("ids", nargs="*", metavar="ID", help="default: all that match the filters")
    add("--format", required=True, choices=tuple(FORMATS), help="output format")
    to = "file; mcap and rrd: or a folder"
    add("--to", required=True, type=Path, metavar="PATH", help=to)
    kinds = ("episode", "recording")
    add("--kind", choices=kinds, default="episode", help="kind of the ids (%(default)s)")
    _add_filters(parser)
    rejected = "also items that were rejected in review; ids that are given always are"
    add("--with-rejected", action="store_true", help=rejected)
    old = parser.add_mutually_exclusive_group()
    old.add_argument("--force", action="store_true", help="replace existing files")
    grow = "lerobot: add the episodes that an existing data set lacks"
    old.add_argument("--append", action="store_true", help=grow)
    quality = "mcap: encode rgb8 images as JPEG (default: lossless)"
    add("--jpeg-quality", type=int, metavar="1…100", help=quality)
    pictures = "mcap: pictures of touch beside the numbers (default: with)"
    add("--touch-images", action=argparse.BooleanOptionalAction, default=True, help=pictures)
    layout = "mcap: write a layout for Foxglove there (default: beside the files in a folder)"
    add("--layout", type=Path, metavar="PATH", help=layout)
    rate = "lerobot: frames per second (default: model rate)"
    add("--fps", type=_whole_fps, metavar="N", help=rate)
    which = "lerobot: only these, such as camera_head (default: all with colours)"
    add("--cameras", type=comma_separated, metavar="NAME,…", help=which)
    name = "lerobot: name of the data set (%(default)s)"
    add("--repo-id", default="dextouch/export", metavar="USER/NAME", help=name)
    licence = "lerobot: licence on the data set's card, such as cc-by-4.0"
    add("--license", metavar="ID", help=licence)
    touch = "lerobot: also every touch sample between two frames"
    add("--touch-samples", action="store_true", help=touch)
    return parser


def check_format_options(
    parser: argparse.ArgumentParser, options: argparse.Namespace, form: str
) -> None:
    """Raise InvalidInputError for an option that a format of the parser's command has no use of."""
    column = "import_options" if "path" in vars(options) else "export_options"
    names_of = {one: getattr(known, column) or () for one, known in FORMATS.items()}
    for name in sorted({name for names in names_of.values() for name in names}):
        used = [one for one, names in names_of.items() if name in names]
        if getattr(options, name) != parser.get_default(name) and form not in used:
            flag = "--" + name.replace("_", "-")
            flag = "--no-touch-images" if name == "touch_images" else flag
            raise InvalidInputError(f"{flag} is for format {' or '.join(used)}, got {form!r}")


class _Mapping(argparse.Action):
    """Collects NAME=SOURCE; a name that comes twice is refused."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        name, found, source = str(values).partition("=")
        known = getattr(namespace, self.dest)
        if not (name and found and source) or name in known:
            parser.error(f"{option_string}: got {values!r}, expected STREAM=SOURCE, each once")
        setattr(namespace, self.dest, known | {name: source})


def import_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch import`."""
    parser = _bridge_parser("import")
    add = parser.add_argument
    add("path", type=Path, metavar="PATH", help="file or folder to read")
    forms = tuple(name for name, form in FORMATS.items() if form.import_options is not None)
    add("--format", choices=forms, help="input format (default: that of the content)")
    prefix = "prefix of every id, but not of our own mcap exports"
    add("--id-prefix", default="", metavar="TEXT", help=prefix)
    images = "unit of images (default: as they are, and h264 for video that must be decoded)"
    add("--images", choices=("h264", "jpeg", "rgb8"), help=images)
    mapped = "name the stream of a topic, entity or feature; repeat it for more"
    add("--map", action=_Mapping, default={}, metavar="STREAM=SOURCE", help=mapped)
    layout = "mcap, rrd: layout of mapped tactile streams (default: that of our own glove)"
    add("--layout", type=Path, metavar="FILE", help=layout)
    timeline = "rrd: timeline of the samples (default: the only one with times)"
    add("--timeline", metavar="NAME", help=timeline)
    task = "task (default: the data set's, or imported)"
    add("--task", metavar="TASK", help=task)
    add("--instruction", default="", metavar="TEXT", help="the task's sentence")
    domain = "who acts (default: lerobot robot, others human)"
    add("--domain", choices=("human", "robot"), help=domain)
    matrix = "lerobot: matrix of camera_head in pixels, CX and CY as OpenCV has them plus 0.5"
    add("--k-head", type=_camera_matrix, metavar="FX,FY,CX,CY", help=matrix)
    rate = "lerobot: frames per second instead of the data set's times"
    add("--fps", type=float, metavar="HZ", help=rate)
    return parser


def _camera_matrix(text: str) -> tuple[tuple[float, float, float], ...]:
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError:
        fx = fy = cx = cy = math.nan
    if not (fx > 0 and fy > 0 and math.isfinite(fx + fy + cx + cy)):
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected FX,FY,CX,CY such as 600,600,320,240"
        )
    return ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class DemoPlan:
    """Plan of one run.

    `levels_mm` are the errors of the scripted demonstrator, which give policies of different
    quality; `mistakes` are scripts with mistakes of kinds that no training data contain;
    `num_seeds` is the number of held-out scenes per task. The world model is measured on
    `num_predicted` scenes per task, with each of the errors `predicted_noise_m`.
    """

    output: Path
    json: Path | None
    train: bool
    num_seeds: int
    levels_mm: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0)
    mistakes: tuple[str, ...] = ("frame_yaw 0.4", "low_rate 0.5", "side_approach 0.4")
    predicted_noise_m: tuple[float, ...] = (0.0, 0.02)
    num_predicted: int = 3
    take_seed: int = FIRST_HELD_OUT_SEED + 900

    @property
    def seeds(self) -> range:
        """Seeds of the held-out scenes for policies."""
        return range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + self.num_seeds)


def demo_parser() -> CommandParser:
    """Parser of `dextouch demo`."""
    parser = CommandParser(
        prog="dextouch demo",
        epilog="example:\n  dextouch demo --output runs/demo --seeds 2",
        description="Record a human and a robot take through mock devices, align them, compare "
        "with ground truth, predict with the world model, and score policies in the twin and "
        "in the world model. Ends with a table, report.json and report.html; both takes stay in "
        f"the store {default_store()}, where the next run replaces them (DEXTOUCH_DATA sets "
        "another data folder).",
    )
    results = "folder of the results (%(default)s)"
    parser.add_argument("--output", type=Path, default=Path("demo"), metavar="FOLDER", help=results)
    add_json(parser)
    train = (
        "train a small state model, the policy and the probe instead of using the committed ones "
        "(takes much longer than the demo itself)"
    )
    parser.add_argument("--train", action="store_true", help=train)
    scenes = "held-out scenes per task for scoring policies (%(default)s)"
    parser.add_argument("--seeds", type=int, metavar="N", default=6, help=scenes)
    return parser


def demo_plan(argv: Sequence[str]) -> DemoPlan:
    """Parse the command line of `dextouch demo`; `--help` prints the usage and exits."""
    parser = demo_parser()
    arguments = parser.parse_args(list(argv))
    if arguments.seeds < 1:
        parser.error(f"--seeds: got {arguments.seeds}, expected at least 1")
    return DemoPlan(arguments.output, arguments.json, arguments.train, arguments.seeds)
