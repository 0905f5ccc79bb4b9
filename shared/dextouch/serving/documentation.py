"""OpenAPI documents: what routes declare of keys, bodies and refusals, made visible to clients.

FastAPI documents parameters, models and successful responses. The rest follows from the routes:
`RequireScope` the security scheme, `takes` the request body, method and parameters the refusals.
"""

from collections.abc import Iterator, Sequence
from http import HTTPStatus
from typing import Any, TypeVar

from fastapi import APIRouter, FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute

from dextouch.schemas import PROBLEM_MEDIA_TYPE, Problem
from dextouch.serving.guard import JSON, SAFE_METHODS, JsonBody, RequireScope, body_rule

CallT = TypeVar("CallT")
KEY_SCHEME = "api_key"
BEARER = {"type": "http", "scheme": "bearer", "description": "A key of the service's settings."}
BINARY = {"type": "string", "format": "binary"}
PROBLEM_CONTENT = {PROBLEM_MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}

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
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    schemas["Problem"] = Problem.model_json_schema()
    # Of FastAPI's own 422, which no service gives.
    schemas.pop("HTTPValidationError", None)
    schemas.pop("ValidationError", None)
    for operation, route, method in _operations(document, routers):
        needed = _dependencies(route.dependant, RequireScope)
        scopes = list(dict.fromkeys(one.scope for one in needed))
        if scopes:
            document["components"].setdefault("securitySchemes", {})[KEY_SCHEME] = BEARER
            keyed = {KEY_SCHEME: scopes}
            operation["security"] = [keyed] if needs_key else [keyed, {}]
        for body in _dependencies(route.dependant, JsonBody):
            schema = body.model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas |= schema.pop("$defs", {})
            operation["requestBody"] = {"required": True, "content": {JSON: {"schema": schema}}}
        rule = body_rule(route.endpoint)
        if rule is not None and rule.max_bytes:
            # Media types that the route takes and reads by itself.
            body_of = operation.setdefault("requestBody", {"required": True})
            for kind in rule.max_bytes:
                schema = {} if kind == JSON else {"schema": BINARY}
                body_of.setdefault("content", {}).setdefault(kind, schema)
        _document_refusals(operation, method, has_scope=bool(scopes))
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
    """Dependencies of a route of one kind, in order."""
    for dependency in dependant.dependencies:
        if isinstance(dependency.call, kind):
            yield dependency.call
        yield from _dependencies(dependency, kind)


def _document_refusals(operation: dict[str, Any], method: str, *, has_scope: bool) -> None:
    responses = operation.setdefault("responses", {})
    statuses = set(OF_ANY)
    if "security" in operation:
        statuses.add(401)
    if has_scope:
        statuses.add(403)
    if method not in SAFE_METHODS:
        statuses |= OF_CHANGES
    if "requestBody" in operation:
        statuses.add(400)
    if operation.get("parameters"):
        statuses.add(422)
    if any(parameter["in"] == "path" for parameter in operation.get("parameters", ())):
        statuses.add(404)
    statuses |= {int(status) for status in responses if int(status) >= 400}
    for status in statuses:
        responses[str(status)] = {
            "description": HTTPStatus(status).phrase,
            "content": PROBLEM_CONTENT,
        }
