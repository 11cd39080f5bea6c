"""Tests that pages, alerts and the dashboards of Grafana match the tables of the code."""

import json
import re
from pathlib import Path

import pytest

from service.metrics import METRICS
from tools.pages import written_pages

DOCS = Path(__file__).resolve().parents[1] / "docs"
FOLDER = DOCS.parent / "deploy/helm/sceneprint/dashboards"
DASHBOARDS = {path.stem: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}


def families():
    """Return the labels of each metric."""
    return {f"sceneprint_{name}": set(family.labels) for name, family in METRICS.items()}


def queried(expression):
    """Names of metrics in an expression of Prometheus, with the labels that they are picked by."""
    return [
        (name, set(re.findall(r"(\w+)\s*(?:=~|!=|!~|=)", picked)))
        for name, picked in re.findall(r"(sceneprint_\w+)(\{[^}]*\})?", expression)
    ]


def check(expression):
    metrics = families()
    result = queried(expression)
    by = set(re.findall(r"\w+", " ".join(re.findall(r"\bby \(([^)]*)\)", expression))))
    labels = set()
    for name, picked in result:
        family = re.sub(r"_(bucket|sum|count)$", "", name)
        assert family in metrics, expression
        if family != name:
            assert name not in metrics
            labels.add("le")
        assert picked - {"job"} <= metrics[family], expression
        labels |= metrics[family]
    assert by <= labels, expression


@pytest.mark.parametrize("path", written_pages(), ids=lambda path: path.name)
def test_tables_of_pages_are_those_of_the_code(path):
    assert path.read_text() == written_pages()[path], "run: make goldens"


def test_alerts_query_existing_metrics():
    page = (DOCS / "operations.md").read_text()
    alerts = [
        text for text in re.findall(r"^\| `([^`]*sceneprint_[^`]*)` \|", page, re.M) if " " in text
    ]
    assert len(alerts) >= 9
    for alert in alerts:
        check(alert)


def expressions(dashboard):
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def test_dashboards_ask_for_what_there_is():
    named = set()
    for expression in (e for each in DASHBOARDS.values() for e in expressions(each)):
        assert queried(expression), expression
        check(expression)
        named |= {re.sub(r"_(bucket|sum|count)$", "", name) for name, _ in queried(expression)}
    assert named == set(families())  # all is shown somewhere
