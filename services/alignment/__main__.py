"""`python -m services.alignment`: recordings to episodes from the shell, or as a service."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError
from dextouch.schemas.episodes import json_ready
from dextouch.serving.logs import configure_logging
from dextouch.serving.settings import load_settings, run
from services.alignment.jobs import align_recording
from services.alignment.report import AlignmentReport
from services.alignment.settings import AlignmentSettings

EXIT_REFUSED = 3
# Taxels of one reason that a line tells; the report has all.
MAX_TOLD = 12
USAGE = """usage: python -m services.alignment [serve] [--SETTING VALUE …]
       python -m services.alignment run RECORDING_ID … [--store FOLDER] [--json PATH]

serve (the default) answers POST /v1/alignments; its settings are listed by serve --help.
run aligns recordings of a store and tells what became of them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Serve, or align some recordings and stop.

    Returns:
        0, or 3 for a refusal with its reason on stderr.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] in (["-h"], ["--help"]):
        print(USAGE)
        return 0
    try:
        if arguments[:1] == ["run"]:
            return _run(arguments[1:])
        return _serve(arguments[1:] if arguments[:1] == ["serve"] else arguments)
    except DexTouchError as error:
        print(f"dextouch align: {error.message}", file=sys.stderr)
        return EXIT_REFUSED


def _serve(arguments: list[str]) -> int:
    from services.alignment.app import create_app

    settings = load_settings(AlignmentSettings, arguments)
    configure_logging(service="alignment", log_format=settings.log_format, level=settings.log_level)
    run(create_app(settings), settings)
    return 0


def _run(arguments: list[str]) -> int:
    settings = load_settings(AlignmentSettings, [])
    parser = argparse.ArgumentParser(prog="python -m services.alignment run")
    parser.add_argument("recordings", nargs="+", metavar="RECORDING_ID")
    parser.add_argument("--store", default=settings.store_url, help="folder of the store")
    parser.add_argument("--json", type=Path, help="write the reports here")
    parsed = parser.parse_args(arguments)
    store = EpisodeStore(parsed.store)
    reports = []
    for recording_id in parsed.recordings:
        reports.append(align_recording(store, recording_id, settings.options))
        print(_line(reports[-1]))
    if parsed.json is not None:
        content = json.dumps([json_ready(report) for report in reports], indent=2)
        parsed.json.write_text(content + "\n", encoding="utf-8")
    return 0


def _line(report: AlignmentReport) -> str:
    verb = "aligned" if report.created else "was aligned already"
    lost = sum(clock.num_dropped for clock in report.clocks)
    absent = f"; absent: {', '.join(report.absent)}" if report.absent else ""
    refused = "".join(
        f"; {stream}: taxels not measured and zero: {_by_reason(reasons)}"
        for stream, reasons in report.refused_taxels.items()
    )
    return (
        f"{report.recording_id} {verb}: {report.episode_id}, {report.num_steps} steps, "
        f"{len(report.streams)} streams, {lost} samples lost{absent}{refused}"
    )


def _by_reason(reasons: Mapping[str, Sequence[int]]) -> str:
    return ", ".join(
        f"{reason} {' '.join(map(str, taxels[:MAX_TOLD]))}{' …' * (len(taxels) > MAX_TOLD)}"
        for reason, taxels in reasons.items()
    )


if __name__ == "__main__":
    sys.exit(main())
