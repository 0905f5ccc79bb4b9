"""Count of the takes that were saved in an operator's session, kept in the spool."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import structlog
from jaxtyping import Float64, Int64
from pydantic import ValidationError

from dextouch.episodes import disk_errors, replace_file
from dextouch.errors import InvalidInputError, NotFoundError, StorageError
from dextouch.schemas import Matrix, RecorderSession, SavedTakes, TakePrompt
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, raw_indices

logger = structlog.get_logger(__name__)

SESSION_FILE: Final = "session.json"


class SessionCount:
    """The present session; counts survive a restart and the deletion of uploaded takes.

    A session that cannot be written is counted in memory: a take that is saved must stay saved.

    Args:
        spool_root: folder of the takes.
    """

    def __init__(self, spool_root: Path) -> None:
        self._path = spool_root / SESSION_FILE
        self.now = self._read() or RecorderSession(started_at=datetime.now(UTC))

    def begin(self) -> None:
        """Begin a new session, in which nothing was saved yet."""
        fresh = {"started_at": datetime.now(UTC), "saved": ()}
        self._write(self.now.model_copy(update=fresh))

    def add(self, prompt: TakePrompt, recording_id: str, *, incomplete: str = "") -> None:
        """Count a saved take; `incomplete` says why it is, if it is."""
        key = (prompt.task, prompt.operator)
        counts = {(item.task, item.operator): item.num_saved for item in self.now.saved}
        counts[key] = counts.get(key, 0) + 1
        saved = tuple(
            SavedTakes(task=task, operator=operator, num_saved=count)
            for (task, operator), count in counts.items()
        )
        last = {"last_saved": recording_id, "last_incomplete": incomplete}
        self._write(self.now.model_copy(update={"saved": saved, **last}))

    def operators(self) -> tuple[str, ...]:
        """All operators that the counts name."""
        names = {item.operator for item in self.now.saved}
        return tuple(sorted(name for name in names if name is not None))

    def forget(self, operator: str) -> None:
        """Remove an operator's counts."""
        saved = tuple(item for item in self.now.saved if item.operator != operator)
        self._write(self.now.model_copy(update={"saved": saved}))

    def _write(self, session: RecorderSession) -> None:
        self.now = session
        try:
            with disk_errors(f"write {self._path.name}"):
                # In a spool that is gone this fails: only a take may create it.
                replace_file(self._path, session.model_dump_json().encode())
        except StorageError as error:
            logger.warning("fail_session_count", error=error.message)

    def _read(self) -> RecorderSession | None:
        try:
            return RecorderSession.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            logger.warning("fail_session_count", error=str(error))
            return None


# Calibration record of a glove: tare and gain of its cells, and the cell of each of its taxels.

# In the calibration's map, of a taxel that no cell measures.
NO_CELL = -1


@dataclass(frozen=True)
class GloveRecord:
    """counts = tare + gain · pressure of each cell, and the cell of each of the 320 taxels.

    The sigma of a tare that does not state it is 0.
    """

    tare_counts: Float64[np.ndarray, " cells"]
    gain_counts_per_kpa: Float64[np.ndarray, " cells"]
    tare_sigma_counts: Float64[np.ndarray, " cells"]
    cells: Int64[np.ndarray, "320"]


def is_ours(descriptor: StreamDescriptor) -> bool:
    """Whether a stream is that of our own glove, whose cells need no map."""
    return descriptor.unit == "counts" and descriptor.shape == (NUM_RAW_TAXELS,)


def mapped_cells(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> Int64[np.ndarray, "320"] | None:
    """For each taxel the number of its cell, -1 for none; None where no map (1 x 320) is known.

    Raises:
        NotFoundError: the map is of another size.
        InvalidInputError: it names a cell that the glove has not.
    """
    num_cells, name = math.prod(descriptor.shape), f"{descriptor.name}_cells"
    if name not in calibration:
        return None
    cells = _row(calibration, name, NUM_TAXELS)
    wrong = (cells != np.rint(cells)) | (cells < NO_CELL) | (cells >= num_cells)
    if wrong.any():
        taxel = int(np.argmax(wrong))
        raise InvalidInputError(
            f"calibration {name!r}: got {cells[taxel]:g} for taxel {taxel}, expected a whole "
            f"number -1 … {num_cells - 1}, the cell of the {descriptor.side} glove that measures it"
        )
    return cells.astype(np.int64)


def glove_record(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> GloveRecord | None:
    """What makes pressures of a glove's readings; None where the calibration does not say it.

    Raises:
        NotFoundError: a row of another size, or a glove without a side.
        InvalidInputError: a map that names a cell that the glove has not.
    """
    names = [f"{descriptor.name}_{what}" for what in ("tare_counts", "gain_counts_per_kpa")]
    if descriptor.kind != "tactile" or not set(names) <= calibration.keys():
        return None
    num_cells = math.prod(descriptor.shape)
    cells = mapped_cells(descriptor, calibration)
    if cells is None:
        if not is_ours(descriptor):
            return None
        if descriptor.side is None:
            raise NotFoundError(f"stream {descriptor.name!r}: a glove without a side")
        cells = raw_indices(side=descriptor.side)
    tare, gain = (_row(calibration, name, num_cells) for name in names)
    name = f"{descriptor.name}_tare_sigma_counts"
    stated = np.size(calibration.get(name, ())) > 0
    sigma = _row(calibration, name, num_cells) if stated else np.zeros(num_cells)
    return GloveRecord(tare, gain, sigma, cells)


def _row(calibration: Mapping[str, Matrix], name: str, size: int) -> Float64[np.ndarray, " size"]:
    row = np.array(calibration[name], dtype=np.float64).ravel()
    if row.shape != (size,):
        raise NotFoundError(
            f"calibration {name!r}: got {row.size} numbers, expected {size}; "
            "calibrate the glove and give the station its record"
        )
    return row
