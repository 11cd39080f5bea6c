"""Tests that pages, alerts and the dashboards of Grafana match the tables of the code."""

import json
import re
from pathlib import Path

import pytest

from sceneprint import errors
from sceneprint.cli import parser
from sceneprint.settings import Settings
from sceneprint_client.api.admin import KINDS
from service.metrics import METRICS
from service.problem_types import problem_type
from tools.pages import problem_rows, written_pages

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "operations.md").read_text()
FOLDER = DOCS.parent / "deploy/helm/sceneprint/dashboards"
DASHBOARDS = {path.stem: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}


def section(title):
    """A section of the page, without those after it."""
    (found,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    return str(found)


def rows(text):
    """Rows of its tables by the first cell's code, with the other cells."""
    found = re.findall(r"^\| `([^`]+)` \|(.*)\|$", text, re.MULTILINE)
    return {name: [cell.strip() for cell in rest.split("|")] for name, rest in found}


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


@pytest.mark.parametrize("path", written_pages(), ids=lambda path: path.name)
def test_tables_of_pages_are_those_of_the_code(path):
    assert path.read_text() == written_pages()[path], "run: make goldens"


def test_tables_have_the_units_statuses_and_labels_of_the_code():
    listed = rows((DOCS / "settings.md").read_text())
    assert list(listed) == [name.upper() for name in Settings.model_fields]
    assert all(len(cells) == 4 and all(cells) for cells in listed.values())
    assert listed["PORT"][:2] == ["whole number, 0 to 65,535", "`8008`"]
    assert listed["MAX_UPLOAD_BYTES"][1] == f"`{72 << 20}` (72 MiB)"
    assert listed["WORKERS"][1] == "number of processors"
    assert listed["DATABASE_URL"][:2] == ["text", "SQLite in the data folder"]
    assert listed["BUILD_SURFACES"][0] == "`auto` or `on_request`"
    assert rows(PAGE)["sceneprint_requests_total"][:2] == ["counter", "`method`, `route`, `status`"]
    assert set(KINDS) < rows(PAGE).keys()


def test_every_public_error_is_in_one_row_with_its_status():
    table = [row for row in problem_rows() if not row[0].startswith("5")]
    listed = {one.strip("`"): row[0] for row in table for one in row[1].split(", ")}
    assert sum(len(row[1].split(", ")) for row in table) == len(listed)
    kinds = [getattr(errors, name) for name in errors.__all__ if name[:1].isupper()]
    for kind in kinds:
        status = problem_type(kind).status
        name = errors.kebab_case(kind.__name__)
        assert status >= 500 or listed[name] == str(status)
    assert listed["unknown-map"] == "404"
    assert all(len(row) == 4 and all(row) for row in table)


def test_alerts_query_existing_metrics():
    alerts = re.findall(r"^\| `([^`]*sceneprint_[^`]*)` \|", section("What to watch"), re.M)
    alerts = [alert for alert in alerts if " " in alert]
    assert len(alerts) >= 9
    for alert in alerts:
        check(alert)


def expressions(dashboard):
    return [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]


def test_dashboards_ask_for_what_there_is():
    named = set()
    for expression in (one for each in DASHBOARDS.values() for one in expressions(each)):
        assert queried(expression), expression
        check(expression)
        named |= {re.sub(r"_(bucket|sum|count)$", "", name) for name, _ in queried(expression)}
    assert named == set(families())  # all is shown somewhere


@pytest.mark.parametrize("name", DASHBOARDS)
def test_a_dashboard_can_be_imported_and_provisioned(name):
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
    named = re.findall(r"`sceneprint (\w+)([^`]*)`", PAGE)
    assert len(named) >= 8
    for name, rest in named:
        assert name in choices
        for option in re.findall(r"--[\w-]+", rest):
            assert option in choices[name].format_help()
