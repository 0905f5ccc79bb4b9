"""Options in; our store and LeRobotDataset v3, measured in turns in one process, out.

`make bench-lerobot` runs it in an environment of its own: `bench.py --help` tells the options.
"""

import sys

from benchmarks.command import main
from benchmarks.stages import STAGES, StageEntry

STAGES["lerobot"] = StageEntry(
    "lerobot_stage",
    "write and read a take: ours, LeRobotDataset v3",
    "Writes the take of `python -m benchmarks store` with our store and with LeRobotDataset v3 "
    "(its streaming writer, the same tuned for speed, and its default writer) in turns, and reads "
    "random windows of 17 images of one camera with touch and actions: through LeRobot's own "
    "items, and through its video decoder and table directly.",
)

if __name__ == "__main__":
    sys.exit(main(["lerobot", *sys.argv[1:]]))
