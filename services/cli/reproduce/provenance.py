"""Data that the models of a reproduction were trained on, from the metadata of their files."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from services.cli.reproduce.steps import Step
from services.networks.weight_files import notes_of

DIGITS_SHOWN: Final = 12
_HEAD: Final = "| models | training data | held out |\n|---|---|---|"


@dataclass(frozen=True)
class Trained:
    """SHA-256 of the episodes that a model was trained on, and of those held out, by their kind."""

    models: str
    trained: tuple[str, ...]
    heldout: tuple[str, ...]

    def markdown(self) -> str:
        """A row of the table of data."""
        return f"| {self.models} | {', '.join(self.trained)} | {', '.join(self.heldout)} |"


def data_of(folder: Path, steps: Sequence[Step]) -> list[Trained]:
    """Data of the models that some steps made; seeds with the same data are one row."""
    found: dict[str, Trained] = {}
    for step in steps:
        for path in _weights(folder, step):
            for text in notes_of(path).values():
                row = _trained(_without_seed(step.name), json.loads(text))
                if row is not None:
                    found.setdefault(row.markdown(), row)
    return list(found.values())


def data_markdown(rows: Sequence[Trained]) -> str:
    """Section of the page that names the data."""
    text = "\n".join(row.markdown() for row in rows)
    return f"## Data\n\nFirst digits of the SHA-256 of the episodes' content.\n\n{_HEAD}\n{text}\n"


def _weights(folder: Path, step: Step) -> Iterator[Path]:
    for made in step.makes:
        path = folder / step.name / made
        if made.endswith(".safetensors") and path.is_file():
            yield path


def _without_seed(name: str) -> str:
    return "/".join(part for part in name.split("/") if not part.startswith("seed-"))


def _trained(models: str, notes: Any) -> Trained | None:  # noqa: ANN401 - JSON of a file
    """The sets of a world model without those of its ancestors; other files have one hash."""
    if not isinstance(notes, dict) or "data_hash" not in notes:
        return None
    sets = [one for one in notes.get("sets", []) if not one.get("checkpoint")]
    if not sets:
        return Trained(models, (notes["data_hash"][:DIGITS_SHOWN],), ())
    texts: dict[bool, list[str]] = {False: [], True: []}
    for one in sets:
        number = sum(one["tasks"].values())
        short = one["data_hash"][:DIGITS_SHOWN]
        texts[one["heldout"]].append(f"{number} {one['domain']} ({short})")
    return Trained(models, tuple(texts[False]), tuple(texts[True]))
