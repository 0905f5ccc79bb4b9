"""Responses of the rollout service, as parts and encoded."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np

from dextouch.schemas import Observation, ReturnSelector, RolloutInfo, answer_parts

# More images are encoded as JPEG beside the event loop; JPEG takes some 15 ms for a megabyte.
MAX_INLINE_IMAGE_BYTES: Final = 2**16

AnswerParts = tuple[dict[str, Any], dict[str, np.ndarray]]


@dataclass(frozen=True)
class Answer:
    """An encoded response; `replayed` if it was computed for an earlier, equal request.

    `parts` are its fields and arrays; None where only the bytes are known. `spent_s` are the times
    in queue, device, encoder and store; empty where nothing was computed.
    """

    payload: bytes
    parts: AnswerParts | None = None
    replayed: bool = False
    spent_s: Mapping[str, float] = field(default_factory=dict)


async def parts_of(
    rollout: RolloutInfo,
    seen: Observation,
    selector: ReturnSelector,
    **told: Any,  # noqa: ANN401 - see answer_parts
) -> AnswerParts:
    """Fields and arrays of a response, from a thread where encoding the images takes long."""
    num_bytes = sum(images.nbytes for images in seen.images.values())
    make = partial(answer_parts, rollout, seen, selector=selector, **told)
    if selector.images == "raw" or num_bytes <= MAX_INLINE_IMAGE_BYTES:
        return make()
    return await asyncio.to_thread(make)


@lru_cache(maxsize=64)
def selector_bytes(selector: ReturnSelector) -> bytes:
    """A selector as it enters the hash of a request."""
    return selector.model_dump_json().encode()
