"""Large JSON bodies: decoded in a thread, and mistakes are named at a bounded cost."""

import json
import threading
from typing import Annotated

import httpx
import pytest
from fastapi import APIRouter, Depends
from pydantic import Field, field_validator

from dextouch.frozen_model import FrozenModel
from dextouch.serving import JSON, JsonBody, ServiceSettings, create_service_app
from dextouch.serving.guard import takes

DECODED_IN = []


class Mark(FrozenModel):
    count: int = Field(ge=0)


class Marks(FrozenModel):
    marks: dict[str, Mark]
    note: str = ""

    @field_validator("note")
    @classmethod
    def _remembers_its_thread(cls, note: str) -> str:
        DECODED_IN.append(threading.get_ident())
        return note


@pytest.fixture
def app():
    router = APIRouter(prefix="/v1")

    @router.post("/marks")
    @takes({JSON: 2**20})
    async def count(body: Annotated[Marks, Depends(JsonBody(Marks))]) -> int:
        return len(body.marks)

    return create_service_app(name="probe", settings=ServiceSettings(), routers=[router])


@pytest.fixture
async def post(app):
    transport = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:

        async def sent(body):
            return await client.post(
                "/v1/marks", content=body, headers={"content-type": "application/json"}
            )

        yield sent


@pytest.mark.parametrize(("num_letters", "in_loop"), [(10, True), (2**17, False)])
async def test_large_bodies_are_decoded_in_a_thread(post, num_letters, in_loop):
    answer = await post(
        json.dumps({"marks": {"a": {"count": 1}}, "note": "x" * num_letters}).encode()
    )
    assert answer.json() == 1
    assert (DECODED_IN[-1] == threading.get_ident()) is in_loop


@pytest.mark.parametrize("padding", [0, 2**17])
async def test_mistakes_are_named_where_they_are(post, padding):
    answer = await post(b'{"marks": {"a": {"count": -1}}, "rest": 1}' + b" " * padding)
    assert answer.status_code == 422
    assert answer.json()["details"]["errors"] == [
        {"where": "body.marks.a.count", "what": "Input should be greater than or equal to 0"},
        {"where": "body.rest", "what": "Extra inputs are not permitted"},
    ]
    for broken in (b'{"marks": ', b"[" * 10_000, b"\xff", b'{"marks": {}}x'):
        answer = await post(broken + b" " * padding)
        assert (answer.status_code, answer.json()["title"]) == (400, "InvalidInput"), broken


async def test_many_mistakes_are_counted_not_named(post):
    rest = ",".join(f'"{i}":1' for i in range(80_000))
    answer = await post(f"{{{rest}}}".encode())
    assert answer.status_code == 422
    assert answer.json()["detail"] == "body: got 80001 mistakes, which are too many to name"


def test_the_body_is_documented_with_its_parts(app):
    document = app.openapi()
    body = document["paths"]["/v1/marks"]["post"]["requestBody"]
    assert body["required"]
    assert body["content"]["application/json"]["schema"] == {"$ref": "#/components/schemas/Marks"}
    fields = document["components"]["schemas"]["Marks"]["properties"]
    reference = fields["marks"]["additionalProperties"]["$ref"]
    assert reference == "#/components/schemas/Mark"
    assert document["components"]["schemas"]["Mark"]["properties"]["count"]["minimum"] == 0
