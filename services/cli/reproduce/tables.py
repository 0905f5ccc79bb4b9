"""Tables of a reproduction, from the results of its steps, beside the numbers of the paper."""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from services.cli.reproduce.experiments import (
    ADAPTED,
    BASES,
    DESIGNS,
    GENERATED,
    HALF_TRAINING,
    INSTRUCTIONS,
    OPTIONS,
    OTHER_ACTIONS,
    REFERENCES,
    TOKENIZERS,
    Experiments,
    Table,
    folder_of,
    policy_of,
)
from services.cli.reproduce.pages import Measured, Page, Row
from services.cli.reproduce.steps import read_json
from services.evaluation.prediction import MODEL
from services.evaluation.scores import REAL
from services.twin.tasks.registry import DOWNSTREAM

PAPER: Final = json.loads((Path(__file__).parent / "paper.json").read_text(encoding="utf-8"))
# Rows of the prediction tables: the paper's name, ours, and whether higher is better.
METRICS: Final = (
    ("PSNR", "psnr", True),
    ("SSIM", "ssim", True),
    ("LPIPS", "lpips", False),
    ("Aesthetic Quality", "aesthetic_quality", True),
    ("Image Quality", "image_quality", True),
    ("JEPA Similarity", "jepa_similarity", True),
    ("Subject Consistency", "subject_consistency", True),
    ("Semantic Alignment", "semantic_alignment", True),
    ("Trajectory Accuracy", "trajectory_accuracy", True),
    ("Geometry Error", "geometry_error", False),
    ("PSNR_taxel", "tactile_psnr", True),
    ("SSIM_taxel", "tactile_ssim", True),
    ("LPIPS_heatmap", "tactile_lpips", False),
    ("MSE", "tactile_mse", False),
    ("MAE", "tactile_mae", False),
    ("Contact-MAE", "contact_mae", False),
    ("Contact-IoU", "contact_iou", True),
    ("Contact-F1", "contact_f1", True),
)

# Figures of the models with the actions of another take: what the actions matter.
OTHER_ACTIONS_ROWS: Final = (("PSNR", "psnr", True), ("Contact-F1", "contact_f1", True))
TOKENIZER_METRICS: Final = (
    ("mse_kpa2", "MSE (kPa²)", False),
    ("mae_kpa", "MAE (kPa)", False),
    ("contact_iou", "Contact-IoU", True),
    ("contact_f1", "Contact-F1", True),
)


def make_pages(folder: Path, experiments: Experiments, table: Table) -> list[Page]:
    """Tables of an experiment whose steps are done.

    Raises:
        NotFoundError: the result of a step is missing.
    """
    makers: dict[Table, Callable[[Path, Experiments], list[Page]]] = {
        "tokenizer": _tokenizer_pages,
        "options": _options_pages,
        "instruction": _instruction_pages,
        "design": _design_pages,
        "scaling": _scaling_pages,
        "evaluator": _evaluator_pages,
        "generation": _generation_pages,
    }
    return makers[table](folder, experiments)


def _tokenizer_pages(folder: Path, experiments: Experiments) -> list[Page]:
    results = {
        column: [
            read_json(folder / f"tokenizer/{kind}/seed-{seed}/result.json")["curve"][-1]
            for seed in experiments.seeds
        ]
        for column, kind in TOKENIZERS.items()
    }
    rows = [
        Row(
            name,
            {c: Measured(tuple(float(one[key]) for one in r)) for c, r in results.items()},
            {},
            higher,
        )
        for key, name, higher in TOKENIZER_METRICS
    ]
    return [Page("Tactile tokenizers (held-out touch)", tuple(rows), "Grid")]


def _design_pages(folder: Path, experiments: Experiments) -> list[Page]:
    columns = {name: (f"design/{name}", name) for name in DESIGNS}
    rows = _prediction_rows(folder, experiments, columns)
    return [Page("Model design (no human data)", rows, "Robot-only")]


def _options_pages(folder: Path, experiments: Experiments) -> list[Page]:
    """One table of the options that are measured; it is useful before all of them are."""
    columns = {name: (f"options/{folder_of(name)}", "") for name in OPTIONS}
    missing = [
        name
        for name, (step, _) in columns.items()
        if name != BASES["options"]
        and not all(
            (folder / f"{step}/seed-{seed}/prediction/result.json").is_file()
            for seed in experiments.seeds
        )
    ]
    for name in missing:
        del columns[name]
    rows = _prediction_rows(folder, experiments, columns)
    title = "Options of the joint model, one changed at a time"
    if missing:
        title += f" (not measured yet: {', '.join(missing)})"
    return [Page(title, rows, BASES["options"])]


def _instruction_pages(folder: Path, experiments: Experiments) -> list[Page]:
    """Predictions with the right sentence, with none and with another task's."""
    sources = {"right": MODEL, "none": "no_instruction", "another's": "other_instruction"}
    pages = []
    for encoder in INSTRUCTIONS:
        step = f"instruction/{folder_of(encoder)}"
        found = [
            read_json(folder / f"{step}/seed-{seed}/prediction/result.json")
            for seed in experiments.seeds
        ]
        rows = tuple(
            Row(
                name,
                {
                    column: Measured(tuple(_figure(one, key, source) for one in found))
                    for column, source in sources.items()
                },
                {},
                higher,
            )
            for name, key, higher in METRICS
        )
        pages.append(Page(f"Sentences of the can tasks, encoder {encoder}", rows, "right"))
    return pages


def _scaling_pages(folder: Path, experiments: Experiments) -> list[Page]:
    paper = ("+10h Human", "+50h Human", "+100h Human")
    multiples = experiments.sizes.multiples
    columns = {"0": ("design/Robot-only", "Robot-only")}
    columns[HALF_TRAINING] = (f"scaling/{folder_of(HALF_TRAINING)}", "")
    for index, multiple in enumerate(multiples):
        name = paper[index] if len(multiples) == len(paper) else ""
        columns[f"{multiple}x"] = (f"scaling/{multiple}x", name)
    rows = _prediction_rows(folder, experiments, columns)
    return [Page("Human data at a fixed amount of robot data", rows, "0")]


def _prediction_rows(
    folder: Path, experiments: Experiments, columns: Mapping[str, tuple[str, str]]
) -> tuple[Row, ...]:
    """Rows of a prediction table; columns are (folder of the step, the paper's column)."""
    found = {
        column: [
            read_json(folder / f"{step}/seed-{seed}/prediction/result.json")
            for seed in experiments.seeds
        ]
        for column, (step, _) in columns.items()
    }

    def cells(key: str, source: str) -> dict[str, Measured]:
        return {
            column: Measured(tuple(_figure(result, key, source) for result in results))
            for column, results in found.items()
        }

    measured = [results[0] for results in found.values()]
    measured = [one for one in measured if REFERENCES[0] in one["windows"]["all"]]
    rows = []
    for name, key, higher in METRICS:
        paper = {column: PAPER["prediction"][name].get(c) for column, (_, c) in columns.items()}
        beside = {one: _figure(measured[0], key, one) for one in REFERENCES if measured}
        rows.append(Row(name, cells(key, MODEL), paper, higher, beside))
    for name, key, higher in OTHER_ACTIONS_ROWS:
        rows.append(Row(f"{name}, other actions", cells(key, OTHER_ACTIONS), {}, not higher))
    return tuple(rows)


def _figure(result: Mapping[str, Any], key: str, source: str = MODEL) -> float:
    """A metric of the windows of all tasks; NaN where it is not available."""
    value = result["windows"]["all"].get(source, {}).get(key)
    return float(value) if isinstance(value, int | float) else math.nan


def _evaluator_pages(folder: Path, experiments: Experiments) -> list[Page]:
    report = read_json(folder / "evaluator/study/result.json")
    adapted = {world: (f"evaluator/{world}", "") for world in ADAPTED}
    prediction = _prediction_rows(folder, experiments, adapted)
    title = "Policy evaluation"
    return [
        Page("Adapted world models on held-out robot episodes", prediction, ADAPTED[0]),
        *_study_pages(report, experiments, PAPER["agreement"], title),
        _paper_page(title, PAPER["policies"]),
    ]


def _generation_pages(folder: Path, experiments: Experiments) -> list[Page]:
    report = read_json(folder / "generation/study/result.json")
    rate = {(row["task"], row["policy"]): float(row[REAL]) for row in report["policies"]}
    title = "Policies from generated demonstrations"
    rows = [
        Row(
            task,
            {
                column: Measured(
                    tuple(rate[task, policy_of(column, seed)] for seed in experiments.seeds)
                )
                for column in GENERATED
            },
            {},
        )
        for task in DOWNSTREAM
    ]
    return [
        Page(f"{title}: success rates in the twin", tuple(rows), "Half"),
        _paper_page(title, PAPER["generated"]),
    ]


def _paper_page(title: str, table: Mapping[str, Any]) -> Page:
    """Success rates of the paper's own policies."""
    tasks = next(iter(next(iter(table.values())).values()))
    rows = [
        Row(
            f"{task}, {policy}",
            {world: Measured((rates[task],)) for world, rates in worlds.items()},
            {},
        )
        for task in tasks
        for policy, worlds in table.items()
    ]
    return Page(f"{title}: the paper's success rates", tuple(rows))


def _study_pages(
    report: Mapping[str, Any],
    experiments: Experiments,
    paper: Mapping[str, Any],
    title: str,
) -> list[Page]:
    """Success of each policy by world, and agreement of the world models with the twin."""
    policies = list(dict.fromkeys(row["policy"] for row in report["policies"]))
    success = []
    for task in DOWNSTREAM:
        for policy in policies:
            (row,) = [r for r in report["policies"] if (r["policy"], r["task"]) == (policy, task)]
            by_world = {report["imagined_world"]: row["imagined"]} | {
                world: cell["success"] for world, cell in row["other_worlds"].items()
            }
            cells = {"twin": Measured((float(row[REAL]),))}
            cells |= {
                world: _defined(by_world[f"{world} {seed}"] for seed in experiments.seeds)
                for world in ADAPTED
            }
            success.append(Row(f"{task}, {policy}", cells, {}))
    agreement = {report["imagined_world"]: report["agreement"]}
    agreement |= report["agreement_of_other_worlds"]
    figures = []
    for key, name, higher in (("pearson", "Pearson", True), ("mmrv", "MMRV", False)):
        for task in DOWNSTREAM:
            cells = {
                world: _defined(
                    agreement[f"{world} {seed}"][task][key] for seed in experiments.seeds
                )
                for world in ADAPTED
            }
            label = task.replace("_", " ").title()
            numbers = {world: paper[world][name][label] for world in ADAPTED}
            figures.append(Row(f"{name}, {task}", cells, numbers, higher))
    return [
        Page(f"{title}: success rates", tuple(success)),
        Page(f"{title}: agreement with the twin", tuple(figures), ADAPTED[0]),
    ]


def _defined(by_seed: Iterable[float | str]) -> Measured:
    """A figure of a report by training seed; it is the reason where it is undefined."""
    found = list(by_seed)
    values = tuple(math.nan if isinstance(one, str) else float(one) for one in found)
    reasons = [one for one in found if isinstance(one, str)]
    return Measured(values, reasons[0]) if reasons else Measured(values)
