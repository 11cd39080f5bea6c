"""docs/api.md: its commands, run as they stand, in their order."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOUR = (ROOT / "docs/api.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TOUR, re.DOTALL)


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What each block of commands printed; a command that fails fails the tour."""
    folder = tmp_path_factory.mktemp("tour")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    mark = "=== next block ==="
    # `kill %1` must reach the service, so it stays a job of this shell
    script = f"set -eo pipefail\ntrap 'kill %1; wait' EXIT\n\necho '{mark}'\n".join(
        ["", *blocks("sh")]
    ).replace("http://127.0.0.1:8008", url)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "SCENEPRINT_PORT": str(port),
        "SCENEPRINT_URL": url,
        "SCENEPRINT_DATA_DIR": str(folder / "data"),
        "SCENEPRINT_WORKERS": "1",
    }
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.split(f"{mark}\n")[1:]


def documents(output: str) -> list[dict[str, Any]]:
    """The JSON documents of an output, which curl prints one after the other."""
    decoder, found = json.JSONDecoder(), []
    position = output.find("{")
    while position >= 0:
        document, end = decoder.raw_decode(output, position)
        found.append(document)
        position = output.find("{", end)
    return found


def test_the_tour_runs_and_says_what_the_page_promises(outputs: list[str]) -> None:
    (
        _,
        health,
        made,
        one,
        five,
        recording,
        around,
        asked,
        of_map,
        listed,
        filtered,
        newest,
        removed,
        refused,
        operations,
    ) = outputs
    assert documents(health)[0]["status"] == "ok"
    assert [m["title"] for m in documents(made)] == ["Two rooms"] * 2
    assert documents(one)[0]["state"] == "received"
    assert [added["state"] for added in documents(five)] == ["indexed"] * 5
    assert recording.startswith("8 frames: 8 received, 0 already there; 8 indexed, 0 rejected")
    page, job = documents(around)
    assert len(page["items"]) == 2
    assert job["state"] == "succeeded"
    answer = documents(asked)[0]
    assert answer["status"] == "found"
    assert answer["matches"][0]["validation"]["status"] == "accepted"
    assert answer["counts"]["map"] == 14
    again = documents(of_map)[0]
    assert (again["status"], again["seed"]) == ("found", 7)
    unvalidated = documents(listed)[0]
    assert (unvalidated["status"], unvalidated["counts"]["selected"]) == ("unvalidated", 5)
    assert [answer["counts"]["passed"] for answer in documents(filtered)] == [8, 13]
    jobs = documents(newest)[0]
    assert [job["state"] for job in jobs["items"]] == ["succeeded"] * 3
    assert jobs["next_cursor"] is not None
    assert removed.strip() == ""
    assert documents(refused)[0]["type"] == "/problems/unknown-map"
    assert documents(operations.splitlines()[0])[0]["status"] == "ready"
    assert 'sceneprint_answers_total{status="found"} 2.0' in operations


def test_the_page_shows_the_fields_that_there_are(outputs: list[str]) -> None:
    """The examples are JSON, and have the keys of the records they stand for."""
    from sceneprint.schemas import Answer, Match, Validation

    (example,) = [block for block in blocks("json") if "matches" in block]
    shown = json.loads(example)
    assert set(shown) == set(Answer.model_fields)
    assert set(shown["matches"][0]) == set(Match.model_fields)
    assert set(shown["matches"][0]["validation"]) == set(Validation.model_fields)
    given = documents(outputs[7])[0]
    assert set(given) == set(shown)


def test_every_kind_of_problem_has_its_row() -> None:
    from sceneprint import errors
    from service.problems import STATUSES, status_of, type_of

    over_http = [
        kind
        for base in STATUSES
        if base is not errors.SceneprintError
        for kind in (base, *base.__subclasses__())
        if not kind.__subclasses__() or kind is errors.InvalidRequest
    ]
    for kind in over_http:
        name = type_of(kind.__name__).removeprefix("/problems/")
        rows = [line for line in TOUR.splitlines() if f"`{name}`" in line and line.startswith("| ")]
        assert len(rows) == 1, name
        assert rows[0].startswith(f"| {status_of(kind('x'))} |"), name
