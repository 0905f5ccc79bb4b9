"""What git tracks: no builds, no data, no links, which some checkouts have as text."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAX_BYTES = 1_000_000
# Weights, files of other projects and recordings of reference are large on purpose.
LARGE = ("services/*/pretrained/*", "**/static/vendor/*", "tests/golden/**/*")


@pytest.fixture(scope="module")
def tracked():
    """Modes of the tracked files, by path."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout of git")
    listed = subprocess.run(
        ["git", "ls-files", "--stage", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    rows = (line.partition("\t") for line in listed.stdout.split("\0") if line)
    return {Path(path): state.split()[0] for state, _, path in rows}


def test_no_file_is_large_but_those_that_are_meant(tracked):
    meant = {path.relative_to(ROOT) for pattern in LARGE for path in ROOT.glob(pattern)}
    sizes = {path: (ROOT / path).lstat().st_size for path in tracked if (ROOT / path).exists()}
    assert [
        str(path) for path, size in sizes.items() if size > MAX_BYTES and path not in meant
    ] == []


def test_nothing_is_a_link(tracked):
    assert [str(path) for path, mode in tracked.items() if mode == "120000"] == []


def test_the_wheel_of_the_weights_has_the_licence():
    assert (ROOT / "weights/LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
