"""Large JSON bodies, decoded at a bounded cost and without blocking other requests for long."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from dextouch.errors import InvalidInputError
from dextouch.schemas import MAX_NAMED, first_problems
from dextouch.serving.guard import KIB

ModelT = TypeVar("ModelT", bound=BaseModel)

# Bodies above it are decoded in a thread, so that others need not wait.
MAX_INLINE_BYTES = 64 * KIB


@dataclass(frozen=True)
class JsonBody(Generic[ModelT]):
    """Route dependency for a body of more than 64 KiB: `Depends(JsonBody(RecordingAttributes))`.

    FastAPI by itself decodes on the event loop and describes every mistake, of which 1 MiB has room
    for 100,000.
    """

    model: type[ModelT]

    async def __call__(self, request: Request) -> ModelT:
        """The body; raises RequestValidationError, or InvalidInputError for too many mistakes."""
        body = await request.body()
        if len(body) <= MAX_INLINE_BYTES:
            return self._decode(body)
        return await run_in_threadpool(self._decode, body)

    def _decode(self, body: bytes) -> ModelT:
        try:
            return self.model.model_validate(from_json(body) if body else None)
        except ValidationError as error:
            if error.error_count() > MAX_NAMED:
                raise InvalidInputError(f"body: {first_problems(error)}") from None
            mistakes = error.errors(include_url=False)
        except ValueError as error:
            mistakes = [{"type": "json_invalid", "loc": (), "msg": str(error), "input": {}}]
        raise RequestValidationError([{**one, "loc": ("body", *one["loc"])} for one in mistakes])
