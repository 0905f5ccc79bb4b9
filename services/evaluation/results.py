"""Append-only result file: one JSON line per rollout, written when the rollout ends."""

import json
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from dextouch.errors import StorageError
from services.evaluation.scores import RolloutFailure, RolloutScore


class ResultLog:
    """Appends rollouts one by one, so that an interrupted study keeps its results.

    Rows of earlier studies are kept and distinguished by `study`, the start time of the study.

    Args:
        path: file to append to; it and its folder are created with the first row.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._study = datetime.now(UTC).isoformat(timespec="milliseconds")

    def keep(self, outcome: RolloutScore | RolloutFailure) -> None:
        """Append one row.

        Raises:
            StorageError: the file cannot be written.
        """
        row = {"study": self._study, **asdict(outcome)}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row, allow_nan=False) + "\n")
        except OSError as error:
            raise StorageError(
                f"results {self.path}: cannot be written ({error}); choose another --results"
            ) from error
