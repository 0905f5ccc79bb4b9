"""Endings of demonstrations in memory, as if they were read from a store."""

from services.evaluation.endings import (
    EARLY_ENDS,
    MIDDLE_ENDS,
    NUM_SEEN_STEPS,
    Ending,
    EndingEpisode,
)
from tests.unit.evaluation.toy import Demonstration


def final_ending(item: Demonstration, end: int) -> Ending:
    """The three steps of an episode up to and including step `end`."""
    steps = slice(end - NUM_SEEN_STEPS + 1, end + 1)
    return Ending(item.images[steps], item.tactile_kpa[steps], item.task)


def ending_episode(item: Demonstration) -> EndingEpisode:
    """All endings that a stored episode would be cut at."""
    last = item.num_steps - 1
    steps = {last, last - 1, *EARLY_ENDS, *MIDDLE_ENDS} & set(range(2, item.num_steps))
    return EndingEpisode(
        item.episode_id,
        item.task,
        item.instruction,
        item.scene,
        item.success,
        item.start_digest,
        last,
        {step: final_ending(item, step) for step in sorted(steps)},
        content_sha256=item.episode_id,
    )
