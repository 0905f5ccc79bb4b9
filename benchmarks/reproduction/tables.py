"""Tables of a reproduction, from the results of its steps, beside the numbers of the paper."""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.stats import t as students_t

from benchmarks.report import ResultTable
from benchmarks.reproduction.experiments import (
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
from benchmarks.reproduction.steps import Step
from dextouch.errors import NotFoundError
from dextouch.metrics.policy import mmrv, pearson
from services.evaluation.prediction import MODEL
from services.evaluation.scores import REAL, RolloutScore
from services.evaluation.statistics import area_under_roc
from services.evaluation.studies.results import StudyResults
from services.networks.weight_files import notes_of
from services.twin.names import DOWNSTREAM

PAPER: Final = json.loads((Path(__file__).parent / "paper.json").read_text(encoding="utf-8"))
NOT_AVAILABLE: Final = "n/a"
# References shown beside the models, with their headings; the JSON has all.
REFERENCES_SHOWN: Final = {"copy": "copy", "warp": "warped start", "codec": "codec alone"}
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
    ("Contact-F1 of pads", "pad_contact_f1", True),
    ("Object error", "object_error", False),
)
# Figures of the models with the actions of another take: what the actions matter.
_OTHER_ACTIONS_ROWS: Final = (
    ("PSNR", "psnr", True),
    ("Contact-F1", "contact_f1", True),
    ("Contact-F1 of pads", "pad_contact_f1", True),
    ("Object error", "object_error", False),
)
_TOKENIZER_METRICS: Final = (
    ("MSE (kPa²)", "mse_kpa2", False),
    ("MAE (kPa)", "mae_kpa", False),
    ("Contact-IoU", "contact_iou", True),
    ("Contact-F1", "contact_f1", True),
)
_DIGITS_OF_HASH: Final = 12


@dataclass(frozen=True)
class Measured:
    """A figure measured once for each training seed; NaN where it is not available.

    `missing` is what is shown then: the reason, if it is known.
    """

    values: tuple[float, ...]
    missing: str = NOT_AVAILABLE

    @property
    def mean(self) -> float:
        """Mean over seeds."""
        return float(np.mean(self.values))

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval of the mean over seeds (Student's t); NaN for one seed."""
        num = len(self.values)
        if num < 2:
            return math.nan
        spread = float(np.std(self.values, ddof=1)) / math.sqrt(num)
        return float(students_t.ppf(0.975, num - 1)) * spread

    def less(self, other: "Measured") -> "Measured":
        """Differences, seed by seed."""
        return Measured(tuple(a - b for a, b in zip(self.values, other.values, strict=True)))

    def text(self, *, signed: bool = False) -> str:
        """Mean and interval, with as many digits as the interval has meaning."""
        if not math.isfinite(self.mean):
            return self.missing
        sign = "+" if signed else ""
        if not math.isfinite(self.half_width):
            return f"{self.mean:{sign}.4g}"
        # Seeds that agree leave the rounding of their mean.
        is_zero = self.half_width <= 1e-9 * max(map(abs, self.values))
        digits = 4 if is_zero else max(0, 1 - math.floor(math.log10(self.half_width)))
        return f"{self.mean:{sign}.{digits}f} ± {self.half_width:.{digits}f}"


@dataclass(frozen=True)
class Row:
    """A row of a table: a figure in every column, with the paper's number if it has one.

    `references` are predictions without a model; NaN where a figure is not available.
    """

    metric: str
    cells: Mapping[str, Measured]
    paper: Mapping[str, float | None] = field(default_factory=dict)
    higher_is_better: bool | None = None
    references: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The metric, with an arrow in its better direction."""
        return self.metric + {True: " ↑", False: " ↓", None: ""}[self.higher_is_better]

    @property
    def is_available(self) -> bool:
        """Whether any column has a figure, or a reason why it has none."""
        return any(
            math.isfinite(cell.mean) or cell.missing != NOT_AVAILABLE
            for cell in self.cells.values()
        )

    def text(self, column: str) -> str:
        """The figure of a column, and the paper's number."""
        paper = self.paper.get(column)
        return self.cells[column].text() + ("" if paper is None else f" (paper {paper:g})")


@dataclass(frozen=True)
class Page:
    """One table; differences of its columns from `base` are a second one."""

    title: str
    rows: tuple[Row, ...]
    base: str | None = None

    def tables(self) -> list[ResultTable]:
        """The table without the rows that have no figure, and the differences."""
        columns = list(self.rows[0].cells)
        available = [row for row in self.rows if row.is_available]
        beside = [one for one in REFERENCES_SHOWN if one in self.rows[0].references]
        head = ("", *columns, *(REFERENCES_SHOWN[one] for one in beside))
        rows = [
            (
                row.name,
                *map(row.text, columns),
                *(Measured((row.references.get(one, math.nan),)).text() for one in beside),
            )
            for row in available
        ]
        found = [ResultTable(self.title, head, rows)]
        if self.base is not None:
            others = [one for one in columns if one != self.base]
            differences = []
            for row in available:
                cells = (row.cells[one].less(row.cells[self.base]) for one in others)
                differences.append((row.name, *(cell.text(signed=True) for cell in cells)))
            title = f"{self.title}: difference from {self.base}, seed by seed"
            found.append(ResultTable(title, ("", *others), differences))
        return found

    def notes(self) -> list[str]:
        """What is missing."""
        absent = [row.metric for row in self.rows if not row.is_available]
        return [f"{self.title}: not available: {', '.join(absent)}"] if absent else []

    def to_json(self) -> dict[str, Any]:
        """The values of every seed, and the paper's numbers."""
        return {
            "title": self.title,
            "rows": [
                {
                    "name": row.metric,
                    "higher_is_better": row.higher_is_better,
                    "values": {one: [*map(_finite, c.values)] for one, c in row.cells.items()},
                    "paper": dict(row.paper),
                    "references": {one: _finite(value) for one, value in row.references.items()},
                }
                for row in self.rows
            ],
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def make_pages(folder: Path, experiments: Experiments, table: Table) -> list[Page]:
    """Tables of an experiment whose steps are done.

    Raises NotFoundError if the result of a step is missing.
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


def _result(folder: Path, step: str) -> Any:  # noqa: ANN401 - JSON of a command
    path = folder / step / "result.json"
    if not path.is_file():
        raise NotFoundError(f"reproduction: no {path}; run the steps of its table first")
    return json.loads(path.read_bytes())


def _predictions(folder: Path, experiments: Experiments, column: str) -> list[Any]:
    """Result of every seed; `column` is the folder of a table's column."""
    return [_result(folder, f"{column}/seed-{seed}/prediction") for seed in experiments.seeds]


def _figures(results: Iterable[Any], key: str, source: str = MODEL) -> Measured:
    """A metric of all tasks; NaN where it is not available."""
    found = [_of_all_tasks(one).get(source, {}).get(key) for one in results]
    return Measured(tuple(math.nan if one is None else float(one) for one in found))


def _of_all_tasks(result: Mapping[str, Any]) -> Any:  # noqa: ANN401 - JSON of a command
    """Figures of a prediction by source, of whole rollouts or of windows of one chunk."""
    return result["rollouts" if "rollouts" in result else "windows"]["all"]


def _tokenizer_pages(folder: Path, experiments: Experiments) -> list[Page]:
    results = {
        column: [
            _result(folder, f"tokenizer/{kind}/seed-{seed}")["curve"][-1]
            for seed in experiments.seeds
        ]
        for column, kind in TOKENIZERS.items()
    }
    rows = [
        Row(
            name,
            {one: Measured(tuple(float(c[key]) for c in found)) for one, found in results.items()},
            higher_is_better=higher,
        )
        for name, key, higher in _TOKENIZER_METRICS
    ]
    return [Page("Tactile tokenizers (held-out touch)", tuple(rows), "Grid")]


def _design_pages(folder: Path, experiments: Experiments) -> list[Page]:
    columns = {name: (f"design/{name}", name) for name in DESIGNS}
    rows = _prediction_rows(folder, experiments, columns)
    return [Page("Model design (no human data)", rows, BASES["design"])]


def _options_pages(folder: Path, experiments: Experiments) -> list[Page]:
    """One table of the options that are measured; it is useful before all of them are."""
    columns, missing = {}, []
    for name in OPTIONS:
        column = f"options/{folder_of(name)}"
        try:
            _predictions(folder, experiments, column)
        except NotFoundError:
            if name == BASES["options"]:
                raise
            missing.append(name)
        else:
            columns[name] = (column, "")
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
        found = _predictions(folder, experiments, f"instruction/{folder_of(encoder)}")
        rows = tuple(
            Row(
                name,
                {column: _figures(found, key, source) for column, source in sources.items()},
                higher_is_better=higher,
            )
            for name, key, higher in METRICS
        )
        pages.append(Page(f"Sentences of the can tasks, encoder {encoder}", rows, "right"))
    return pages


def _scaling_pages(folder: Path, experiments: Experiments) -> list[Page]:
    paper = ("+10h Human", "+50h Human", "+100h Human")
    multiples = experiments.sizes.multiples
    columns = {"0": ("scaling/0", "Robot-only")}
    columns[HALF_TRAINING] = (f"scaling/{folder_of(HALF_TRAINING)}", "")
    for index, multiple in enumerate(multiples):
        name = paper[index] if len(multiples) == len(paper) else ""
        columns[f"{multiple}x"] = (f"scaling/{multiple}x", name)
    rows = _prediction_rows(folder, experiments, columns)
    return [Page("Human data at a fixed amount of robot data", rows, BASES["scaling"])]


def _prediction_rows(
    folder: Path, experiments: Experiments, columns: Mapping[str, tuple[str, str]]
) -> tuple[Row, ...]:
    """Rows of a prediction table; columns are (folder of the column, the paper's column)."""
    found = {one: _predictions(folder, experiments, step) for one, (step, _) in columns.items()}

    def cells(key: str, source: str = MODEL) -> dict[str, Measured]:
        return {column: _figures(results, key, source) for column, results in found.items()}

    first = [results[0] for results in found.values()]
    measured = [one for one in first if REFERENCES[0] in _of_all_tasks(one)][:1]
    rows = []
    for name, key, higher in METRICS:
        of_paper = PAPER["prediction"].get(name, {})
        paper = {column: of_paper.get(c) for column, (_, c) in columns.items()}
        beside = {one: _figures(measured, key, one).mean for one in REFERENCES if measured}
        rows.append(Row(name, cells(key), paper, higher, beside))
    for name, key, higher in _OTHER_ACTIONS_ROWS:
        values = cells(key, OTHER_ACTIONS)
        rows.append(Row(f"{name}, other actions", values, higher_is_better=not higher))
    return tuple(rows)


def _evaluator_pages(folder: Path, experiments: Experiments) -> list[Page]:
    report = _result(folder, "evaluator/study")
    adapted = {world: (f"evaluator/{world}", "") for world in ADAPTED}
    prediction = _prediction_rows(folder, experiments, adapted)
    title = "Policy evaluation"
    success = tuple(_success_rows(report, experiments))
    pages = []
    for of, estimate, truth in (
        ("judges' probabilities of success", "probability", "success"),
        # In which no judge takes part.
        ("worlds' own estimates of success", "world_probability", "success"),
        # Shares of the task's points: by what the twin reports, or as a judge expects them.
        ("rubric scores", "rubric_score", "rubric_score"),
    ):
        *estimates, pooled = _estimate_rows(folder, estimate, truth)
        pages += [
            Page(f"{title}: the {of}", tuple(estimates)),
            Page(f"{title}: the two worlds by the {of}", (pooled,)),
        ]
    return [
        Page("Adapted world models on held-out robot episodes", prediction, BASES["evaluator"]),
        Page(f"{title}: success rates", success),
        Page(f"{title}: agreement of the two worlds", (_pooled_row(success),)),
        Page(
            f"{title}: agreement with the twin",
            tuple(_agreement_rows(report, experiments)),
            BASES["evaluator"],
        ),
        *pages,
        _paper_page(title, PAPER["policies"]),
    ]


def _estimate_rows(folder: Path, estimate: str, truth: str) -> Iterator[Row]:
    """How well estimates in imagined worlds say what the twin gives, by task and seed.

    AUC is of single rollouts, where the truth is yes or no; correlation and MMRV are of the means
    of policies, over all rollouts, decided or not. The last row compares the two worlds.
    """
    outcomes = StudyResults.read(folder / "evaluator/study/results").outcomes.values()
    scores = [one for one in outcomes if isinstance(one, RolloutScore)]
    true = {(o.task, o.policy, o.seed): getattr(o, truth) for o in scores if o.world == REAL}
    known = {key: value for key, value in true.items() if value is not None}
    found: dict[tuple[str, str], list[EstimateFigures]] = {}
    means: dict[str, list[np.ndarray]] = {world: [] for world in ADAPTED}
    for world in ADAPTED:
        names = sorted({one.world for one in scores if one.world.startswith(f"{world} ")})
        for name in names:
            own = [one for one in scores if one.world == name]
            figures = {task: estimate_figures(own, known, task, estimate) for task in DOWNSTREAM}
            for task, figure in figures.items():
                found.setdefault((world, task), []).append(figure)
            means[world].append(np.concatenate([one.policy_means for one in figures.values()]))
    rows = (("AUC", "auc", True), ("Pearson", "pearson", True), ("MMRV", "mmrv", False))
    for title, key, higher in rows:
        for task in DOWNSTREAM:
            cells = {
                world: Measured(tuple(getattr(one, key) for one in found.get((world, task), [])))
                for world in ADAPTED
            }
            yield Row(f"{title}, {task}", cells, higher_is_better=higher)
    pooled = [pearson(real=a, imagined=b) for a, b in zip(*means.values(), strict=True)]
    yield Row("Pearson of the two worlds", {" and ".join(ADAPTED): Measured(tuple(pooled))})


class EstimateFigures(NamedTuple):
    """Agreement of estimates in a world with the truth, and their means by policy."""

    auc: float
    pearson: float
    mmrv: float
    policy_means: np.ndarray


def estimate_figures(
    scores: Sequence[RolloutScore],
    true: Mapping[tuple[str, str, int], bool | float],
    task: str,
    estimate: str = "world_probability",
) -> EstimateFigures:
    """Figures of one task in an imagined world; NaN where undefined or without estimates.

    `true` is success (0 or 1) or score in the real world by task, policy and seed; rollouts without
    one are left out.
    """
    used = [
        (one.policy, value, float(true[one.task, one.policy, one.seed]))
        for one in scores
        if one.task == task
        and (value := getattr(one, estimate)) is not None
        and (one.task, one.policy, one.seed) in true
    ]
    outcomes = np.array([value for _, _, value in used])
    policies = sorted({policy for policy, _, _ in used})
    own = np.array([np.mean([p for name, p, _ in used if name == policy]) for policy in policies])
    real = np.array([np.mean([s for name, _, s in used if name == policy]) for policy in policies])
    auc = math.nan
    if {*outcomes.tolist()} == {0.0, 1.0}:
        auc = area_under_roc(np.array([value for _, value, _ in used]), outcomes > 0)
    if not policies:
        return EstimateFigures(auc, math.nan, math.nan, own)
    agreement = pearson(real=real, imagined=own), mmrv(real=real, imagined=own)
    return EstimateFigures(auc, *agreement, own)


def _pooled_row(success: Sequence[Row]) -> Row:
    """Correlation of the two worlds' success rates over all tasks and policies, by seed."""
    rates = [np.array([row.cells[world].values for row in success]).T for world in ADAPTED]
    pooled = tuple(float(np.corrcoef(*pair)[0, 1]) for pair in zip(*rates, strict=True))
    return Row("Pearson over all tasks and policies", {" and ".join(ADAPTED): Measured(pooled)})


def _success_rows(report: Mapping[str, Any], experiments: Experiments) -> Iterator[Row]:
    """Success of each policy by world."""
    policies = dict.fromkeys(row["policy"] for row in report["policies"])
    of_pair = {(row["task"], row["policy"]): row for row in report["policies"]}
    for task in DOWNSTREAM:
        for policy in policies:
            row = of_pair[task, policy]
            by_world = {report["imagined_world"]: row["imagined"]} | {
                world: cell["success"] for world, cell in row["other_worlds"].items()
            }
            cells = {"twin": Measured((float(row[REAL]),))}
            for world in ADAPTED:
                cells[world] = _defined(by_world[f"{world} {seed}"] for seed in experiments.seeds)
            yield Row(f"{task}, {policy}", cells)


def _agreement_rows(report: Mapping[str, Any], experiments: Experiments) -> Iterator[Row]:
    """Agreement of the world models with the twin."""
    agreement = {report["imagined_world"]: report["agreement"]}
    agreement |= report["agreement_of_other_worlds"]
    for key, name, higher in (("pearson", "Pearson", True), ("mmrv", "MMRV", False)):
        for task in DOWNSTREAM:
            cells = {
                world: _defined(agreement[f"{world} {n}"][task][key] for n in experiments.seeds)
                for world in ADAPTED
            }
            label = task.replace("_", " ").title()
            numbers = {world: PAPER["agreement"][world][name][label] for world in ADAPTED}
            yield Row(f"{name}, {task}", cells, numbers, higher)


def _defined(by_seed: Iterable[float | str]) -> Measured:
    """A figure of a report by training seed; it is the reason where it is undefined."""
    found = list(by_seed)
    values = tuple(math.nan if isinstance(one, str) else float(one) for one in found)
    reasons = [one for one in found if isinstance(one, str)]
    return Measured(values, *reasons[:1])


def _generation_pages(folder: Path, experiments: Experiments) -> list[Page]:
    report = _result(folder, "generation/study")
    rate = {(row["task"], row["policy"]): float(row[REAL]) for row in report["policies"]}
    title = "Policies from generated demonstrations"
    rows = []
    for task in DOWNSTREAM:
        rates = {
            column: Measured(tuple(rate[task, policy_of(column, n)] for n in experiments.seeds))
            for column in GENERATED
        }
        rows.append(Row(task, rates))
    return [
        Page(f"{title}: success rates in the twin", tuple(rows), "Half"),
        _paper_page(title, PAPER["generated"]),
    ]


def _paper_page(title: str, table: Mapping[str, Any]) -> Page:
    """Success rates of the paper's own policies."""
    rows = [
        Row(
            f"{task}, {policy}",
            {world: Measured((rates[task],)) for world, rates in worlds.items()},
        )
        for task in next(iter(next(iter(table.values())).values()))
        for policy, worlds in table.items()
    ]
    return Page(f"{title}: the paper's success rates", tuple(rows))


def data_table(folder: Path, steps: Sequence[Step]) -> ResultTable:
    """Episodes that the models of some steps were trained on; seeds with the same are one row."""
    rows: dict[tuple[str, ...], None] = {}
    for step in steps:
        models = re.sub(r"/seed-\d+", "", step.name)
        for made in step.makes:
            for text in notes_of(folder / step.name / made).values():
                if sets := _trained_on(json.loads(text)):
                    rows[models, *sets] = None
    title = "Data, with the first digits of the SHA-256 of the episodes' content"
    return ResultTable(title, ("models", "training data", "held out"), [*rows], num_text_columns=3)


def _trained_on(notes: Any) -> tuple[str, str] | None:  # noqa: ANN401 - JSON of a file
    """The sets of a world model without those of its ancestors; other files have one hash."""
    if not isinstance(notes, dict) or "data_hash" not in notes:
        return None
    sets = [one for one in notes.get("sets", []) if not one.get("checkpoint")]
    if not sets:
        return notes["data_hash"][:_DIGITS_OF_HASH], ""
    texts: dict[bool, list[str]] = {False: [], True: []}
    for one in sets:
        short = one["data_hash"][:_DIGITS_OF_HASH]
        texts[one["heldout"]].append(f"{sum(one['tasks'].values())} {one['domain']} ({short})")
    return ", ".join(texts[False]), ", ".join(texts[True])
