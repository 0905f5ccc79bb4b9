"""Policies of a study."""

import hashlib
from collections.abc import Callable
from copy import copy
from pathlib import Path

from dextouch.clients import Policy
from dextouch.episodes import EpisodeStore, select_episodes
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy
from services.evaluation.policies.colour_servo import ColourServo
from services.evaluation.policies.hold import HoldPolicy
from services.evaluation.policies.outside import PolicySource
from services.evaluation.policies.replay import ReplayPolicy
from services.evaluation.settings import DEFAULT_POLICY
from services.evaluation.studies.definition import PolicyChoice, StudyDefinition


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


class PolicyFactory:
    """Creates the policies of a study; data that all share is read once.

    Args:
        definition: of the study.
        demonstrator: creates the policy of a `script`.

    Raises:
        UnknownNameError: a script or task that the twin does not know.
        NotFoundError, CorruptDataError: a file or store that cannot be read.
    """

    def __init__(
        self, definition: StudyDefinition, demonstrator: Callable[[str], ReplayPolicy]
    ) -> None:
        self._definition = definition
        self._replays: dict[str, ReplayPolicy] = {}
        for name, choice in definition.policies.items():
            if choice.script is not None:
                self._replays[name] = demonstrator(choice.script)
            if choice.replay is not None:
                stores, tasks = [EpisodeStore(choice.replay)], definition.tasks
                found = select_episodes(stores, domain="robot", tasks=tasks, origins=())
                self._replays[name] = ReplayPolicy.of(found)

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

    def digests(self) -> dict[str, str]:
        """Digests of checkpoints and of replayed episodes, which do not cover factories' code."""
        return {
            f"policy {name}": digest
            for name, choice in self._definition.policies.items()
            if (digest := self._digest(choice)) is not None
        }

    def _digest(self, choice: PolicyChoice) -> str | None:
        if choice.builtin == "behaviour-cloning":
            return file_digest(choice.checkpoint or DEFAULT_POLICY)
        if choice.replay is None:
            return None
        store = EpisodeStore(choice.replay)
        content = [f"{one} {store.open(one).content_sha256}" for one in sorted(store.list())]
        return hashlib.sha256("\n".join(content).encode()).hexdigest()

    def _load(self, name: str, choice: PolicyChoice) -> Policy:
        if choice.factory is not None:
            return PolicySource.parse(f"{name}={choice.factory}").load(choice.arguments)
        if name in self._replays:
            return copy(self._replays[name])
        if choice.builtin == "hold":
            return HoldPolicy()
        if choice.builtin == "colour-servo":
            return ColourServo()
        return BehaviourCloningPolicy.load(choice.checkpoint or DEFAULT_POLICY)
