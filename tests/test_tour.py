"""Tests of the commands of docs/api.md, run in order."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.waiting import free_port
from sceneprint_client.api import Answer, Match, Validation

ROOT = Path(__file__).resolve().parent.parent
TOUR = (ROOT / "docs/api.md").read_text()
#: Seconds in which the tour has to come to its end: it waits for jobs.
PATIENCE_S = 600.0


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TOUR, re.DOTALL)


def named_blocks():
    """Blocks of commands, each with the heading it stands under."""
    parsed, heading = [], ""
    for part in re.findall(r"^##+ [^\n]*$|^```sh\n.*?^```", TOUR, re.DOTALL | re.MULTILINE):
        if part.startswith("#"):
            heading = part.lstrip("# ")
        else:
            parsed.append((heading, part.removeprefix("```sh\n").removesuffix("```")))
    return parsed


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """Output of the blocks under each heading; a command that fails fails the tour."""
    folder = tmp_path_factory.mktemp("tour")
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    mark = "=== next block ==="
    named = named_blocks()
    # `kill %1` must reach the service, so it stays a job of this shell
    script = f"set -eo pipefail\ntrap 'kill %1; wait' EXIT\n\necho '{mark}'\n".join(
        ["", *(commands for _, commands in named)]
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
        ["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    printed = {}
    texts = done.stdout.split(f"{mark}\n")[1:]
    for (heading, _), text in zip(named, texts, strict=True):
        printed.setdefault(heading, []).append(text)
    return printed


def documents(output):
    """The JSON documents of an output, which curl prints one after the other."""
    decoder, parsed = json.JSONDecoder(), []
    position = output.find("{")
    while position >= 0:
        document, end = decoder.raw_decode(output, position)
        parsed.append(document)
        position = output.find("{", end)
    return parsed


def one(outputs, heading, place=0):
    return documents(outputs[heading][place].partition("# HELP")[0])


@pytest.mark.thorough
def test_commands_print_what_the_page_says(outputs, with_open3d):
    _, six, recording = outputs["Frames into the map"]
    assert [added["state"] for added in documents(six)[1:]] == ["indexed"] * 5
    assert recording.startswith("8 frames: 8 received, 0 already there; 8 indexed, 0 rejected")
    *_, batch, archive = outputs["More ways in"]
    assert [item["status"] for item in documents(batch)[0]["items"]] == [202, 202, 422]
    assert "8 frames: 0 received, 8 already there" in archive
    query, _, less, listed = outputs["Where was this taken?"]
    answer = documents(query)[0]
    assert (answer["status"], answer["counts"]["map"]) == ("found", 14)
    assert documents(less)[0]["location"]["confidence"] >= 0.9
    assert documents(listed)[0]["status"] == "unvalidated"
    assert one(outputs, "Read an answer again")[0] == answer
    alike, moved, confirmed = outputs["When several places look alike"]
    assert [each["status"] for each in documents(alike) if "alternatives" in each] == ["ambiguous"]
    assert "do not drive: move on, and ask again" in moved
    assert documents(confirmed)[0]["verified_by"] == "prior"
    (join,) = one(outputs, "Join two robots' maps")[-2]["result"]["joins"]
    assert (join["from_session"], join["to_session"]) == ("ann", "bob")
    assert one(outputs, "What does the place look like?")[-1]["state"] == "succeeded"
    assert one(outputs, "Keys", 1)[1]["type"] == "/problems/key-required"
    restored, deleted = one(outputs, "Delete")
    assert (restored["state"], deleted["frames"]) == ("indexed", 1)


@pytest.mark.thorough
def test_the_page_shows_the_fields_of_the_records(outputs):
    (example,) = [block for block in blocks("json") if '"milliseconds"' in block]
    shown = json.loads(example)
    assert set(shown) == set(Answer.model_fields)
    assert set(shown["matches"][0]) == set(Match.model_fields)
    assert set(shown["matches"][0]["validation"]) == set(Validation.model_fields)
    assert set(one(outputs, "Where was this taken?")[0]) == set(shown)
