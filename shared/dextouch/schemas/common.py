"""What bodies of all services share: types of fields, problems (RFC 9457) and probes."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError
from pydantic_core import from_json, to_json

from dextouch import errors
from dextouch.frozen_model import FrozenModel

# Letters of a task's sentence, in takes, episodes and rollouts alike.
MAX_INSTRUCTION = 2000
ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,127}$"
StoreId = Annotated[str, Field(pattern=ID_PATTERN)]
# Of a W3C trace (docs/operations.md#traces).
TraceId = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
Domain = Literal["human", "robot"]
Origin = Literal["recorded", "twin", "imagined"]
# Source of a stream's time stamps: the device's stamps, its sequence numbers, counting of samples,
# or plain arrival times.
ClockMethod = Literal["device", "sequence", "counting", "arrival"]
# Reasons to doubt the times of a stream: its clock is far off its nominal rate, even the promptest
# samples arrive more than a sample period later than fitted, or a stop of the clock cannot be
# distinguished from an increase of the path delay.
ClockWarning = Literal["skew", "residual", "stop"]
# Validation of lists in uploads stops at the first mistake: to collect 500,000 takes seconds.
Matrix = Annotated[
    tuple[Annotated[tuple[FiniteFloat, ...], Field(fail_fast=True)], ...], Field(fail_fast=True)
]
NonNegativeFinite = Annotated[FiniteFloat, Field(ge=0)]
# Centre x y z and half sizes x y z of a bounding box.
Box = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]

PROBLEM_MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:dextouch:error:"
MAX_NAMED = 1000  # chosen: bounds the text of an error
MAX_LISTED = 5  # chosen: a line that people read
# Names of the error constructor's own parameters.
RESERVED = frozenset({"self", "message"})
# The first matching class decides; leaves of the tree precede their parents.
STATUS_OF_CLASS: tuple[tuple[type[errors.DexTouchError], int], ...] = (
    (errors.PacketError, 400),
    (errors.InvalidInputError, 422),
    (errors.NotFoundError, 404),
    (errors.ConflictError, 409),
    (errors.LimitExceededError, 413),
    (errors.UnavailableError, 503),
    (errors.DeviceError, 503),
    (errors.StorageFullError, 507),
    (errors.StorageError, 500),
)
STATUS_OF_REASON = {
    **dict.fromkeys(("missing_scope", "other_key", "other_station", "foreign_origin"), 403),
    **dict.fromkeys(("unknown_token", "used_token", "expired_token"), 403),
    **dict.fromkeys(("expired_link", "revoked_link", "other_pool"), 403),
    "foreign_host": 421,
    "too_many_wrong_keys": 429,
}
CLASS_OF_STATUS: dict[int, type[errors.DexTouchError]] = {
    **dict.fromkeys((400, 405, 406, 415, 422), errors.InvalidInputError),
    **dict.fromkeys((401, 403, 421), errors.AccessDeniedError),
    404: errors.NotFoundError,
    409: errors.ConflictError,
    **dict.fromkeys((413, 429), errors.LimitExceededError),
    **dict.fromkeys((502, 503, 504), errors.UnavailableError),
    507: errors.StorageFullError,
}


class Health(FrozenModel):
    """Liveness: the process responds."""

    status: Literal["ok"] = "ok"
    service: str
    version: str


class Readiness(FrozenModel):
    """Readiness for requests; `waiting_for` names what is missing (empty when ready)."""

    ready: bool
    service: str
    waiting_for: tuple[str, ...] = ()


class Problem(BaseModel):
    """Body of every response with a status of 400 or more.

    `type` is `urn:dextouch:error:` followed by the class in `dextouch.errors`; `details` holds the
    facts of `detail` as data (`expected`, `got`, `valid`, `retry_after_s`, …).
    """

    model_config = ConfigDict(frozen=True)

    type: str
    title: str
    status: int = Field(ge=400, le=599)
    detail: str
    instance: str = ""
    request_id: str = ""
    trace_id: str = ""
    details: dict[str, Any] = {}


def status_of(error: errors.DexTouchError) -> int:
    """The HTTP status of an error.

    Two classes depend on their details: a temporary limit (`retry_after_s`) is 429, any other 413;
    a refusal depends on its `reason`: a missing or unknown key is 401, a missing scope, what is of
    another key or station, a foreign origin or an invalid token or link 403, a foreign host name
    421, one of many wrong keys 429.
    """
    if isinstance(error, errors.LimitExceededError) and "retry_after_s" in error.details:
        return 429
    if isinstance(error, errors.AccessDeniedError):
        return STATUS_OF_REASON.get(str(error.details.get("reason")), 401)
    return next((status for kind, status in STATUS_OF_CLASS if isinstance(error, kind)), 500)


def problem_from_error(error: errors.DexTouchError, *, instance: str, request_id: str) -> Problem:
    """Convert an error to a response body; details become plain JSON."""
    name = type(error).__name__
    details = from_json(to_json(error.details, fallback=str, inf_nan_mode="strings"))
    return Problem(
        type=TYPE_PREFIX + name,
        title=name.removesuffix("Error"),
        status=status_of(error),
        detail=error.message,
        instance=instance,
        request_id=request_id,
        details=details,
    )


def error_from_problem(problem: Problem, where: str | None = None) -> errors.DexTouchError:
    """Convert a response body to an error: the named class if known, otherwise one by status."""
    name = problem.type.removeprefix(TYPE_PREFIX)
    named = getattr(errors, name, None)
    if isinstance(named, type) and issubclass(named, errors.DexTouchError):
        kind: type[errors.DexTouchError] = named
    else:
        kind = CLASS_OF_STATUS.get(problem.status, errors.UnavailableError)
    # UnknownNameError builds its own message; the server's is the one to keep.
    error = kind.__new__(kind)
    details = {key: value for key, value in problem.details.items() if key not in RESERVED}
    # A service that refuses a key does not know its own address.
    is_of_key = where is not None and issubclass(kind, errors.AccessDeniedError)
    message = f"{where}: {problem.detail}" if is_of_key else problem.detail
    errors.DexTouchError.__init__(error, message, **details)
    return error


def first_problems(error: ValidationError) -> str:
    """Summarize pydantic's errors in one line, without the input; of very many only their number.

    Strips the prefix "Value error, " that pydantic adds to messages of validators.
    """
    # Pydantic describes all of them, which takes longer than finding them.
    if error.error_count() > MAX_NAMED:
        return f"got {error.error_count()} mistakes, which are too many to name"
    items = error.errors(include_input=False, include_url=False)[:MAX_LISTED]
    return "; ".join(
        f"{'.'.join(str(part) for part in item['loc']) or 'fields'}: "
        f"{item['msg'].removeprefix('Value error, ')}"
        for item in items
    )
