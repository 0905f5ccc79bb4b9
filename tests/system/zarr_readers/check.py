"""Reads an episode in environments that have a Zarr reader but not this package.

`check.py` makes an environment for each of READERS with each `--python`, below `--folder`, and runs
`read.py` in it. Ends with 1 if one of them cannot list and read everything without a warning.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from dextouch.episodes import EpisodeStore
from tests.unit.episodes.conftest import episode_of
from tests.unit.episodes.test_interop import READERS as READ
from tests.unit.episodes.test_interop import write_truth

# Oldest, last of 3.0, and the newest of each that the Python takes.
READERS = {
    "zarr-3.0.0": ["zarr==3.0.0"],
    "zarr-3.0.10": ["zarr==3.0.10"],
    "newest": ["zarr", "xarray", "pandas", "tensorstore"],
}
# To decode images with.
DECODERS = ["numpy", "pillow", "av"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", action="append", help="of the environments; repeatable")
    parser.add_argument("--folder", type=Path, default=Path(".venv-zarr"))
    options = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.npz"
        group = write_truth(episode_of(), EpisodeStore(Path(folder) / "store"), truth)
        for python in options.python or [sys.executable]:
            for name, packages in READERS.items():
                venv = options.folder / f"{Path(python).name}-{name}"
                others = {"xarray", "tensorstore"} & set(packages)
                run = [venv / "bin" / "python", READ, group, truth, *sorted(others)]
                complete = venv / ".complete"
                if not complete.exists():
                    subprocess.run([python, "-m", "venv", venv], check=True)
                    pip = [venv / "bin" / "pip", "install", "--quiet"]
                    subprocess.run([*pip, *packages, *DECODERS], check=True)
                    complete.touch()
                failed += subprocess.run(run, check=False).returncode != 0
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
