"""Bodies of the enrolment of stations: one-time tokens, and the keys that stations get for them."""

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, SecretStr

from dextouch.frozen_model import FrozenModel

KEY_NAME_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"
KeyName = Annotated[str, Field(pattern=KEY_NAME_PATTERN)]


class EnrolStation(FrozenModel):
    """Request for a token; the station's key will have the station's name."""

    station: KeyName


class EnrolmentToken(FrozenModel):
    """A one-time token, which is shown in this response only."""

    station: KeyName
    token: str
    expires_at: AwareDatetime


class UseToken(FrozenModel):
    """A station's request for a key."""

    token: SecretStr = Field(max_length=256)


class StationKey(FrozenModel):
    """The key of a station, which is shown in this response only."""

    station: KeyName
    key: str


class StationEnrolment(FrozenModel):
    """One enrolment of a station: who asked for it, when its token was used, who revoked its key.

    `requested_by` and `revoked_by` are names of keys, `enrolled_from` is an address.
    """

    station: KeyName
    state: Literal["waiting", "expired", "enrolled", "revoked"]
    requested_at: AwareDatetime
    requested_by: str
    expires_at: AwareDatetime
    enrolled_at: AwareDatetime | None = None
    enrolled_from: str = ""
    revoked_at: AwareDatetime | None = None
    revoked_by: str = ""


class StationEnrolments(FrozenModel):
    """All enrolments, newest first; `needs_key` is false where uploads need no key."""

    enrolments: tuple[StationEnrolment, ...]
    needs_key: bool


# Bodies by which a station asks the store which of its spooled takes were deleted.

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
