"""Content negotiation and conditional responses."""

from fastapi import HTTPException, Response

from services.episode_store.reading import Answer

MSGPACK = "application/msgpack"
WINDOW_MSGPACK = "application/vnd.dextouch.window+msgpack"
# Committed content is immutable but may be deleted: clients must revalidate.
CACHE_CONTROL = "private, no-cache"


def chosen_type(accept: str | None, offered: tuple[str, ...]) -> str:
    """Select the offered media type with the highest weight; the first one in a tie.

    Raises:
        HTTPException: 406, none is acceptable.
    """
    weights = [(_weight(kind, accept or "*/*"), -place) for place, kind in enumerate(offered)]
    weight, place = max(weights)
    if weight <= 0:
        # Starlette's exception, since no DexTouch error maps to 406.
        raise HTTPException(406, f"got Accept {accept!r}, expected one of {', '.join(offered)}")
    return offered[-place]


def as_response(answer: Answer, media_type: str) -> Response:
    """Response with ETag; 304 without a body if the client has it already."""
    headers = {"etag": answer.etag, "cache-control": CACHE_CONTROL, "vary": "accept"}
    if answer.data is None:
        return Response(status_code=304, headers=headers)
    return Response(answer.data, media_type=media_type, headers=headers)


def _weight(kind: str, accept: str) -> float:
    """Quality value of the most specific range that matches a media type."""
    ranges = {"*/*": 0, kind.partition("/")[0] + "/*": 1, kind: 2}
    best, weight = -1, 0.0
    for part in accept.split(","):
        name, *parameters = (word.strip().lower() for word in part.split(";"))
        if ranges.get(name, -1) > best:
            best, weight = ranges[name], _q(parameters)
    return weight


def _q(parameters: list[str]) -> float:
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                return float(value)
            except ValueError:
                return 0.0
    return 1.0
