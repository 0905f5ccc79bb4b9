"""OpenAPI document of a service, complete enough for generated clients and for a page of it.

What FastAPI does not document follows from `RequireScope`, `takes`, `JsonBody` and the method.
"""

from collections.abc import Iterator, Sequence
from http import HTTPStatus
from typing import Any, Final, TypeVar

from fastapi import APIRouter, FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel

from dextouch import errors
from dextouch.frozen_model import attribute_docs
from dextouch.schemas import PROBLEM_MEDIA_TYPE, Problem, problem_from_error
from dextouch.serving.guard import (
    JSON,
    MSGPACK,
    OCTETS,
    SAFE_METHODS,
    JsonBody,
    RequireScope,
    body_rule,
)

CallT = TypeVar("CallT")
DESCRIPTION: Final = """\
A key of the service's settings is sent as `Authorization: Bearer KEY`. A service without keys \
answers programs and pages of its own machine only.

Every refusal is a `Problem` (`application/problem+json`, RFC 9457): `detail` says what is wrong, \
where, what was expected and what to do, and `details` holds the same facts as data.

`application/msgpack` is MessagePack with a map of `fields` and `arrays`; an array is a map of \
`dtype`, `shape` and `data` (C order, little endian). Names of fields end in their unit, and times \
in `_ns` are whole nanoseconds.
"""
KEY_SCHEME: Final = "api_key"
BEARER: Final = {
    "type": "http",
    "scheme": "bearer",
    "description": "A key of the service's settings.",
}
_MEANINGS: Final = {
    MSGPACK: "MessagePack: a map of `fields` and `arrays`",
    OCTETS: "Bytes as they are",
    "image/jpeg": "A JPEG file",
}
REFERENCE: Final = "#/components/schemas/{model}"
_PARAMETERS: Final = {
    "recording_id": "Id of a take, which its station has given it.",
    "episode_id": "Id of an episode, as `list_episodes` lists it.",
    "item_id": "Id of the recording or episode.",
    "stream": "Name of a stream, such as `tactile_left`.",
    "camera": "Name of a camera, such as `camera_head`.",
    "rollout_id": "Id of a rollout, from the answer of `start_rollout`.",
    "chunk": "Number of the action chunk, from 0; must be `next_chunk` of the rollout.",
    "watch_id": "Id of a rollout for those who watch, from `list_watched_rollouts`.",
    "alignment_id": "Id of an alignment, from `start_alignments`.",
    "station": "Name of a station.",
    "if-none-match": "The `ETag` of an earlier answer; 304 if it is still the newest.",
}

# When a status occurs, and an error that causes it.
REFUSALS: Final[dict[int, tuple[str, errors.DexTouchError]]] = {
    400: ("No valid JSON.", errors.InvalidInputError("body: JSON decode error at character 17")),
    401: (
        "No key, or an unknown one.",
        errors.AccessDeniedError(
            "expected the header 'Authorization: Bearer KEY'", reason="missing_key"
        ),
    ),
    403: (
        "A key without the scope of this operation, or a page of another site.",
        errors.AccessDeniedError("the key 'viewer' lacks the scope", reason="missing_scope"),
    ),
    404: ("Unknown, deleted or expired.", errors.NotFoundError("item 'x': unknown", got="x")),
    408: ("The request arrived too slowly.", errors.UnavailableError("got a part of a request")),
    409: (
        "The state does not allow it; `details.expected` says what would.",
        errors.ConflictError("got 3 out of turn, expected 2", expected=2, got=3),
    ),
    413: (
        "The body, or what it asks for, is larger than allowed.",
        errors.LimitExceededError("body: got 70000 bytes, expected at most 65536"),
    ),
    415: (
        "A Content-Type that the operation does not take.",
        errors.InvalidInputError("body: got Content-Type 'none', expected application/json"),
    ),
    421: (
        "A host name that is not one of the service.",
        errors.AccessDeniedError("host: got 'example.org'", reason="foreign_host"),
    ),
    422: (
        "A parameter or field is missing, unknown or out of range.",
        errors.InvalidInputError(
            "body.seed: Field required",
            errors=[{"where": "body.seed", "what": "Field required"}],
        ),
    ),
    429: (
        "Too many at once; try again after `details.retry_after_s`, also in `Retry-After`.",
        errors.LimitExceededError("256 chunks are pending; try again", retry_after_s=1),
    ),
    431: ("Too long headers.", errors.InvalidInputError("got 70000 bytes of headers")),
    500: (
        "An error of the service; its log has the request id.",
        errors.DexTouchError("unexpected error in the service"),
    ),
    503: (
        "Not ready, or about to end; try again.",
        errors.UnavailableError("the service is not ready", retry_after_s=1),
    ),
    507: ("The disk of the service is full.", errors.StorageFullError("no space for a batch")),
}

# The server, the guard and the error handlers can give these on any route (413 and 415 also where a
# GET has a body), and on those that change something.
OF_ANY = frozenset({408, 413, 415, 421, 429, 431, 500, 503})
OF_CHANGES = frozenset({403, 404, 409, 422, 507})


def document_service(
    app: FastAPI, routers: Sequence[APIRouter], *, needs_key: bool
) -> dict[str, Any]:
    """The OpenAPI document of a service, made once; without keys of the service a key is optional.

    A route declares further refusals by `responses={406: {}}`.
    """
    if app.openapi_schema is not None:
        return app.openapi_schema
    document = FastAPI.openapi(app)
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    schemas["Problem"] = Problem.model_json_schema()
    # Of FastAPI's own 422, which no service gives.
    schemas.pop("HTTPValidationError", None)
    schemas.pop("ValidationError", None)
    refusals: set[int] = set()
    for operation, route, method in _operations(document, routers):
        needed = _dependencies(route.dependant, RequireScope)
        scopes = list(dict.fromkeys(one.scope for one in needed))
        if scopes:
            components.setdefault("securitySchemes", {})[KEY_SCHEME] = BEARER
            keyed = {KEY_SCHEME: scopes}
            operation["security"] = [keyed] if needs_key else [keyed, {}]
        _document_body(operation, route, schemas)
        _describe_parameters(operation, route)
        statuses = _refusals_of(operation, method)
        operation["responses"] |= {
            str(status): {"$ref": f"#/components/responses/Refused{status}"}
            for status in sorted(statuses)
        }
        refusals |= statuses
    components["responses"] = {f"Refused{status}": _refusal(status) for status in sorted(refusals)}
    for path in document["paths"].values():
        for operation in path.values():
            _complete_answers(operation)
    return document


def _operations(
    document: dict[str, Any], routers: Sequence[APIRouter]
) -> Iterator[tuple[dict[str, Any], APIRoute, str]]:
    """Operations of the document with their routes and methods."""
    for router in routers:
        for route in router.routes:
            if isinstance(route, APIRoute) and route.include_in_schema and router.include_in_schema:
                for method in route.methods or ():
                    yield document["paths"][route.path_format][method.lower()], route, method


def _dependencies(dependant: Dependant, kind: type[CallT]) -> Iterator[CallT]:
    for dependency in dependant.dependencies:
        if isinstance(dependency.call, kind):
            yield dependency.call
        yield from _dependencies(dependency, kind)


def _document_body(operation: dict[str, Any], route: APIRoute, schemas: dict[str, Any]) -> None:
    """Bodies that the route takes and reads by itself."""
    rule = body_rule(route.endpoint)
    models = [body.model for body in _dependencies(route.dependant, JsonBody)]
    if rule is not None and rule.model is not None:
        models.append(rule.model)
    content: dict[str, Any] = {}
    for model in models:
        schema = model.model_json_schema(ref_template=REFERENCE)
        schemas |= schema.pop("$defs", {}) | {model.__name__: schema}
        content[JSON] = {"schema": {"$ref": REFERENCE.format(model=model.__name__)}}
    body = operation.get("requestBody", {"required": True})
    declared = body.get("content", {})
    for kind in () if rule is None else rule.max_bytes:
        # With parameters of the media type, where a route declares it so.
        if not any(name.partition(";")[0] == kind for name in declared):
            content.setdefault(kind, {} if kind == JSON else {"schema": _binary(kind)})
    if content or declared:
        operation["requestBody"] = body | {"content": content | declared}


def _describe_parameters(operation: dict[str, Any], route: APIRoute) -> None:
    described = dict(_PARAMETERS)
    for field in route.dependant.query_params:
        model = field.field_info.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):
            described |= attribute_docs(model)[1]
    for parameter in operation.get("parameters", ()):
        if parameter["name"] in described:
            parameter.setdefault("description", described[parameter["name"]])


def _refusals_of(operation: dict[str, Any], method: str) -> set[int]:
    statuses = set(OF_ANY)
    if "security" in operation:
        statuses |= {401, 403}
    if method not in SAFE_METHODS:
        statuses |= OF_CHANGES
    if "requestBody" in operation:
        statuses.add(400)
    if operation.get("parameters"):
        statuses.add(422)
    if any(parameter["in"] == "path" for parameter in operation.get("parameters", ())):
        statuses.add(404)
    return statuses | {int(status) for status in operation["responses"] if int(status) >= 400}


def _refusal(status: int) -> dict[str, Any]:
    phrase = HTTPStatus(status).phrase
    meaning, error = REFUSALS[status]
    example = problem_from_error(error, instance="/v1/…", request_id="5f0c…")
    content = {
        "schema": {"$ref": REFERENCE.format(model="Problem")},
        "example": example.model_copy(update={"status": status}).model_dump(),
    }
    return {"description": f"{phrase}: {meaning}", "content": {PROBLEM_MEDIA_TYPE: content}}


def _complete_answers(operation: dict[str, Any]) -> None:
    """JSON first, which most generated clients take, and a schema for every other media type."""
    for response in operation["responses"].values():
        content = response.get("content", {})
        for kind in sorted(content, key=lambda kind: kind != JSON):
            content[kind] = content.pop(kind) or {"schema": _binary(kind)}


def _binary(kind: str) -> dict[str, str]:
    schema = {"type": "string", "format": "binary"}
    return schema | ({"description": _MEANINGS[kind]} if kind in _MEANINGS else {})
