"""A rollout service over a world that adds up, and rollouts begun in it."""

from dextouch.schemas import ReturnSelector, RolloutStart, decode_answer
from dextouch.serving.state import MemoryState
from dextouch.worlds.rollouts import RolloutService
from dextouch.worlds.settings import RolloutLimits
from tests.unit.worlds.fakes import (
    SumWorld,
)

ALL = ReturnSelector()
START = RolloutStart("stand_bottle", 3, "stand the bottle")


def service(store=None, world=None, **limits) -> RolloutService:
    served = world or SumWorld()
    return RolloutService({"sum": served}, store or MemoryState(), RolloutLimits(**limits))


def decoded(answer):
    return decode_answer(answer.payload, max_bytes=10**7)


async def begin(made, start=START) -> str:
    return decoded(await made.start("sum", start, ALL)).rollout.id
