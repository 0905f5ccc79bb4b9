"""The command `dextouch rate report`."""

from collections.abc import Sequence

from dextouch.command_line import write_result
from dextouch.episodes import EpisodeStore
from dextouch.serving import load_settings
from services.evaluation.rating.marks import MarkLog, read_rubrics
from services.evaluation.rating.rating_queue import rated_rollouts, state_scores
from services.evaluation.rating.rating_report import rating_report
from services.evaluation.settings import RatingReportSettings
from services.evaluation.templates import UNDEFINED


def report_main(argv: Sequence[str]) -> int:
    """Print scores and agreement by task, and write the report on request."""
    settings = load_settings(RatingReportSettings, list(argv))
    rubrics, store = read_rubrics(settings.rubrics), EpisodeStore(settings.store_url)
    rollouts = rated_rollouts(store, tuple(rubrics), study=settings.study)
    marks = MarkLog(settings.marks).latest().values()
    tasks = {one.episode_id: one.task for one in rollouts}
    report = rating_report(marks, tasks, rubrics, state_scores(store, rollouts, rubrics))
    write_result(settings.json_path, report, allow_nan=False)
    print(f"{report['num_marks']} marks of {len(report['rollouts'])} rollouts")
    for task, found in report["tasks"].items():
        score, alpha, icc = (
            value if value == UNDEFINED else f"{value:.2f}"
            for value in (found["score"], found["alpha"], found["icc_2k"])
        )
        print(
            f"{task}: score {score} over {found['num_rollouts']} rollouts, "
            f"{found['num_raters']} raters, alpha {alpha}, ICC(2,k) {icc}"
        )
        print(f"  {found['comment']}")
        if found["less_state_score"] != UNDEFINED:
            print(f"  people's scores minus the twin's own: {found['less_state_score']:+.2f}")
        for row in found["raters"]:
            low, high = row["bias_interval"]
            print(f"  {row['rater']}: bias {row['bias']:+.2f} ({low:+.2f} … {high:+.2f})")
    return 0
