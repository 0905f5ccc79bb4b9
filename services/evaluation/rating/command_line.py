"""The command `dextouch rate report`."""

from collections.abc import Sequence

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.errors import NotFoundError
from dextouch.serving import load_settings
from services.evaluation.rating.marks import MarkLog
from services.evaluation.rating.rating_queue import rated_rollouts, state_scores
from services.evaluation.rating.rating_report import rating_report
from services.evaluation.rating.rubrics import read_rubrics
from services.evaluation.rendering import rendered
from services.evaluation.settings import RatingReportSettings


def report_main(argv: Sequence[str]) -> int:
    """Print scores and agreement by task, and write the report on request."""
    settings = load_settings(RatingReportSettings, list(argv))
    if not settings.marks.is_file():
        raise NotFoundError(f"marks {settings.marks}: no such file; name that of `rate serve`")
    rubrics = read_rubrics(settings.rubrics)
    store = EpisodeStore(settings.store_url).require_folder()
    rollouts = rated_rollouts(store, tuple(rubrics), study=settings.study)
    marks = MarkLog(settings.marks).latest()
    tasks = {one.episode_id: one.task for one in rollouts}
    report = rating_report(marks, tasks, rubrics, state_scores(store, rollouts, rubrics))
    write_result(settings.json_path, report, allow_nan=False)
    print(rendered("ratings.txt.j2", report=report), end="")
    return 0
