"""Provenance of a model: the sets of episodes that it was trained and evaluated on."""

from collections.abc import Iterable

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain


class TrainingSet(FrozenModel):
    """Episodes of one domain that a model was trained on, or that it was evaluated on (held out).

    `tasks` has the number of episodes of each task, `data_hash` is that of the episodes
    (`dextouch.episodes`). `window_share` is the share of windows from the set, None where it
    follows from the number of episodes. `checkpoint` is the digest of the ancestor that was trained
    on the set, None for the checkpoint's own training.
    """

    domain: Domain
    heldout: bool = False
    tasks: dict[str, int]
    data_hash: str
    window_share: float | None = None
    checkpoint: str | None = None


def learned_tasks(sets: Iterable[TrainingSet]) -> set[str]:
    """Tasks of the sets that were trained on."""
    return {task for one in sets if not one.heldout for task in one.tasks}
