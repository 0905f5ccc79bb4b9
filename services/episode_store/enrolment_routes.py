"""HTTP routes of the enrolment of stations: tokens, keys for them, and revocation."""

from typing import Annotated, Final

from fastapi import APIRouter, Depends, Request, Response

from dextouch.errors import AccessDeniedError
from dextouch.schemas import (
    EnrolmentToken,
    EnrolStation,
    StationEnrolments,
    StationKey,
    UseToken,
)
from dextouch.serving import JSON, KIB, RequireScope, WrongKeys, takes
from services.episode_store.enrolment import Enrolments

SCOPE: Final = "enrol"


def enrolment_router(enrolments: Enrolments) -> APIRouter:
    """Create the routes below /v1/enrolments; the exchange of a token needs no key."""
    router = APIRouter(prefix="/v1/enrolments", tags=["enrolments"])
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
        try:
            return enrolments.exchange(given.token.get_secret_value(), client=client)
        except AccessDeniedError as error:
            if error.details["reason"] == "unknown_token":
                wrong_keys: WrongKeys = request.app.state.wrong_keys
                wrong_keys.count(request, what="token")
            raise

    @router.post("/{station}/revoke")
    def revoke(station: str, by: Annotated[str, may_enrol]) -> StationEnrolments:
        """Refuse the key of a station from now on, or its unused token."""
        enrolments.revoke(station, by=by)
        return enrolments.listing()

    return router
