"""Protocol of policies, which act in any world, and HTTP client of served worlds.

with RolloutClient("http://127.0.0.1:8100") as client:
    with client.start(world="twin", task="stand_bottle", seed=3, instruction="…") as rollout:
        while not rollout.observation.success:
            rollout.step(policy.act(rollout.observation))
"""

from contextlib import nullcontext, suppress
from copy import copy
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable
from urllib.parse import quote, urlencode

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ValidationError

from dextouch.clients.http_link import HttpLink, Reply
from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError, UnavailableError
from dextouch.hands.actions import AnchorPoses, check_actions
from dextouch.schemas import (
    EVERYTHING,
    ActionKind,
    ForkRequest,
    Observation,
    ReturnSelector,
    RolloutAnswer,
    RolloutInfo,
    RolloutOrigin,
    RolloutStart,
    StartRequest,
    WorldDescription,
    WorldList,
    decode_answer,
    encode_start,
    first_problems,
    validate_fields,
)

MSGPACK = "application/msgpack"
ACTIONS_TYPE = "application/octet-stream; dtype=float64"
MAX_ANSWER_BYTES = 2**28  # 64 steps of three cameras of 640 x 480 px have 177 MB
ModelT = TypeVar("ModelT", bound=BaseModel)

# An observation of one step made elsewhere, the poses at that step and the head camera's matrix.
InitialObservation = tuple[Observation, AnchorPoses, Float64[np.ndarray, "3 3"]]


class RolloutClient:
    """A connection to a service of worlds; not thread-safe (open one per thread).

    The key needs the scope `rollout`. A service that has ever responded may be full or away for
    `patience_s`, as while another worker takes over; requests are repeated meanwhile. `selector`
    says which cameras and steps its rollouts return; `name`, such as the policy's, is shown to
    those who watch.
    """

    def __init__(
        self,
        url: str,
        api_key: str | None = None,
        *,
        timeout_s: float = 60.0,
        patience_s: float = 30.0,
        selector: ReturnSelector = EVERYTHING,
        name: str = "",
    ) -> None:
        self.name = name
        self._link = HttpLink(url, api_key=api_key, timeout_s=timeout_s, patience_s=patience_s)
        self.selector = selector

    def selecting(self, selector: ReturnSelector, *, name: str | None = None) -> "RolloutClient":
        """A client on the same connection with another selector, or name, for new rollouts."""
        other = copy(self)
        other.selector = selector
        other.name = self.name if name is None else name
        return other

    def worlds(self) -> list[WorldDescription]:
        """Worlds and tasks of the service."""
        reply = self._link.request("GET", "/v1/worlds")
        return list(_parsed(WorldList, reply).worlds)

    def start(
        self,
        *,
        world: str,
        task: str,
        seed: int,
        instruction: str,
        init: InitialObservation | None = None,
        action_kind: ActionKind = "commanded",
    ) -> "Rollout":
        """Start a rollout from a task and seed, or from an observation made elsewhere.

        A connection that is lost meanwhile may leave an unused rollout at the service, which
        expires there.

        Raises:
            UnknownNameError: world, task or action kind (the valid ones are listed).
            InvalidInputError: a start that this world cannot begin from.
            LimitExceededError: the service has as many rollouts as it allows.
            UnavailableError: the service does not respond.
        """
        fields = {"world": world, "task": task, "seed": seed, "instruction": instruction}
        request = validate_fields(
            StartRequest, fields | {"action_kind": action_kind}, where="start"
        )
        observation, anchor, K_head = (None, None, None) if init is None else init
        start = RolloutStart(task, seed, instruction, action_kind, observation, anchor, K_head)
        query = _query(self.selector)
        reply = self._link.request(
            "POST",
            f"/v1/rollouts?{query}",
            body=encode_start(request, start),
            content_type=MSGPACK,
            accept=MSGPACK,
            headers={"dextouch-client": quote(self.name)} if self.name else None,
        )
        answer = decode_answer(reply.body, max_bytes=MAX_ANSWER_BYTES)
        if answer.origin is None:
            raise UnavailableError("start: the response has no anchor; is the service too old?")
        return Rollout(self._link, query, answer, answer.origin)

    def close(self) -> None:
        """Close the connection; rollouts stay at the service until closed or expired."""
        self._link.close()

    def __enter__(self) -> "RolloutClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Rollout:
    """One rollout at a service: the current observation, and the anchor of all actions.

    Attributes:
        observation: the newest; n steps, of which the last is now.
        anchor: absolute poses of step 0, which actions are relative to for the whole rollout.
        K_head: the head camera's matrix in pixels.
        info: its state.
        reported: numbers that the world reports about the newest chunk.
    """

    def __init__(
        self, link: HttpLink, query: str, answer: RolloutAnswer, origin: RolloutOrigin
    ) -> None:
        self._link = link
        self._query = query
        self.info = answer.rollout
        self.observation = answer.observation
        self.anchor = origin.anchor
        self.K_head = origin.K_head
        self.reported = answer.info

    @property
    def id(self) -> str:
        """Its id at the service."""
        return self.info.id

    def step(
        self,
        actions: np.ndarray,
        *,
        selector: ReturnSelector | None = None,
        validated: bool = False,
    ) -> Observation:
        """Advance by one action chunk, and return the observation of its K steps.

        Row i of `actions` [K, 67], K a multiple of the world's chunk, is the pose at step i+1 of
        the chunk, relative to the rollout's step 0. `selector` is of this chunk alone, None the
        client's; with `validated` they come from `check_actions`. If this raises UnavailableError,
        the same call may be made again: a chunk that the service already applied is not applied
        twice.

        Raises:
            EndedError: the world cannot continue this rollout, for the `reason` given; the last
                observation stays in `observation`.
        """
        checked = actions if validated else check_actions(actions, where=f"rollout {self.id}")
        query = self._query if selector is None else _query(selector)
        reply = self._link.request(
            "POST",
            f"/v1/rollouts/{self.id}/chunks/{self.info.next_chunk}?{query}",
            body=checked.astype("<f8").tobytes(),
            content_type=ACTIONS_TYPE,
            accept=MSGPACK,
            # For proxies that route by it.
            headers={"x-session-id": self.id},
        )
        answer = decode_answer(reply.body, max_bytes=MAX_ANSWER_BYTES)
        self.info, self.observation, self.reported = answer.rollout, answer.observation, answer.info
        return self.observation

    def fork(self, *, seed: int | None = None) -> "Rollout":
        """Branch at this step; a new seed gives the branch noise of its own."""
        body = ForkRequest(seed=seed).model_dump_json().encode()
        reply = self._link.request("POST", f"/v1/rollouts/{self.id}/fork", body=body)
        branch = copy(self)
        branch.info = _parsed(RolloutInfo, reply)
        return branch

    def close(self) -> None:
        """End the rollout at the service; an expired rollout counts as ended."""
        with suppress(NotFoundError):
            self._link.request("DELETE", f"/v1/rollouts/{self.id}")

    def __enter__(self) -> "Rollout":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # An exception in the block matters more than a failure to close the rollout.
        with nullcontext() if kind is None else suppress(DexTouchError):
            self.close()


def _query(selector: ReturnSelector) -> str:
    if not selector.tactile:
        raise InvalidInputError("selector: an Observation holds touch; expected tactile=True")
    names = () if selector.cameras is None else selector.cameras or ("",)
    cameras = [("cameras", name) for name in names]
    images = [("images", selector.images)] if selector.images != "raw" else []
    return urlencode([("steps", selector.steps), *cameras, *images])


def _parsed(model: type[ModelT], reply: Reply) -> ModelT:
    try:
        return model.model_validate_json(reply.body)
    except ValidationError as error:
        raise UnavailableError(
            f"answer: {first_problems(error)}; is a DexTouch service of this version there?"
        ) from error


@dataclass(frozen=True)
class PolicyStart:
    """Information that a policy gets before its first observation.

    `anchor` are the absolute poses of the rollout's step 0, which all actions are relative to;
    `seed` is for the policy's own random numbers.
    """

    task: str
    instruction: str
    seed: int
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@runtime_checkable
class Policy(Protocol):
    """Acts in any world: the calls and arrays are the same in all of them (docs/policies.md).

    A policy whose attribute `uses_images` is False gets no images after the first step, so that
    worlds need not render them. With `uses_images = "last"` it may get nothing but the last step of
    each chunk. `tasks` names those it supports; `python -m benchmarks evaluator` skips all others.
    """

    def reset(self, start: PolicyStart) -> None:
        """Reset all state for a new rollout."""
        ...

    def act(self, observation: Observation) -> Float64[np.ndarray, "steps 67"]:
        """The next action chunk, given the observations since the last call (the last step is now).

        Rows are poses and joint angles as commands, relative to the rollout's step 0; their
        number is a multiple of the world's chunk.
        """
        ...
