"""Bodies by which a station asks the store which of its spooled takes were deleted."""

from typing import Annotated

from pydantic import AwareDatetime, Field

from dextouch.frozen_model import FrozenModel

# Reason of the store's ConflictError for a take that was deleted: the station removes it.
TAKE_DELETED = "take_deleted"
# And for one that began after its operator was deleted, which a person has to judge.
OPERATOR_DELETED = "operator_deleted"
MAX_CHECKED_TAKES = 200
MAX_OPERATORS = 1000
StationName = Annotated[str, Field(min_length=1, max_length=128)]


class SpooledTake(FrozenModel):
    """A take in a station's spool, with the ids under which the store has or would have it.

    Of damaged takes nothing but ids is known.
    """

    recording_id: str
    stored_as: Annotated[tuple[str, ...], Field(max_length=2)] = ()
    operator: str | None = None
    started_at: AwareDatetime | None = None
    started_t_host_ns: int | None = None
    is_damaged: bool = False


class CheckTakes(FrozenModel):
    """A part of a station's spool, and all operators that its session names."""

    station: StationName
    takes: Annotated[tuple[SpooledTake, ...], Field(max_length=MAX_CHECKED_TAKES)] = ()
    operators: Annotated[tuple[str, ...], Field(max_length=MAX_OPERATORS)] = ()


class PendingDeletion(FrozenModel):
    """A take that has to be removed, and the deletion that says so."""

    recording_id: str
    deletion: str


class CheckedTakes(FrozenModel):
    """Takes to remove and operators to forget; `revision` is that of the deletions."""

    revision: str
    takes: tuple[PendingDeletion, ...] = ()
    operators: tuple[str, ...] = ()


class DeletionsRevision(FrozenModel):
    """Changes with every deletion."""

    revision: str


class ConfirmRemoval(FrozenModel):
    """A station has worked off all deletions of a revision, except the takes it still holds."""

    station: StationName
    revision: str
    held: Annotated[tuple[PendingDeletion, ...], Field(max_length=MAX_CHECKED_TAKES)] = ()


class OutstandingTakes(FrozenModel):
    """Takes that a station still holds, or has not yet said that it does not hold."""

    station: str
    recordings: tuple[str, ...]
    has_answered: bool


class DeletionStatus(FrozenModel):
    """A deletion and what is outstanding of it; `key` is the same for the same request."""

    key: str
    deleted_at: AwareDatetime
    is_of_operator: bool
    num_recordings: int
    outstanding: tuple[OutstandingTakes, ...]


class Deletions(FrozenModel):
    """All deletions that the store remembers, oldest first."""

    deletions: tuple[DeletionStatus, ...]
