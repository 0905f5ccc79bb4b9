"""True endings near the border of success, on which the shipped probe is tested.

`true_endings.npz` holds the last image and the last three touches of 108 episodes of the twin,
none of which was trained on. Make it anew, when the twin's pictures change, with

    dextouch train data --store endings --ladder --first 30000 --count 54
    python -m tests.unit.evaluation.true_endings endings
"""

import sys
from pathlib import Path

import numpy as np

from dextouch.episodes import EpisodeStore
from services.evaluation.endings import NUM_SEEN_STEPS, Ending, read_ending_episodes

FILE = Path(__file__).with_suffix(".npz")


def read(task: str) -> tuple[list[Ending], np.ndarray]:
    """The endings of a task, and which of them the twin calls successes."""
    with np.load(FILE) as kept:
        chosen = kept["task"] == task
        endings = [
            Ending(np.repeat(image[None], NUM_SEEN_STEPS, axis=0), tactile_kpa, task)
            for image, tactile_kpa in zip(
                kept["image"][chosen], kept["tactile_kpa"][chosen], strict=True
            )
        ]
        return endings, kept["success"][chosen]


def main(store: str) -> None:
    """Keep the endings of a store."""
    episodes = read_ending_episodes(EpisodeStore(store))
    np.savez_compressed(
        FILE,
        task=[e.task for e in episodes],
        scene=[e.scene for e in episodes],
        success=[e.success for e in episodes],
        image=[e.final.images[-1] for e in episodes if e.final.images is not None],
        tactile_kpa=[e.final.tactile_kpa for e in episodes],
    )


if __name__ == "__main__":
    main(sys.argv[1])
