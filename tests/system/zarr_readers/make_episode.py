"""Writes the episode, and what its arrays hold, that `read.py` reads: `make_episode.py FOLDER`."""

import sys
from pathlib import Path

from dextouch.episodes import EpisodeStore
from tests.unit.episodes.conftest import episode_of
from tests.unit.episodes.test_interop import write_truth

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    write_truth(episode_of(), EpisodeStore(folder), folder / "truth.npz")
