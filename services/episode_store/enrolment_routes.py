"""HTTP routes of the enrolment of stations: tokens, keys for them, and revocation."""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Annotated, Final

import structlog
from fastapi import APIRouter, Depends, Request, Response

from dextouch.errors import AccessDeniedError, LimitExceededError
from dextouch.schemas import (
    EnrolmentToken,
    EnrolStation,
    StationEnrolments,
    StationKey,
    UseToken,
)
from dextouch.serving import JSON, KIB, RequireScope, takes
from services.episode_store.enrolment import Enrolments

logger = structlog.get_logger(__name__)

SCOPE: Final = "enrol"
MAX_FAILURES: Final = 10
FAILURE_PERIOD_S: Final = 60.0
MAX_CLIENTS: Final = 1024


class RecentFailures:
    """Counts invalid tokens by address, to slow down guessing."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._times_s: OrderedDict[str, deque[float]] = OrderedDict()

    def check(self, client: str) -> None:
        """Raise LimitExceededError while an address has too many recent failures."""
        with self._lock:
            times_s = self._times_s.get(client)
            if times_s is None or len(times_s) < MAX_FAILURES:
                return
            left_s = times_s[0] + FAILURE_PERIOD_S - self._clock_s()
        if left_s > 0:
            raise LimitExceededError(
                f"too many invalid tokens from {client}: at most {MAX_FAILURES} in "
                f"{FAILURE_PERIOD_S:.0f} s; try again later",
                retry_after_s=int(left_s) + 1,
            )

    def add(self, client: str) -> None:
        """Count a failure; of more than `MAX_CLIENTS` addresses, the oldest are forgotten."""
        with self._lock:
            self._times_s.setdefault(client, deque(maxlen=MAX_FAILURES)).append(self._clock_s())
            self._times_s.move_to_end(client)
            if len(self._times_s) > MAX_CLIENTS:
                self._times_s.popitem(last=False)


def enrolment_router(enrolments: Enrolments) -> APIRouter:
    """Create the routes below /v1/enrolments; the exchange of a token needs no key."""
    router = APIRouter(prefix="/v1/enrolments", tags=["enrolments"])
    failures = RecentFailures()
    may_enrol = Depends(RequireScope(SCOPE))

    @router.get("", dependencies=[may_enrol])
    def listing() -> StationEnrolments:
        """List enrolled, waiting and revoked stations."""
        return enrolments.listing()

    @router.post("", status_code=201)
    def issue(
        wanted: EnrolStation, by: Annotated[str, may_enrol], response: Response
    ) -> EnrolmentToken:
        """Issue a one-time token for a station, valid for 15 minutes."""
        response.headers["cache-control"] = "no-store"
        return enrolments.issue(wanted.station, by=by)

    @router.post("/exchange", status_code=201)
    @takes({JSON: KIB}, needs_key=False)
    def exchange(given: UseToken, request: Request, response: Response) -> StationKey:
        """Exchange a token for a key of the station's own, once."""
        response.headers["cache-control"] = "no-store"
        client = request.client.host if request.client else "unknown"
        failures.check(client)
        try:
            return enrolments.exchange(given.token.get_secret_value(), client=client)
        except AccessDeniedError as error:
            failures.add(client)
            reason = error.details.get("reason")
            logger.warning("refuse_enrolment_token", client=client, reason=reason)
            raise

    @router.post("/{station}/revoke")
    def revoke(station: str, by: Annotated[str, may_enrol]) -> StationEnrolments:
        """Refuse the key of a station from now on, or its unused token."""
        enrolments.revoke(station, by=by)
        return enrolments.listing()

    return router
