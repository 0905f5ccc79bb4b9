"""Calls into policy code, with validation of results and errors that name the policy."""

import importlib
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.actions import ACTION_DIM, check_actions
from dextouch.schemas import WorldDescription

# Frames cut from tracebacks: this file and the import machinery.
_OUR_FRAMES = (__file__, "<frozen importlib", importlib.__file__)


def ask(call: Callable[..., Any], *arguments: object, where: str, **keywords: object) -> Any:  # noqa: ANN401 - whatever the policy gives
    """Call a function of a policy.

    Raises:
        InvalidInputError: the function raised; `details["traceback"]` is its own traceback,
            without frames of the caller.
    """
    try:
        return call(*arguments, **keywords)
    except (Exception, SystemExit) as error:  # a policy may raise anything
        raise InvalidInputError(
            f"{where} raised {type(error).__name__}: {error}", traceback=own_traceback(error)
        ) from error


def own_traceback(error: BaseException) -> str:
    """Traceback of an error without the frames that led to the policy's code."""
    trace = error.__traceback__
    while trace and trace.tb_frame.f_code.co_filename.startswith(_OUR_FRAMES):
        trace = trace.tb_next
    return "".join(traceback.format_exception(type(error), error, trace))


def action_chunk(
    answer: object, world: WorldDescription, *, where: str
) -> Float64[np.ndarray, "steps 67"]:
    """Validate the return value of a policy's `act` as an action chunk of a world.

    Args:
        answer: array, nested list or tensor [K, 67] of any kind of real number.
        world: world that the chunk is for.
        where: policy, task, seed and chunk, for error messages.

    Raises:
        ShapeError: wrong shape or dtype, or a K that the world does not accept.
        NonFiniteError: NaN or infinity.
    """
    rows = _array(answer, where)
    if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != ACTION_DIM:
        raise ShapeError(
            f"{where} returned {_described(answer, rows)}, expected an array [K, {ACTION_DIM}] of "
            "real numbers"
        )
    if not 0 < len(rows) <= world.max_chunk_steps or len(rows) % world.chunk_multiple:
        raise ShapeError(
            f"{where} returned {len(rows)} rows, expected a multiple of {world.chunk_multiple}, at "
            f"least {world.chunk_multiple} and at most {world.max_chunk_steps} (world "
            f"{world.name!r}); return only the rows that are to be carried out"
        )
    return check_actions(rows, where=f"{where} returned")


def _array(answer: object, where: str) -> np.ndarray:
    # A torch tensor that requires a gradient or lies on a GPU does not convert by itself.
    detach = getattr(answer, "detach", None)
    try:
        return np.asarray(answer if detach is None else detach().cpu().double())
    except Exception as error:  # arrays of other libraries convert themselves, or fail to
        raise ShapeError(
            f"{where} returned {type(answer).__name__}, which does not convert to an array "
            f"({error}), expected [K, {ACTION_DIM}]"
        ) from error


def _described(answer: object, rows: np.ndarray) -> str:
    if rows.dtype.kind == "O":
        return f"{type(answer).__name__}"
    return f"{type(answer).__name__} of shape {list(rows.shape)} and {rows.dtype}"
