"""Options of an alignment, settings of its service, and the parser of `dextouch align`."""

import argparse
import os
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr

from dextouch.command_line import RAY_HELP, CommandParser, add_json, positive
from dextouch.data_folder import data_folder, default_spool, default_store, is_bucket_url
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import SceneObjects
from dextouch.serving import ServiceSettings, load_settings, service_config

WristChoice = Literal["tracked", "touch"]
EPILOG = """examples:
  dextouch align run take-7 take-8           align two recordings in parallel
  dextouch align run --all --workers 2       align all recordings without an episode
  dextouch align run --all --ray auto        the same on the machines of a Ray cluster
  dextouch align run --all --objects objects.json
                                             with the poses of objects that have markers
  dextouch align report take-7               clock fits, retargeting errors, omitted parts
  dextouch align retarget take-7 --model hand.urdf --mapping hand.toml --to joints.npz
                                             joint angles of another robot hand
  dextouch align serve --port 8082           run the HTTP service

An episode's id is derived from the recording and the options: aligning again finds it and writes
nothing, so an interrupted run can simply be started again."""


class AlignmentOptions(FrozenModel):
    """Options of one alignment; they are part of the episode's identity.

    A `wrist` as tracked is not written, and nor are `objects` if there are none.
    """

    model_rate_hz: float = Field(default=15.0, gt=0, le=1000, description="rate of the model grid")
    max_gap_ms: float = Field(
        default=50.0,
        gt=0,
        le=10_000,
        description="longest gap between samples that is interpolated; of slow streams it is 2.5 "
        "nominal periods",
    )
    max_bridged_ms: float = Field(
        default=250.0,
        ge=0,
        le=10_000,
        description="longest gap that remains in the episode: its steps are interpolated, marked, "
        "and not trained on; 0 ends the episode at every gap",
    )
    min_num_steps: int = Field(
        default=17, ge=2, description="fewest measured steps that become an episode"
    )
    wrist: WristChoice = Field(
        default="tracked",
        exclude_if=lambda wrist: wrist == "tracked",
        description="poses of human wrists and fingertips: as tracked, or moved so that the "
        "robot's hand touches where the person's did",
    )
    objects: SceneObjects | None = Field(
        default=None,
        exclude_if=lambda objects: objects is None,
        description="objects of the tasks, whose poses become streams of the episodes",
    )

    def of_task(self, task: str) -> "AlignmentOptions":
        """The options that matter to recordings of one task."""
        if self.objects is None:
            return self
        return self.model_copy(update={"objects": self.objects.of_task(task)})

    @property
    def max_bridged_steps(self) -> int:
        """Steps in a row that may be interpolated across a gap and marked."""
        return int(self.max_bridged_ms * 1e-3 * self.model_rate_hz)

    @property
    def longest_bridge_ns(self) -> int:
        """Two samples that are further apart are never connected."""
        step_ns = 1e9 / self.model_rate_hz
        return max(self.max_gap_ns, round((self.max_bridged_steps + 2) * step_ns))

    @property
    def max_gap_ns(self) -> int:
        """The largest gap in nanoseconds; slow streams may have longer ones (`stream_gap_ns`)."""
        return round(self.max_gap_ms * 1e6)


def usable_cores() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


class AlignmentSettings(ServiceSettings):
    """Serve alignment over HTTP, and align recordings that arrive in a store.

    The options are used for requests that do not set their own.

    Example:
      dextouch align serve --store-url data/store --port 8082
    """

    model_config = service_config("alignment", "dextouch align serve")

    store_url: str = Field(
        default_factory=default_store,
        min_length=1,
        description="store that recordings arrive in: folder, file:///… or s3://…",
    )
    jobs_folder: Path | None = Field(
        default=None, description="folder of the jobs (default: .alignments in the store)"
    )
    options: AlignmentOptions = AlignmentOptions()
    objects: Path | None = Field(
        default=None,
        description="JSON file of the tasks' objects, whose poses are measured (docs/objects.md)",
    )
    num_workers: int = Field(
        default_factory=usable_cores,
        ge=1,
        le=64,
        description="concurrent alignments, each in its own process (default: one per core)",
    )
    max_waiting: int = Field(default=10_000, ge=1, le=100_000, description="waiting jobs")
    max_kept: int = Field(default=10_000, ge=1, le=100_000, description="finished jobs to keep")
    max_attempts: int = Field(
        default=3, ge=1, le=100, description="starts of a job whose process dies before it fails"
    )
    align_new: bool = Field(
        default=True, description="align every recording that arrives in the store"
    )
    look_period_s: float | None = Field(
        default=None,
        gt=0,
        le=3600,
        description="seconds between listings of the store (default: 2; 30 for a bucket)",
    )

    station_url: str | None = Field(
        default=None, description="URL of the station whose devices are calibrated over HTTP"
    )
    station_key: SecretStr | None = Field(default=None, description="bearer key of the station")
    station_spool: Path = Field(
        default_factory=default_spool,
        description="spool of the station; calibration takes that are not there are read from the "
        "store",
    )
    calibration_folder: Path = Field(
        default_factory=lambda: data_folder() / "calibration",
        description="folder of the station's calibration",
    )

    @cached_property
    def wanted_options(self) -> AlignmentOptions:
        """The options, with the objects of the file; raises as `SceneObjects.load`."""
        if self.objects is None:
            return self.options
        return self.options.model_copy(update={"objects": SceneObjects.load(self.objects)})

    @property
    def period_s(self) -> float:
        """Seconds between two listings of the store."""
        if self.look_period_s is not None:
            return self.look_period_s
        # Listing a bucket takes a request for every thousand files in it.
        return 30.0 if is_bucket_url(self.store_url) else 2.0


def align_parser(settings: AlignmentSettings) -> argparse.ArgumentParser:
    """Parser of `dextouch align`, whose default store is that of the settings."""
    parser = CommandParser(
        prog="dextouch align",
        description="Convert recordings to synchronized, retargeted episodes in the same store.",
        epilog=EPILOG,
    )
    shared = CommandParser(add_help=False)
    shared.add_argument(
        "--store", default=settings.store_url, metavar="URL", help="the store (%(default)s)"
    )
    shared.add_argument(
        "--objects",
        type=Path,
        metavar="FILE",
        help="JSON file of the tasks' objects, whose poses are measured by markers or trackers",
    )
    add_json(shared)
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="{run,report,retarget,markers,serve}"
    )
    running = commands.add_parser(
        "run",
        parents=[shared],
        help="align recordings",
        description="Align recordings; those that have an episode are left as they are.",
        epilog=EPILOG,
    )
    running.add_argument("recordings", nargs="*", metavar="ID", help="of a recording")
    running.add_argument("--all", action="store_true", help="all recordings without an episode")
    running.add_argument("--ray", metavar="ADDRESS", help=RAY_HELP)
    running.add_argument(
        "--workers",
        type=positive,
        default=usable_cores(),
        metavar="N",
        help="recordings at once, each in a process of its own (default: one a processor)",
    )
    report = commands.add_parser(
        "report",
        parents=[shared],
        help="report on an aligned recording",
        description="Show clocks, retargeting and what was left out of an episode, and why.",
        epilog="example:\n  dextouch align report take-7 --json report.json",
    )
    report.add_argument("id", metavar="ID", help="of a recording or of its episode")
    other = commands.add_parser(
        "retarget",
        parents=[shared],
        help="retarget a recording to another robot hand",
        description="Joint angles of any robot hand that follow the tracked hand of an episode, "
        "written as NPZ: joint_names, t_ref_ns, joints_rad, status, tip_error_m.",
        epilog="example:\n  dextouch align retarget take-7 --model allegro_right.urdf \\\n"
        "    --mapping allegro_right.toml --to take-7_allegro.npz\n\n"
        "The mapping is described in docs/hands.md.",
    )
    other.add_argument("id", metavar="ID", help="of an episode, or of its recording")
    other.add_argument("--model", type=Path, required=True, metavar="FILE", help="URDF or MJCF")
    other.add_argument(
        "--mapping", type=Path, required=True, metavar="FILE", help="TOML: fingers, joints, wrist"
    )
    other.add_argument("--to", type=Path, required=True, metavar="FILE", help="NPZ to write")
    sheet = commands.add_parser(
        "markers",
        help="make a sheet of the objects' markers to print",
        description="Write the markers of a file of objects as SVG in true size: print it at 100 % "
        "and measure one side.",
        epilog="example:\n  dextouch align markers --objects objects.json --to markers.svg",
    )
    sheet.add_argument("--objects", type=Path, required=True, metavar="FILE", help="of the objects")
    sheet.add_argument("--to", type=Path, required=True, metavar="FILE", help="SVG to write")
    commands.add_parser("serve", help="run the HTTP service (serve --help lists its settings)")
    return parser


def default_parser() -> argparse.ArgumentParser:
    """Parser of `dextouch align` with the settings of the environment and dextouch.toml."""
    return align_parser(load_settings(AlignmentSettings, []))
