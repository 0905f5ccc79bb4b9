"""Reports of a study: JSON, a page for each imagined world, and LaTeX tables."""

from pathlib import Path
from typing import Any, Final

from dextouch.command_line import write_result
from services.evaluation.reporting import ReportPictures, write_report
from services.evaluation.reporting.latex import latex_tables
from services.evaluation.scores import ClosedLoopReport
from services.evaluation.studies.definition import StudyDefinition
from services.evaluation.studies.results import StudyResults, study_report

REPORT_FILE: Final = "report.json"
TABLES_FILE: Final = "tables.tex"


def write_reports(results: StudyResults, json_path: Path | None) -> dict[str, Any]:
    """Write all reports beside the results.

    Args:
        results: of a study, finished or not.
        json_path: also write the figures here; see `write_result`.

    Returns:
        The figures of report.json.
    """
    folder = results.path.parent
    definition = StudyDefinition.model_validate(results.header.definition)
    report = study_report(definition, results)
    figures = report.to_report()
    figures["study"] = {"name": definition.name, "digests": results.header.digests}
    for path in (folder / REPORT_FILE, json_path):
        write_result(path, figures, allow_nan=False)
    for world in definition.imagined:
        others = tuple(name for name in definition.imagined if name != world)
        page = ClosedLoopReport(
            report.scores, (world, *others), report.policies, report.failures
        ).to_report()
        title = f"{definition.name}: {world} and the real world"
        write_report(page | {"title": title}, ReportPictures(), folder / f"report {world}.html")
    (folder / TABLES_FILE).write_text(latex_tables(report), encoding="utf-8")
    return figures
