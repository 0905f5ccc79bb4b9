"""Links by which people without a key rate the rollouts of one service until a date.

The secret of a link is a key of 256 random bits, of which the file of marks keeps the SHA-256 hash,
beside the rater, the pool of rollouts and the end. Whoever reads the file cannot make a link of it.
"""

import secrets
import threading
from datetime import UTC, datetime, timedelta
from typing import Annotated, Final, Literal

import structlog
from fastapi import APIRouter, Depends, Response
from pydantic import AwareDatetime, Field

from dextouch.errors import AccessDeniedError, ConflictError, NotFoundError
from dextouch.frozen_model import FrozenModel, example
from dextouch.schemas import KEY_NAME_PATTERN
from dextouch.serving import AccessControl, Grant, RequireScope, secret_digest
from services.evaluation.rating.marks import MarkLog

logger = structlog.get_logger(__name__)

NUM_SECRET_BYTES: Final = 32
_REFUSED: Final = {
    "other_pool": "this link is for other rollouts",
    "revoked_link": "this link was revoked or replaced",
    "expired_link": "this link has expired",
}
_SCHEMA: Final = """CREATE TABLE IF NOT EXISTS invitations (
  digest BLOB PRIMARY KEY, rater TEXT NOT NULL, pool TEXT NOT NULL, ends_at TEXT NOT NULL,
  is_revoked INTEGER NOT NULL DEFAULT 0)"""
KeyName = Annotated[str, Field(pattern=KEY_NAME_PATTERN)]


class InviteRater(FrozenModel):
    """Whom to invite, and for how many days."""

    model_config = example(rater="p07", days=14)

    rater: KeyName
    days: float = Field(default=14.0, gt=0, le=90)


class RaterLink(FrozenModel):
    """A new link, shown once: what stands behind the address of the rating page."""

    link: str
    ends_at: AwareDatetime


class Invitation(FrozenModel):
    """An invitation of a rater, and whether its link works now."""

    rater: str
    ends_at: AwareDatetime
    state: Literal["valid", "expired_link", "revoked_link"]


class InvitedRater(Grant):
    """What a link allows: rating in its pool, until it ends."""

    ends_at: AwareDatetime
    refused: Literal["other_pool", "revoked_link"] | None

    @property
    def reason(self) -> str | None:
        """Why the link does not hold here and now; None if it does."""
        return self.refused or ("expired_link" if self.ends_at <= datetime.now(UTC) else None)

    def require(self, scope: str) -> None:
        """Raise AccessDeniedError if the link does not hold, or lacks a scope."""
        if reason := self.reason:
            raise AccessDeniedError(
                f"{_REFUSED[reason]}; ask whoever invited you for a new one", reason=reason
            )
        super().require(scope)


class Invitations:
    """Invitations to rate the rollouts of one service, its pool.

    They are in the file of marks, which services with other pools may use, too; one process of a
    service issues and revokes those of its pool. Raises StorageError if it cannot be used.
    """

    def __init__(self, marks: MarkLog, pool: str) -> None:
        self._marks, self._pool = marks, pool
        self._access = AccessControl(())
        self._lock = threading.Lock()
        self._invited: list[tuple[bytes, InvitedRater]] = []
        with marks.connected("opened") as connection:
            connection.execute(_SCHEMA)

    def connect(self, access: AccessControl) -> None:
        """Accept the links beside the keys of the settings, now and at every change."""
        self._access = access
        self._accept()

    def listing(self) -> list[Invitation]:
        """All invitations to this pool, newest first."""
        return [
            Invitation.model_validate(
                {"rater": one.name, "ends_at": one.ends_at, "state": one.reason or "valid"}
            )
            for _, one in reversed(self._invited)
            if one.refused != "other_pool"
        ]

    def issue(self, rater: str, days: float, *, by: str) -> RaterLink:
        """Invite a rater, whose earlier links to this pool are revoked.

        Raises ConflictError if the service needs no keys, or one of its keys has the name.
        """
        if not self._access.has_keys:
            raise ConflictError(
                "the service has no api_keys, so that raters need no link either; set api_keys, "
                "without which only this machine reaches it (docs/access.md)"
            )
        if rater in self._access.key_names:
            raise ConflictError(f"rater {rater!r}: a key has this name; choose another name")
        secret = secrets.token_urlsafe(NUM_SECRET_BYTES)
        ends_at = datetime.now(UTC) + timedelta(days=days)
        self._change(rater, by, (secret_digest(secret), rater, self._pool, ends_at.isoformat()))
        # Behind "#", which browsers send to nobody, so that no log keeps it.
        return RaterLink(link=f"/#{rater}:{secret}", ends_at=ends_at)

    def revoke(self, rater: str, *, by: str) -> list[Invitation]:
        """Refuse a rater's links to this pool from the next request on; their marks stay.

        Raises NotFoundError if all are revoked already.
        """
        if not self._change(rater, by):
            raise NotFoundError(f"rater {rater!r}: has no link to revoke")
        return self.listing()

    def _change(self, rater: str, by: str, new: tuple[object, ...] = ()) -> int:
        """Revoke a rater's links, of which the number is returned, and add a new one."""
        with self._lock:
            with self._marks.connected("written") as connection:
                num_revoked = connection.execute(
                    "UPDATE invitations SET is_revoked = 1 "
                    "WHERE rater = ? AND pool = ? AND NOT is_revoked",
                    (rater, self._pool),
                ).rowcount
                if new:
                    connection.execute("INSERT INTO invitations VALUES (?, ?, ?, ?, 0)", new)
            self._accept()
        logger.info("invite_rater" if new else "revoke_rater", rater=rater, by=by)
        return num_revoked

    def _accept(self) -> None:
        with self._marks.connected("read") as connection:
            rows = connection.execute("SELECT * FROM invitations ORDER BY rowid").fetchall()
        self._invited = [
            (
                digest,
                InvitedRater(
                    name=rater,
                    scopes=("rate",),
                    ends_at=datetime.fromisoformat(ends_at),
                    refused="other_pool"
                    if pool != self._pool
                    else "revoked_link"
                    if is_revoked
                    else None,
                ),
            )
            for digest, rater, pool, ends_at, is_revoked in rows
        ]
        self._access.set_enrolled(self._invited)


def invitation_router(invitations: Invitations) -> APIRouter:
    """Create the routes below /v1/rating/invitations, for whoever leads the rating."""
    leads = Depends(RequireScope("rate_lead"))
    router = APIRouter(prefix="/v1/rating/invitations", tags=["rating"], dependencies=[leads])

    @router.get("")
    def list_invitations() -> list[Invitation]:
        """List the invitations to these rollouts, newest first."""
        return invitations.listing()

    @router.post("", status_code=201)
    def invite_rater(body: InviteRater, by: Annotated[str, leads], response: Response) -> RaterLink:
        """Make a link for a rater, in place of an earlier one; it is shown only now."""
        response.headers["cache-control"] = "no-store"
        return invitations.issue(body.rater, body.days, by=by)

    @router.post("/{rater}/revoke")
    def revoke_rater(rater: KeyName, by: Annotated[str, leads]) -> list[Invitation]:
        """Refuse a rater's link from now on; marks stay."""
        return invitations.revoke(rater, by=by)

    return router
