"""Queue of rollouts to rate: blinded, balanced, in a different order for each rater."""

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from dextouch.errors import NotFoundError
from services.evaluation.rating.marks import FIRST, REPEAT, MarkLog, StoredMark


@dataclass(frozen=True)
class RatedRollout:
    """A rollout as shown to raters, without the policy and the world.

    `token` stands for its episode in addresses, since ids of imagined episodes name their world.
    """

    token: str
    episode_id: str
    task: str
    instruction: str
    num_steps: int
    rate_hz: float


@dataclass(frozen=True)
class Assignment:
    """The rollout that a rater should rate next, and how many of theirs are done."""

    rollout: RatedRollout
    presentation: int
    num_done: int
    num_open: int


def token_of(episode_id: str) -> str:
    """Opaque token that stands for an episode's id in addresses."""
    return hashlib.sha256(f"rated rollout {episode_id}".encode()).hexdigest()[:20]


class RatingQueue:
    """Assigns rollouts to raters.

    Rollouts with the fewest raters come first; ties are broken by an order specific to the rater.
    After every `1 / repeat_share` rollouts a rater is shown one again that they rated at least
    `repeat_gap` marks ago. A repeated request without a mark returns the same rollout.

    Args:
        rollouts: to be rated.
        marks: those given so far.
        raters_per_rollout: number of people who rate each rollout.
        repeat_share: share of rollouts that a rater sees twice.
        repeat_gap: marks between the two.
    """

    def __init__(
        self,
        rollouts: Iterable[RatedRollout],
        marks: MarkLog,
        *,
        raters_per_rollout: int = 5,
        repeat_share: float = 0.08,
        repeat_gap: int = 10,
    ) -> None:
        self._rollouts = {one.token: one for one in rollouts}
        self._marks = marks
        self._raters_per_rollout = raters_per_rollout
        self._repeat_share = repeat_share
        self._repeat_gap = repeat_gap

    def rollout(self, token: str) -> RatedRollout:
        """The rollout behind an address.

        Raises:
            NotFoundError: no rollout of this queue has the token.
        """
        if token not in self._rollouts:
            raise NotFoundError(f"rollout {token!r}: not found among those to rate")
        return self._rollouts[token]

    def next(self, rater: str) -> Assignment | None:
        """The rollout that a rater should rate next; None when nothing is left."""
        latest = self._marks.latest()
        mine = sorted(
            (stored for (who, _, _), stored in latest.items() if who == rater),
            key=lambda stored: stored.number,
        )
        seen = [one.mark.episode_id for one in mine if one.mark.presentation == FIRST]
        raters = Counter(
            episode_id
            for (_, episode_id, presentation), stored in latest.items()
            if presentation == FIRST and stored.mark.kind == "human"
        )
        waiting = [
            one
            for one in self._rollouts.values()
            if one.episode_id not in seen and raters[one.episode_id] < self._raters_per_rollout
        ]
        repeated = self._repeat(rater, mine, len(seen))
        if repeated is not None:
            return Assignment(repeated, REPEAT, len(seen), len(waiting))
        if not waiting:
            return None
        chosen = min(
            waiting, key=lambda one: (raters[one.episode_id], _order(rater, one.episode_id))
        )
        return Assignment(chosen, FIRST, len(seen), len(waiting))

    def _repeat(self, rater: str, mine: list[StoredMark], num_seen: int) -> RatedRollout | None:
        repeats = {one.mark.episode_id for one in mine if one.mark.presentation == REPEAT}
        if len(repeats) >= int(num_seen * self._repeat_share):
            return None
        old = [one.mark.episode_id for one in mine[: max(0, len(mine) - self._repeat_gap)]]
        known = [self._rollouts[t] for t in map(token_of, old) if t in self._rollouts]
        fresh = [one for one in known if one.episode_id not in repeats]
        return min(fresh, key=lambda one: _order(rater, one.episode_id), default=None)


def _order(rater: str, episode_id: str) -> str:
    return hashlib.sha256(f"{rater}/{episode_id}".encode()).hexdigest()
