"""Worlds and policies of a study: connections, processes that serve worlds, and training data."""

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass

from dextouch.clients import Policy, RolloutClient
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.serving import ChildProcess
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.hold import HoldPolicy
from services.evaluation.policies.outside import PolicySource
from services.evaluation.policies.replay import ReplayPolicy
from services.evaluation.robot_episodes import robot_episodes
from services.evaluation.scores import REAL
from services.evaluation.settings import DEFAULT_POLICY
from services.evaluation.studies.definition import PolicyChoice, StudyDefinition, WorldChoice
from services.evaluation.study_worlds import StudyWorlds, WorldAddress
from services.twin.scripted_actions import scripted_actions
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.world_model.checkpoints import default_checkpoint
from services.world_model.state_checkpoints import is_state_checkpoint, read_state_checkpoint

_CHILD = "services.cli.study.world_process"


@dataclass(frozen=True)
class Address:
    """Where a world is served."""

    url: str
    world: str
    api_key: str | None = None


@contextmanager
def served_worlds(definition: StudyDefinition) -> Iterator[dict[str, Address]]:
    """Addresses of all worlds by name; those without a URL are served until the block ends.

    Raises:
        UnavailableError: a process could not serve its world; its messages are above.
        InvalidInputError: a checkpoint that cannot be served, or a key's variable is not set.
    """
    choices = {REAL: definition.real, **definition.imagined}
    with ExitStack() as children:
        started: dict[str, ChildProcess] = {}
        for name, choice in choices.items():
            if choice.url is None:
                kind = "builtin" if choice.builtin else "checkpoint"
                value = choice.builtin or str(choice.checkpoint)
                started[name] = ChildProcess(
                    _CHILD,
                    kind,
                    value,
                    str(definition.in_flight),
                    environment={"OMP_NUM_THREADS": "1"},
                )
                children.callback(started[name].close)
        served = {name: child.receive() for name, child in started.items()}
        for name, answer in served.items():
            if "refused" in answer:
                raise InvalidInputError(f"world {name!r}: {answer['refused']}")
        yield {
            name: Address(**served[name]) if name in served else _address(name, choice)
            for name, choice in choices.items()
        }


def _address(name: str, choice: WorldChoice) -> Address:
    key, variable = None, choice.api_key_variable
    if variable is not None and (key := os.environ.get(variable)) is None:
        raise InvalidInputError(
            f"world {name!r}: its API key is expected in the variable {variable}, which is not set"
        )
    return Address(str(choice.url), str(choice.world), key)


def connect(addresses: Mapping[str, Address], connections: ExitStack) -> StudyWorlds:
    """Open connections to all worlds and ask what they are."""
    opened = {
        name: WorldAddress(
            connections.enter_context(RolloutClient(one.url, one.api_key)), one.world
        )
        for name, one in addresses.items()
    }
    real = opened.pop(REAL)
    return StudyWorlds.ask(real, opened)


class PolicyFactory:
    """Creates the policies of a study; data that all share is read once.

    Raises:
        UnknownNameError: a script or task that the twin does not know.
        NotFoundError, CorruptDataError: a file or store that cannot be read.
    """

    def __init__(self, definition: StudyDefinition) -> None:
        self._definition = definition
        self._replays: dict[str, ReplayPolicy] = {}
        for name, choice in definition.policies.items():
            if choice.script is not None:
                self._replays[name] = _scripted(definition, choice.script)
            if choice.replay is not None:
                store = EpisodeStore(choice.replay)
                self._replays[name] = ReplayPolicy.of(
                    robot_episodes([store], tasks=definition.tasks)
                )

    def load(self) -> dict[str, Policy]:
        """All policies by name, each with a state of its own."""
        return {name: self._load(name, one) for name, one in self._definition.policies.items()}

    def training_starts(self) -> dict[str, tuple[str, ...]]:
        """Digests of training starts of bundled and cloned policies, by description."""
        return {
            f"policy {name!r}": BehaviourCloningPolicy.load(
                choice.checkpoint or DEFAULT_POLICY
            ).metadata.training_starts
            for name, choice in self._definition.policies.items()
            if choice.builtin == "behaviour-cloning"
        }

    def _load(self, name: str, choice: PolicyChoice) -> Policy:
        if choice.factory is not None:
            return PolicySource.parse(f"{name}={choice.factory}").load(choice.arguments)
        if name in self._replays:
            return copy(self._replays[name])
        if choice.builtin == "hold":
            return HoldPolicy()
        return BehaviourCloningPolicy.load(choice.checkpoint or DEFAULT_POLICY)


def refuse_training_seeds(definition: StudyDefinition) -> None:
    """Refuse starts whose task and seed a world model was trained on.

    Content digests miss them where image size or simulator changed since.

    Raises:
        ConflictError: a start was trained on.
        NotFoundError: a checkpoint is missing.
    """
    for name, choice in definition.imagined.items():
        path = default_checkpoint() if choice.builtin == "world-model" else choice.checkpoint
        if path is None:
            continue
        if not path.is_file():
            raise NotFoundError(
                f"world {name!r}: no checkpoint {path}; train it, or check the path"
            )
        if not is_state_checkpoint(path):
            continue
        metadata = read_state_checkpoint(path).metadata
        for task in definition.tasks:
            trained = [seed for seed in definition.seeds if metadata.may_have_seen(task, seed)]
            if trained:
                low, high = metadata.training_seeds[task]
                raise ConflictError(
                    f"world {name!r}: trained on task {task!r} with seeds {low} … {high}, and the "
                    f"study starts from seed {trained[0]}; choose another first_seed"
                )


def _scripted(definition: StudyDefinition, script: str) -> ReplayPolicy:
    """The twin's demonstrator, planned for all starts without simulation."""
    stages = {task: Stage(task, "robot", TwinSettings()) for task in definition.tasks}
    return ReplayPolicy(
        {
            (task, seed): scripted_actions(stage, seed, script)
            for task, stage in stages.items()
            for seed in definition.seeds
        }
    )
