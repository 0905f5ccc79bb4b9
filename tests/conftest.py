"""Under tests, and only there, every annotated array shape is checked at run time."""

import gc
import logging
import os
from pathlib import Path

import pytest
import structlog
from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")
# On the emulated processor of `make vm` these checks would take minutes.
CHECKS_SHAPES = "DEXTOUCH_VM_GUEST" not in os.environ
if CHECKS_SHAPES:
    from tests import shape_checks

    shape_checks.install(["dextouch", "services", "benchmarks"])

# The same examples in every run: a change is red because of the change, not because of the day.
# No deadline: machines that are busy with other things are slow, not wrong.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.load_profile("steady")

ROOT = Path(__file__).parents[1]
# Whole services, pages and benchmarks: all of their tests take seconds.
LONG_FOLDERS = frozenset({"benchmarks", "browser", "integration", "system"})
NOT_LONG = "not long and "
OTHER_MARKS = ("slow", "gpu", "hardware", "vm", "containers")


def pytest_xdist_auto_num_workers() -> int:
    """One more worker than cores: many tests wait for processes, sockets and clocks."""
    return len(os.sched_getaffinity(0)) + 1


def pytest_runtest_setup() -> None:
    """Each test checks the shapes of its own first calls."""
    if CHECKS_SHAPES:
        shape_checks.begin_test()


def pytest_configure(config: pytest.Config) -> None:
    """Of paths that are named, the long tests are run, too."""
    if config.args_source is pytest.Config.ArgsSource.ARGS:
        config.option.markexpr = config.option.markexpr.replace(NOT_LONG, "")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """What is not run is not imported, either."""
    is_long = collection_path.parent == ROOT / "tests" and collection_path.name in LONG_FOLDERS
    return True if is_long and NOT_LONG in config.option.markexpr else None


def pytest_itemcollected(item: pytest.Item) -> None:
    """Tests of `LONG_FOLDERS` are long, but for those that have a mark of their own.

    Those may take any time.
    """
    is_in_folder = item.path.relative_to(ROOT / "tests").parts[0] in LONG_FOLDERS
    if any(item.get_closest_marker(name) for name in OTHER_MARKS):
        item.add_marker(pytest.mark.timeout(0))
    elif is_in_folder:
        item.add_marker("long")


def pytest_collection_finish() -> None:
    """All modules stay from here on, so that the garbage collector need not visit them again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _logging_is_put_back():
    """Commands and services configure logging for their process, which tests share."""
    from dextouch.serving.logs import QUIET  # not before the checks of shapes are installed

    root = logging.getLogger()
    loggers = [root, *(logging.getLogger(name) for name in (*QUIET, "uvicorn.error"))]
    before = [(one, list(one.handlers), list(one.filters), one.level) for one in loggers]
    yield
    for one, handlers, filters, level in before:
        one.handlers[:], one.filters[:] = handlers, filters
        one.setLevel(level)
    if structlog.is_configured():
        structlog.reset_defaults()
        structlog.contextvars.clear_contextvars()


def _shown_names() -> set[str]:
    return {path.name for path in ROOT.iterdir() if not path.name.startswith(".")}


@pytest.fixture(autouse=True, scope="session")
def _nothing_is_left_in_the_checkout():
    """Tests write into their own folders; what lands in the current one lands here."""
    before = _shown_names()
    yield
    left = sorted(_shown_names() - before)
    assert not left, f"tests left {', '.join(left)} in {ROOT}"
