"""Tests that need a program are skipped without it, and fail where `.ci/run` has installed it."""

import re
from pathlib import Path

import pytest

from tests.contracts.redis_server import running_redis
from tests.programs import REQUIRED_VARIABLE, needed_program

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _no_programs(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(REQUIRED_VARIABLE, raising=False)


def test_without_a_program_a_test_is_skipped():
    with pytest.raises(pytest.skip.Exception, match="no haproxy on the PATH: apt-get install hap"):
        needed_program("haproxy", package="haproxy")


@pytest.mark.parametrize(("value", "outcome"), [("1", pytest.fail), ("0", pytest.skip)])
def test_where_all_are_required_it_fails(value, outcome, monkeypatch, tmp_path):
    monkeypatch.setenv(REQUIRED_VARIABLE, value)
    with (
        pytest.raises(outcome.Exception, match="no redis-server on the PATH"),
        running_redis(tmp_path),
    ):
        pass


def test_the_checks_of_a_release_require_what_they_install():
    script = (ROOT / ".ci/run").read_text()
    assert re.search(rf"^export {REQUIRED_VARIABLE}=1$", script, re.MULTILINE)


def test_no_test_decides_for_itself_to_skip_without_a_service():
    own_way = re.compile(r'which\("(redis-server|haproxy|chromium|promtool|nginx|caddy|amtool)"\)')
    found = [
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("*.py")
        if own_way.search(path.read_text(encoding="utf-8"))
    ]
    assert found == []
