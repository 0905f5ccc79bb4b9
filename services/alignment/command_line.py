"""Command line of `dextouch align`: align recordings, report on them, retarget other hands."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import partial
from itertools import chain

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.progress import Progress as Bars
from rich.progress import TaskID
from rich.table import Table
from rich.text import Text

from dextouch.command_line import ProgressLines, progress, write_result
from dextouch.episodes import EpisodeReader, EpisodeStore, disk_errors
from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError
from dextouch.free_text import printable
from dextouch.hands.hand_files import load_hand
from dextouch.jobs import Workers, run_jobs
from dextouch.schemas import SceneObjects, json_ready
from dextouch.serving import load_settings
from dextouch.streams import IMAGE_FAULTS, STILL_SHARE
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from services.alignment.jobs import AlignmentWorker, align_recording, check_recording, episode_id_of
from services.alignment.retargeting import HandRetargeter, RetargetStatus
from services.alignment.retargeting.hand_retargeter import calibrated_profile
from services.alignment.schemas import AlignmentReport, report_of
from services.alignment.settings import AlignmentOptions, AlignmentSettings, align_parser
from services.alignment.synchronization import Progress
from services.alignment.synchronization.resampling import RefusedPart, RefusedReason

NS_PER_S = 1e9
# The recording, and how far it is.
OnRecordingProgress = Callable[[str, Progress], None]
# A recording, and its report or the error that prevented it.
Outcome = tuple[str, AlignmentReport | DexTouchError]
EXIT_REFUSED = 3
# Width of a report that is not printed at a terminal.
PAGE_WIDTH = 110
# Taxels for each reason, and refused parts, that a page lists; the report has all.
MAX_LISTED = 12
WHY: Mapping[RefusedReason, str] = {
    "late_start": "began later than the others",
    "early_end": "ended earlier than the others",
    "gap": "no samples",
    "jump": "samples elsewhere",
    "frozen": "frozen samples",
    "limits": "samples beyond limits",
    "shorter": "a longer stretch without a gap was taken",
}


def main(argv: Sequence[str]) -> int:
    """Run `dextouch align`; returns 0, or 3 if a recording was refused (reason on stderr)."""
    settings = load_settings(AlignmentSettings, [])
    parsed = align_parser(settings).parse_args(list(argv))
    if getattr(parsed, "objects", None) is not None:
        settings = settings.model_copy(update={"objects": parsed.objects})
    return COMMANDS[parsed.command](parsed, settings)


def _run(parsed: argparse.Namespace, settings: AlignmentSettings) -> int:
    if parsed.all == bool(parsed.recordings):
        raise InvalidInputError("run: expected either ID … or --all; see run --help")
    store = EpisodeStore(parsed.store).require_folder()
    recording_ids, refused = list(dict.fromkeys(parsed.recordings)), list[Outcome]()
    if parsed.all:
        recording_ids, refused = not_aligned(store, settings.wanted_options)
    console = Console(highlight=False, soft_wrap=True)
    reports, num_failed = [], 0
    batch = parsed.store, recording_ids, settings.wanted_options
    with _bars(console, len(recording_ids)) as on_progress:
        if parsed.ray is None:
            outcomes = align_batch(*batch, num_workers=parsed.workers, on_progress=on_progress)
        else:
            outcomes = align_on_cluster(*batch, parsed.ray)
        for _, result in chain(refused, outcomes):
            if isinstance(result, DexTouchError):
                print(f"dextouch align: {printable(result.message)}", file=sys.stderr)
                num_failed += 1
            else:
                console.print(printable(report_line(result)), markup=False)
                reports.append(json_ready(result))
    if not reports and not num_failed:
        console.print("nothing to do: no recording without its episode")
    write_result(parsed.json, reports)
    return EXIT_REFUSED if num_failed else 0


@contextmanager
def _bars(console: Console, num_recordings: int) -> Iterator[OnRecordingProgress]:
    """A bar for each recording at work and one for all; without a terminal, lines."""
    lines = ProgressLines("align", has_bar=console.is_terminal)
    tasks: dict[str, TaskID] = {}
    shares: dict[str, float] = {}
    with Bars(console=console, disable=not console.is_terminal, transient=True) as bars:
        whole = bars.add_task(f"{num_recordings} recordings", total=max(num_recordings, 1))

        def on_progress(recording_id: str, progress: Progress) -> None:
            if recording_id not in tasks:
                tasks[recording_id] = bars.add_task(recording_id, total=1.0)
            where = f"{recording_id} {progress.stage} {progress.stream or ''}"
            shares[recording_id] = progress.share
            bars.update(tasks[recording_id], completed=progress.share, description=where)
            bars.update(whole, completed=sum(shares.values()))
            num_done = sum(share >= 1 for share in list(shares.values()))
            share = f"{progress.share:.0%}"
            lines.show(f"{num_done} of {num_recordings}  {where.strip()} {share}")

        yield on_progress


def _report(parsed: argparse.Namespace, settings: AlignmentSettings) -> int:
    episode = _find_episode(parsed, settings)
    recordings = [entry.id for entry in episode.attributes.lineage if entry.kind == "recording"]
    report = report_of(episode, recording_id=(recordings or [parsed.id])[-1], created=False)
    width = None if sys.stdout.isatty() else PAGE_WIDTH
    Console(highlight=False, width=width).print(report_page(report))
    write_result(parsed.json, [json_ready(report)])
    return 0


def _retarget(parsed: argparse.Namespace, settings: AlignmentSettings) -> int:
    hand = load_hand(parsed.model, parsed.mapping)
    episode = _find_episode(parsed, settings)
    name = f"keypoints_{hand.side}"
    if name not in episode.streams:
        raise NotFoundError(
            f"episode {episode.attributes.episode_id!r}: has no {name!r}, only "
            f"{', '.join(sorted(episode.streams))}; expected an episode of a person"
        )
    stream = episode.read(name)
    retargeter = HandRetargeter(hand, calibrated_profile(episode.attributes.calibration, hand.side))
    t_s = (stream.t_ref_ns - stream.t_ref_ns[0]).astype(np.float64) / NS_PER_S
    motion = retargeter.retarget(stream.values, t_s=t_s)
    with disk_errors(f"write {parsed.to}"), parsed.to.open("wb") as file:
        np.savez(
            file,
            joint_names=np.array(hand.joint_names),
            t_ref_ns=stream.t_ref_ns,
            joints_rad=motion.joints_rad,
            status=motion.status,
            tip_error_m=motion.tip_error_m,
        )
    solved = motion.status == RetargetStatus.SOLVED
    facts = {
        "episode_id": episode.attributes.episode_id,
        "side": hand.side,
        "num_samples": len(solved),
        "joint_names": list(hand.joint_names),
        "share_solved": float(solved.mean()),
        "tip_error_mm": float(motion.tip_error_m[solved].mean() * 1e3) if solved.any() else None,
        "path": str(parsed.to),
    }
    write_result(parsed.json, facts)
    print(
        f"{parsed.to}: {len(hand.joint_names)} joints of the {hand.side} hand in "
        f"{len(solved)} samples, {solved.mean():.1%} solved"
    )
    return 0


def _markers(parsed: argparse.Namespace, settings: AlignmentSettings) -> int:
    del settings
    from services.alignment.markers import marker_sheet

    page = marker_sheet(SceneObjects.load(parsed.objects))
    with disk_errors(f"write {parsed.to}"):
        parsed.to.write_text(page, encoding="utf-8")
    print(f"{parsed.to}: print at 100 %, then measure the side of one marker")
    return 0


def align_batch(
    store_url: str,
    recording_ids: Sequence[str],
    options: AlignmentOptions,
    *,
    num_workers: int,
    on_progress: OnRecordingProgress,
) -> Iterator[Outcome]:
    """Align recordings in parallel processes; yields outcomes, also failures, as they complete.

    `on_progress` is called from several threads.
    """
    workers = [AlignmentWorker(store_url) for _ in range(num_workers)]
    idle = workers.copy()

    def align(recording_id: str) -> Outcome:
        worker = idle.pop()
        try:
            tell = partial(on_progress, recording_id)
            return recording_id, worker.run(recording_id, options, tell)
        except DexTouchError as error:
            return recording_id, error
        finally:
            idle.append(worker)

    threads = ThreadPoolExecutor(num_workers, thread_name_prefix="align")
    try:
        for ready in as_completed([threads.submit(align, one) for one in recording_ids]):
            yield ready.result()
    finally:
        # Also when the caller goes away in the middle (Ctrl-C).
        threads.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.stop()
        threads.shutdown()


def align_on_cluster(
    store_url: str, recording_ids: Sequence[str], options: AlignmentOptions, ray_address: str
) -> Iterator[Outcome]:
    """The same as `align_batch` on a Ray cluster, whose machines see the store."""
    jobs = run_jobs(
        partial(_align_one, store_url, options),
        recording_ids,
        Workers(ray_address=ray_address),
        folders=EpisodeStore(store_url).folders,
    )
    for job in progress(jobs, "align", len(recording_ids)):
        yield job.item, job.error or job.result()


def _align_one(store_url: str, options: AlignmentOptions, recording_id: str) -> AlignmentReport:
    return align_recording(EpisodeStore(store_url), recording_id, options)


def not_aligned(store: EpisodeStore, options: AlignmentOptions) -> tuple[list[str], list[Outcome]]:
    """Recordings without an episode under these options: ids to align, and what is refused."""
    recording_ids, refused = list[str](), list[Outcome]()
    for recording_id in store.list(kind="recording"):
        try:
            if not store.exists(check_recording(store, recording_id, options)):
                recording_ids.append(recording_id)
        except DexTouchError as error:
            refused.append((recording_id, error))
    return recording_ids, refused


def _find_episode(parsed: argparse.Namespace, settings: AlignmentSettings) -> EpisodeReader:
    store, item_id = EpisodeStore(parsed.store).require_folder(), parsed.id
    if store.exists(item_id):
        return store.open(item_id)
    episode_id = episode_id_of(store.recording(item_id), settings.wanted_options)
    if not store.exists(episode_id):
        raise NotFoundError(
            f"recording {item_id!r}: has no episode of the present settings ({episode_id}); make "
            f"it with `dextouch align run {item_id}`, or name another of `dextouch store list`"
        )
    return store.open(episode_id)


def report_line(report: AlignmentReport) -> str:
    """A report as one line of text."""
    verb = "aligned" if report.created else "was aligned already"
    lost = sum(clock.num_dropped for clock in report.clocks)
    absent = [f"absent: {', '.join(report.absent)}"] if report.absent else []
    facts = f"{report.num_steps} steps, {len(report.streams)} streams, {lost} samples lost"
    more = (*absent, *_refused_taxels(report), *_unreliable(report), *_implausible(report))
    return "; ".join((f"{report.recording_id} {verb}: {report.episode_id}, {facts}", *more))


def report_page(report: AlignmentReport) -> Group:
    """A report as tables for the terminal."""
    return Group(
        Text(f"{report.recording_id} → {report.episode_id}", style="bold"),
        Text(
            f"{report.domain}, {report.num_steps} steps, {report.duration_s:.1f} s; absent: "
            f"{', '.join(report.absent) or 'nothing'}"
        ),
        _clocks(report),
        *map(Text, (*_unreliable(report), *_implausible(report))),
        *([_retargeting(report.retargeting)] if report.retargeting else []),
        _refused(report.refused_parts),
        *map(Text, _refused_taxels(report)),
    )


def _unreliable(report: AlignmentReport) -> list[str]:
    found = []
    for clock in report.clocks:
        texts = {
            "skew": f"its clock is skewed by {_number(clock.skew_ppm, 0)} ppm",
            "residual": "even the earliest samples of five seconds arrive later than fitted "
            f"({_number(clock.residual_rms_ms, 1)} ms RMS of all)",
            "stop": "the device clock stopped or was slewed, or the path delay increased",
        }
        if clock.warnings:
            reasons = " and ".join(texts[warning] for warning in clock.warnings)
            found.append(f"{clock.stream}: unreliable times: {reasons}")
    return found


def _implausible(report: AlignmentReport) -> list[str]:
    texts = {
        "jump_samples": "samples elsewhere",
        "lasting_jumps": "leaps of its world",
        "frozen_samples": "frozen samples",
        "frozen_nodes": "frozen nodes",
        "repeated_samples": "repeated samples",
        "norm_samples": "samples without a rotation",
        "limits_samples": "samples beyond limits",
        "repeated_images": "repeated images",
        **{f"{fault}_samples": text for fault, text in IMAGE_FAULTS.items()},
    }
    found = [
        f"{name.removesuffix(f'_num_{what}')}: {count:.0f} {text}"
        for name, count in report.quality.items()
        for what, text in texts.items()
        if name.endswith(f"_num_{what}") and count
    ]
    found += [
        f"{name.removesuffix('_highest_zero_kpa')}: the zero is {kpa:.1f} kPa above the tare"
        for name, kpa in report.quality.items()
        if name.endswith("_highest_zero_kpa") and kpa > CONTACT_THRESHOLD_KPA
    ]
    for name, figure in report.quality.items():
        camera, _, what = name.partition("_looks_")
        if what:
            what = what.replace("_", " ")
            found.append(f"{camera}: looks {what}: compare a picture with its calibration")
        elif name.endswith("_still_share") and figure > STILL_SHARE:
            found.append(f"{name.removesuffix('_still_share')}: images stay as they are")
    if num_steps := report.quality.get("num_steps_interpolated"):
        found.append(f"{num_steps:.0f} of {report.num_steps} steps interpolated across gaps")
    return found


def _table(title: str, columns: Sequence[str], *, left: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right")
    return table


def _clocks(report: AlignmentReport) -> Table:
    figures = "samples|in episode|dropped|gaps|residual ms|latency ms|drift ppm|steps"
    columns = ["stream", *figures.split("|"), "dated by"]
    table = _table("streams", columns, left=("stream", "dated by"))
    for clock in report.clocks:
        sigma = "" if clock.latency_sigma_ms is None else f" ± {clock.latency_sigma_ms:.2f}"
        table.add_row(
            clock.stream,
            str(clock.num_samples),
            str(report.streams.get(clock.stream, 0)),
            str(clock.num_dropped),
            f"{report.quality.get(f'{clock.stream}_num_gaps', 0):.0f}",
            _number(clock.residual_rms_ms, 3),
            f"{_number(clock.latency_ms, 2)}{sigma}",
            _number(clock.skew_ppm, 1),
            str(clock.num_steps),
            clock.method or "-",
        )
    return table


def _retargeting(figures: Mapping[str, Mapping[str, float]]) -> Table:
    columns = ("hand", "tip error mm", "95 % below", "steps by status")
    table = _table("retargeting", columns, left=("hand", "steps by status"))
    for side, mine in figures.items():
        shares = {k.removeprefix("share_"): v for k, v in mine.items() if k.startswith("share_")}
        statuses = ", ".join(f"{name} {share:.2%}" for name, share in shares.items() if share)
        errors_mm = (_number(mine.get(name), 2) for name in ("tip_error_mm", "tip_error_p95_mm"))
        table.add_row(side, *errors_mm, statuses)
    return table


def _refused(parts: Sequence[RefusedPart]) -> Table | Text:
    if not parts:
        return Text("the whole recording is in the episode")
    table = _table("not in the episode", ("from s", "to s", "for s", "why"), left=("why",))
    longest = sorted(parts, key=lambda part: part.start_s - part.stop_s)[:MAX_LISTED]
    for part in sorted(longest, key=lambda part: part.start_s):
        why = WHY[part.reason] if part.stream is None else f"{part.stream}: {WHY[part.reason]}"
        times_s = part.start_s, part.stop_s, part.stop_s - part.start_s
        table.add_row(*(f"{t_s:.2f}" for t_s in times_s), why)
    if len(parts) > MAX_LISTED:
        table.caption = f"and {len(parts) - MAX_LISTED} shorter ones"
    return table


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _refused_taxels(report: AlignmentReport) -> list[str]:
    found = []
    for stream, reasons in report.refused_taxels.items():
        texts = (
            f"{reason} {' '.join(map(str, taxels[:MAX_LISTED]))}{' …' * (len(taxels) > MAX_LISTED)}"
            for reason, taxels in reasons.items()
        )
        found.append(f"{stream}: taxels not measured and zero: {', '.join(texts)}")
    return found


COMMANDS: dict[str, Callable[[argparse.Namespace, AlignmentSettings], int]] = {
    "run": _run,
    "report": _report,
    "retarget": _retarget,
    "markers": _markers,
}
