"""Alerts and dashboards against the services: expressions parse and name what is exported."""

import asyncio
import json
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.programs import needed_program
from tests.unit.deploy.exported_metrics import exported_metrics

promql = pytest.importorskip("promql_parser", reason="pip install promql-parser (extra dev)")

ROOT = Path(__file__).parents[3]
PROMETHEUS = ROOT / "deploy/prometheus"
GRAFANA = ROOT / "deploy/grafana"
RULES = [
    rule
    for group in yaml.safe_load((PROMETHEUS / "rules.yml").read_text())["groups"]
    for rule in group["rules"]
]
DASHBOARDS = {
    path.stem: json.loads(path.read_text())
    for path in sorted((GRAFANA / "dashboards").glob("*.json"))
}
# Prometheus adds them to everything that it scrapes by deploy/prometheus/prometheus.yml.
TARGET_LABELS = {"job", "instance", "service"}
OF_PROMETHEUS = {
    "up": set(),
    "ALERTS": {"alertname", "alertstate", "severity", "stream", "device"},
}
LABEL_VALUES = re.compile(r"label_values\((.+), (\w+)\)")
# Base units, counted things, and states.
UNITS = {"seconds", "bytes", "ratio", "hz", "meters", "info", "state", "level", "connected"}
UNITS |= {"chunks", "rollouts", "samples", "takes", "jobs", "items", "sessions", "websockets"}
UNITS |= {"uploads", "limit", "draining", "resets", "failed", "frozen", "blurred"}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Label names by name of everything that can be asked for."""
    recorded = {rule["record"]: set() for rule in RULES if "record" in rule}
    found = asyncio.run(exported_metrics(tmp_path_factory.mktemp("services")))
    return found | OF_PROMETHEUS | recorded | {name: {"service"} for name in recorded}


def plain(expression):
    """An expression of Grafana with its variables filled in."""
    for name, value in {"$__rate_interval": "1m", "$__interval": "1m", "$__range": "1h"}.items():
        expression = expression.replace(name, value)
    return re.sub(r"\$\{?\w+\}?", ".*", expression)


def expressions():
    """Every expression of rules and dashboards, with the place where it stands."""
    for rule in RULES:
        yield rule.get("alert", rule.get("record")), rule["expr"]
    for name, board in DASHBOARDS.items():
        for panel in board["panels"]:
            for target in panel["targets"]:
                yield f"{name}: {panel['title']}", plain(target["expr"])
        for annotation in board["annotations"]["list"]:
            yield f"{name}: annotation {annotation['name']}", plain(annotation["expr"])
        for variable in board["templating"]["list"]:
            metric, label = LABEL_VALUES.fullmatch(variable["query"]["query"]).groups()
            yield f"{name}: variable {variable['name']}", f"sum by ({label}) ({plain(metric)})"


def selectors(node):
    """Selectors of an expression, at any depth."""
    if isinstance(node, promql.VectorSelector):
        yield node
    for name in ("expr", "lhs", "rhs", "vector_selector", "param"):
        if isinstance(below := getattr(node, name, None), promql.Expr):
            yield from selectors(below)
    for below in getattr(node, "args", None) or ():
        yield from selectors(below)


def groupings(node):
    """Label names by which an expression groups, each with the node that is grouped."""
    modifier = getattr(node, "modifier", None)
    if isinstance(node, promql.AggregateExpr) and modifier is not None:
        yield set(modifier.labels), node.expr
    for name in ("expr", "lhs", "rhs", "param"):
        if isinstance(below := getattr(node, name, None), promql.Expr):
            yield from groupings(below)
    for below in getattr(node, "args", None) or ():
        yield from groupings(below)


ALL = list(expressions())


def test_all_files_are_here():
    assert set(DASHBOARDS) == {"fleet", "station", "store_and_alignment", "rollouts"}
    assert len(ALL) > 80


@pytest.mark.long
@pytest.mark.parametrize(("place", "expression"), ALL, ids=[place for place, _ in ALL])
def test_an_expression_asks_for_what_is_exported(place, expression, exported):
    parsed = promql.parse(expression)
    found = list(selectors(parsed))
    assert found, place
    for selector in found:
        assert selector.name in exported, f"{place}: {selector.name} is not exported"
        known = exported[selector.name] | TARGET_LABELS
        for matcher in selector.matchers.matchers:
            assert matcher.name in known, f"{place}: {selector.name} has no label {matcher.name}"
    for labels, below in groupings(parsed):
        for selector in selectors(below):
            known = exported[selector.name] | TARGET_LABELS
            assert labels <= known, f"{place}: {selector.name} has no {labels - known}"


def test_a_legend_uses_labels_that_are_left(exported):
    for name, board in DASHBOARDS.items():
        for panel in board["panels"]:
            for target in panel["targets"]:
                parsed = promql.parse(plain(target["expr"]))
                grouped = next(groupings(parsed), None)
                known = TARGET_LABELS.union(*(exported[one.name] for one in selectors(parsed)))
                left = known if grouped is None else grouped[0]
                wanted = set(re.findall(r"{{(\w+)}}", target["legendFormat"]))
                assert wanted <= left, f"{name}: {panel['title']}: {wanted - left}"


def test_names_say_their_unit(exported):
    ours = {name for name in exported if name.startswith("dextouch_")}
    assert len(ours) > 90
    for name in ours:
        base = re.sub(r"_(bucket|sum|count|total)$", "", name)
        is_counter = name.endswith(("_total", "_created"))
        assert is_counter or base.rpartition("_")[2] in UNITS, f"{name}: which unit?"


def test_dashboards_name_the_source_that_is_provided():
    source = yaml.safe_load((GRAFANA / "provisioning/datasources/prometheus.yml").read_text())
    (provided,) = source["datasources"]
    for board in DASHBOARDS.values():
        assert set(re.findall(r'"uid": "(\w+)"', json.dumps(board["panels"]))) == {provided["uid"]}
    uids = [board["uid"] for board in DASHBOARDS.values()]
    assert len(set(uids)) == len(uids)


def test_panels_do_not_overlap():
    for name, board in DASHBOARDS.items():
        taken = set()
        for panel in board["panels"]:
            at = panel["gridPos"]
            cells = {
                (x, y)
                for x in range(at["x"], at["x"] + at["w"])
                for y in range(at["y"], at["y"] + at["h"])
            }
            assert not taken & cells, f"{name}: {panel['title']}"
            assert at["x"] + at["w"] <= 24
            taken |= cells


def test_every_alert_has_a_unit_test():
    tests = yaml.safe_load(Path(__file__).with_name("rules_test.yml").read_text())["tests"]
    fired = {
        case["alertname"]
        for test in tests
        for case in test.get("alert_rule_test", ())
        if case["exp_alerts"]
    }
    # Its value is an extrapolation, so that the test counts ALERTS.
    counted = {"AlignmentsFail"}
    assert {rule["alert"] for rule in RULES if "alert" in rule} == fired | counted


@pytest.fixture(scope="module")
def promtool():
    return needed_program("promtool", package="prometheus")


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "config", "deploy/prometheus/prometheus.yml"),
        ("check", "rules", "deploy/prometheus/rules.yml"),
        ("test", "rules", "tests/unit/deploy/rules_test.yml"),
    ],
)
def test_promtool_agrees(arguments, promtool):
    done = subprocess.run(
        [promtool, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.long
def test_a_wrong_limit_fails_the_unit_tests(tmp_path, promtool):
    rules = (PROMETHEUS / "rules.yml").read_text()
    (tmp_path / "rules.yml").write_text(
        rules.replace("sample_age_seconds > 2", "sample_age_seconds > 1")
    )
    tests = Path(__file__).with_name("rules_test.yml").read_text()
    path = tmp_path / "rules_test.yml"
    path.write_text(tests.replace("../../../deploy/prometheus/rules.yml", "rules.yml"))
    done = subprocess.run([promtool, "test", "rules", str(path)], capture_output=True, check=False)
    assert done.returncode != 0


@pytest.mark.parametrize(
    ("labels", "receiver"),
    [(("severity=page", "service=episode_store"), "page"), (("severity=ticket",), "ticket")],
)
def test_alerts_reach_their_receivers(labels, receiver):
    amtool = needed_program("amtool", package="prometheus-alertmanager")
    config = str(PROMETHEUS / "alertmanager.yml")
    checked = subprocess.run([amtool, "check-config", config], capture_output=True, check=False)
    assert checked.returncode == 0, checked.stderr
    words = [amtool, "config", "routes", "test", f"--config.file={config}", *labels]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, [receiver])
    assert {rule["labels"]["severity"] for rule in RULES if "alert" in rule} == {"page", "ticket"}


@pytest.mark.long
def test_the_documented_block_connects_prometheus_to_alertmanager(promtool, tmp_path):
    text = (ROOT / "docs/operations.md").read_text()
    (block,) = re.findall(r"^alerting:\n(?:  .*\n)+", text, re.MULTILINE)
    for name in ("prometheus.yml", "rules.yml"):
        (tmp_path / name).write_text((PROMETHEUS / name).read_text())
    with (tmp_path / "prometheus.yml").open("a") as file:
        file.write(block)
    words = [promtool, "check", "config", str(tmp_path / "prometheus.yml")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load(block)["alerting"]["alertmanagers"]
