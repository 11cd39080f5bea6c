"""Tests of the commands of docs/api.md, run in order."""

import json
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
TOUR = (ROOT / "docs/api.md").read_text()
#: Seconds in which the tour has to come to its end: it waits for jobs.
PATIENCE_S = 600.0


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TOUR, re.DOTALL)


def named_blocks():
    """Blocks of commands, each with the heading it stands under."""
    found, heading = [], ""
    for part in re.findall(r"^##+ [^\n]*$|^```sh\n.*?^```", TOUR, re.DOTALL | re.MULTILINE):
        if part.startswith("#"):
            heading = part.lstrip("# ")
        else:
            found.append((heading, part.removeprefix("```sh\n").removesuffix("```")))
    return found


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    """What the blocks under each heading printed; a command that fails fails the tour."""
    folder = tmp_path_factory.mktemp("tour")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
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
    said = {}
    texts = done.stdout.split(f"{mark}\n")[1:]
    for (heading, _), text in zip(named, texts, strict=True):
        said.setdefault(heading, []).append(text)
    return said


def documents(output):
    """The JSON documents of an output, which curl prints one after the other."""
    decoder, found = json.JSONDecoder(), []
    position = output.find("{")
    while position >= 0:
        document, end = decoder.raw_decode(output, position)
        found.append(document)
        position = output.find("{", end)
    return found


def one(outputs, heading, place=0):
    return documents(outputs[heading][place].partition("# HELP")[0])


@pytest.mark.thorough
def test_frames_go_into_a_map(outputs):
    first, six, recording = outputs["Frames into the map"]
    assert documents(first)[0]["state"] == "received"
    assert [added["state"] for added in documents(six)[1:]] == ["indexed"] * 5
    assert recording.startswith("8 frames: 8 received, 0 already there; 8 indexed, 0 rejected")
    _, put, cloud, once, batch, archive = outputs["More ways in"]
    assert {one["frame_id"] for one in documents(put)} == {"r3-000007"}
    [answer] = documents(cloud)
    assert (answer["kind"], answer["status"]) == ("cloud", "found")
    assert once.lower().count("idempotent-replayed: true") == 1
    assert [i["status"] for i in documents(batch)[0]["items"]] == [202, 202, 422]
    assert "8 frames: 0 received, 8 already there" in archive
    page, monday, *_ = one(outputs, "Look around")
    assert len(page["items"]) == 2
    assert [f["session"] for f in monday["items"]] == ["monday"]
    edited, refused, _ = one(outputs, "Edit")
    assert edited["tags"] == ["door", "north"]
    assert refused["type"] == "/problems/precondition-failed"


@pytest.mark.thorough
def test_queries_answer_as_the_page_says(outputs):
    asked, _, less, listed = outputs["Where was this taken?"]
    answer = documents(asked)[0]
    assert (answer["status"], answer["counts"]["map"]) == ("found", 14)
    assert answer["location"]["confidence"] >= 0.99
    assert documents(less)[0]["location"]["confidence"] >= 0.9
    assert documents(listed)[0]["status"] == "unvalidated"
    filtered = one(outputs, "Search only some frames")
    assert [each["counts"]["passed"] for each in filtered] == [8, 13]
    assert one(outputs, "Read an answer again")[0] == answer
    where = one(outputs, "Where am I?")[0]
    assert (where["status"], where["pose"]["parent_frame"]) == ("found", "room-001")
    alike, moved, believed = outputs["When several places look alike"]
    (unsure,) = [each for each in documents(alike) if "alternatives" in each]
    assert (unsure["status"], unsure["pose"]) == ("ambiguous", None)
    assert "do not drive: move on, and ask again" in moved
    assert documents(believed)[0]["verified_by"] == "prior"
    every = one(outputs, "Search several maps")[3]
    assert set(every["per_map"]) == {"annex", "building", "cabinet"}
    pairs = one(outputs, "Compare two frames")
    assert [each["validation"]["status"] for each in pairs] == ["accepted"] * 2


@pytest.mark.thorough
def test_maps_are_rebuilt_joined_and_operated(outputs, with_open3d):
    assert one(outputs, "What does the place look like?")[-1]["state"] == "succeeded"
    (join,) = one(outputs, "Join two robots' maps")[-2]["result"]["joins"]
    assert (join["from_session"], join["to_session"]) == ("ann", "bob")
    assert "retry: 1000" in outputs["Events"][0]
    assert 'sceneprint_answers_total{status="found"}' in outputs["Operations"][0]
    made, listed, _ = one(outputs, "Keys")
    assert [key["name"] for key in listed["items"]] == ["robot-7"]
    _, refused, _, rotated = one(outputs, "Keys", 1)
    assert refused["type"] == "/problems/key-required"
    assert rotated["secret"] != made["secret"]
    restored, deleted = one(outputs, "Delete")
    assert (restored["state"], deleted["frames"]) == ("indexed", 1)
    assert one(outputs, "When something is wrong")[0]["type"] == "/problems/unknown-map"


@pytest.mark.thorough
def test_the_page_shows_the_fields_that_there_are(outputs):
    """The examples are JSON, and have the keys of the records they stand for."""
    from sceneprint_client.api import Answer, Match, Validation

    (example,) = [block for block in blocks("json") if '"milliseconds"' in block]
    shown = json.loads(example)
    assert set(shown) == set(Answer.model_fields)
    assert set(shown["matches"][0]) == set(Match.model_fields)
    assert set(shown["matches"][0]["validation"]) == set(Validation.model_fields)
    assert set(one(outputs, "Where was this taken?")[0]) == set(shown)
