"""Rollouts of a policy in the twin as episodes, for `dextouch train data --policy`."""

import hashlib
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from dextouch.clients import Policy, PolicyStart
from dextouch.schemas import RolloutStart
from services.evaluation.policies.asking import action_chunk, ask
from services.evaluation.policies.outside import PolicySource
from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.take_options import PlayedActions
from services.twin.world import TwinWorld

CAMERAS = ("camera_head",)
_MAX_LABEL = 32


@dataclass(frozen=True)
class PolicyChoice:
    """A policy's address, as in `dextouch evaluate`, and its factory's arguments as JSON."""

    address: str
    arguments: str = "{}"

    @classmethod
    def parse(cls, address: str, arguments: Mapping[str, Any]) -> "PolicyChoice":
        """Validate the address and create a choice.

        Raises:
            InvalidInputError: an invalid address.
        """
        PolicySource.parse(address)
        return cls(address, json.dumps(arguments, sort_keys=True))

    @property
    def label(self) -> str:
        """Name used in episode ids; it depends on the address and the arguments."""
        name = re.sub(r"[^a-z0-9]+", "_", PolicySource.parse(self.address).name.lower()).strip("_")
        digest = hashlib.sha256(f"{self.address} {self.arguments}".encode()).hexdigest()
        return f"{name[:_MAX_LABEL]}_{digest[:6]}"


@lru_cache(maxsize=1)
def _world() -> TwinWorld:
    return TwinWorld(TwinSettings(cameras=CAMERAS))


@lru_cache(maxsize=2)
def _policy(choice: PolicyChoice) -> Policy:
    return PolicySource.parse(choice.address).load(json.loads(choice.arguments))


def played_by(choice: PolicyChoice, stage: Stage, seed: int) -> PlayedActions:
    """Closed-loop actions of a policy in the twin, from the start of a seed.

    The twin is deterministic, so that an episode with these actions is the rollout.

    Raises:
        InvalidInputError, ShapeError, NonFiniteError: the policy failed; includes its traceback.
    """
    world, policy, task = _world(), _policy(choice), stage.task
    start = RolloutStart(task=task.name, seed=seed, instruction=task.instruction)
    begun = world.reset(start)
    state, seen = begun.state, begun.observation
    where = f"policy {choice.address!r}, task {task.name!r}, seed {seed}"
    policy_start = PolicyStart(task.name, task.instruction, seed, begun.anchor, begun.K_head)
    ask(policy.reset, policy_start, where=f"{where}: reset")
    # Row 0 is the start.
    rows = [seen.action_reached[:1]]
    while (left := NUM_GRID_STEPS - sum(map(len, rows))) > 0:
        chunk = action_chunk(ask(policy.act, seen, where=f"{where}: act"), world.description,
                             where=f"{where}: act")[:left]  # fmt: skip
        stepped = world.step(state, chunk, seed=0)
        state, seen = stepped.state, stepped.observation
        rows.append(chunk)
    command = (
        f"dextouch train data --policy {shlex.quote(choice.address)} --policy-arguments "
        f"{shlex.quote(choice.arguments)} --tasks {task.name} --first {seed} --count 1"
    )
    return PlayedActions(choice.label, np.concatenate(rows), command)
