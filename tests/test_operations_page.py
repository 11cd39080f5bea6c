"""Tests that docs/operations.md, docs/settings.md and the dashboard match the code."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, get_args

import pytest

from sceneprint.cli import parser
from sceneprint.settings import Settings
from sceneprint_client.api import AnswerStatus, FrameState, JobState
from sceneprint_client.api.admin import KINDS, MISSED
from service.metrics import Metrics
from tools.settings_page import settings_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "operations.md").read_text()
FOLDER = DOCS.parent / "deploy/helm/sceneprint/dashboards"
DASHBOARDS = {path.stem: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}


def section(title: str) -> str:
    """A section of the page, without those after it."""
    (found,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    return str(found)


def rows(text: str) -> dict[str, list[str]]:
    """Rows of its tables by the first cell's code, with the other cells."""
    found = re.findall(r"^\| `([^`]+)` \|(.*)\|$", text, re.MULTILINE)
    return {name: [cell.strip() for cell in rest.split("|")] for name, rest in found}


def families() -> dict[str, set[str]]:
    """Names of all that is told to Prometheus, with their labels."""
    found: dict[str, set[str]] = {}
    metrics = Metrics()
    for collector in metrics.registry._collector_to_names:  # also those without data
        labels = set(getattr(collector, "_labelnames", ()))
        for family in collector.describe():
            name = family.name + ("_total" if family.type == "counter" else "")
            found[name] = labels
    return found


def queried(expression: str) -> list[tuple[str, set[str]]]:
    """Names of metrics in an expression of Prometheus, with the labels that they are picked by."""
    return [
        (name, set(re.findall(r"(\w+)\s*(?:=~|!=|!~|=)", picked)))
        for name, picked in re.findall(r"(sceneprint_\w+)(\{[^}]*\})?", expression)
    ]


def check(expression: str) -> None:
    known = families()
    found = queried(expression)
    by = set(re.findall(r"\w+", " ".join(re.findall(r"\bby \(([^)]*)\)", expression))))
    labels = set()
    for name, picked in found:
        family = re.sub(r"_(bucket|sum|count)$", "", name)
        assert family in known, expression
        if family != name:
            assert name not in known
            labels.add("le")
        assert picked - {"job"} <= known[family], expression
        labels |= known[family]
    assert by <= labels, expression


def test_the_page_of_settings_is_written_from_their_fields() -> None:
    text = (DOCS / "settings.md").read_text()
    assert text == settings_page(), "run: make goldens"
    listed = rows(text)
    assert list(listed) == [name.upper() for name in Settings.model_fields]
    assert all(len(cells) == 4 and all(cells) for cells in listed.values())
    assert listed["PORT"][:2] == ["whole number, at least 0, at most 65,535", "`8008`"]
    assert listed["MAX_UPLOAD_BYTES"][1] == f"`{72 << 20}` (72 MiB)"
    assert listed["WORKERS"][1] == "number of processors"
    assert listed["DATABASE_URL"][:2] == ["text", "SQLite in the data folder"]
    assert listed["BUILD_SURFACES"][0] == "`auto` or `on_request`"


def test_every_state_is_told():
    told = rows(section("States"))
    wanted: dict[str, str] = {str(one): one.sentence for one in FrameState}
    by_frames = rows(section("States").split("A job:")[0])
    by_jobs = rows(section("States").split("A job:")[1].split("An answer:")[0])
    answers = rows(section("States").split("An answer:")[1].split("Kinds of events")[0])
    kinds = rows(section("States").split("Kinds of events")[1])
    assert by_frames == {name: [sentence] for name, sentence in wanted.items()}
    assert by_jobs == {str(one): [one.sentence] for one in JobState}
    assert set(answers) == set(get_args(AnswerStatus))
    assert {kind: [text] for kind, text in KINDS.items()} == {
        kind: cells for kind, cells in kinds.items() if kind != MISSED
    }
    assert MISSED in told


def test_every_metric_is_told_and_no_other():
    text = section("What to watch")
    table = text.split("| metric |")[1].split("\n\n")[0]
    assert set(re.findall(r"`(sceneprint_\w+)`", table)) == set(families())
    alerts = re.findall(r"^\| `([^`]*sceneprint_[^`]*)` \|", text.split("| condition |")[1], re.M)
    assert len(alerts) >= 9
    for alert in alerts:
        check(alert)


def expressions(dashboard: dict[str, Any]) -> list[str]:
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def test_dashboards_ask_for_what_there_is():
    named = set()
    for expression in (one for each in DASHBOARDS.values() for one in expressions(each)):
        assert queried(expression), expression
        check(expression)
        named |= {re.sub(r"_(bucket|sum|count)$", "", name) for name, _ in queried(expression)}
    assert named == set(families())  # all is shown somewhere


@pytest.mark.parametrize("name", DASHBOARDS)
def test_a_dashboard_can_be_imported_and_provisioned(name: str):
    """The data source is a variable: Grafana asks for inputs only where a person imports."""
    dashboard = DASHBOARDS[name]
    assert not dashboard.keys() & {"id", "__inputs"}  # of another Grafana: it would overwrite
    source, *variables = dashboard["templating"]["list"]
    assert (source["type"], source["query"]) == ("datasource", "prometheus")
    wanted = {"type": "prometheus", "uid": f"${{{source['name']}}}"}
    for variable in variables:
        assert variable["datasource"] == wanted
        check(variable["query"]["query"])
    taken = set()
    for panel in dashboard["panels"]:
        assert panel["datasource"] == wanted
        assert all(target["datasource"] == wanted for target in panel["targets"])
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken
        assert max(x for x, _ in cells) < 24
        taken |= cells
    assert len({panel["id"] for panel in dashboard["panels"]}) == len(dashboard["panels"])
    assert dashboard["schemaVersion"] >= 30


def test_every_command_and_option_is_there():
    (choices,) = [one.choices for one in parser()._actions if one.dest == "command"]
    assert choices is not None
    named = re.findall(r"`sceneprint (\w+)([^`]*)`", PAGE)
    assert len(named) >= 8
    for name, rest in named:
        assert name in choices
        for option in re.findall(r"--[\w-]+", rest):
            assert option in choices[name].format_help()  # type: ignore[call-overload]
