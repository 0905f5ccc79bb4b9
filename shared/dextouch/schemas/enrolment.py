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
