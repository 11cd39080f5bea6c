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
    assert one(outputs, "Start", 1)[0]["status"] == "ok"
    assert [m["title"] for m in one(outputs, "A map")] == ["Two rooms"] * 2
    first, six, recording = outputs["Frames into the map"]
    assert documents(first)[0]["state"] == "received"
    job, *five = documents(six)
    assert job["job_id"] == documents(first)[0]["job_id"]
    assert [added["state"] for added in five] == ["indexed"] * 5
    assert recording.startswith("8 frames: 8 received, 0 already there; 8 indexed, 0 rejected")


@pytest.mark.thorough
def test_there_are_other_ways_in(outputs):
    raw, put, cloud, once, batch, archive = outputs["More ways in"]
    assert documents(raw)[1]["state"] == "received"
    added, frame = documents(put)
    assert added["frame_id"] == frame["frame_id"] == "r3-000007"
    assert frame["T_base_sensor"]["translation"] == {"x": 0.1, "y": 0.0, "z": 0.4}
    [answer] = documents(cloud)
    assert (answer["kind"], answer["status"]) == ("cloud", "found")
    assert answer["matches"][0]["transform"]["child_frame"] == "query.sensor"
    assert [a["frame_id"] for a in documents(once)] == [documents(once)[0]["frame_id"]] * 2
    assert once.lower().count("idempotent-replayed: true") == 1
    assert [i["status"] for i in documents(batch)[0]["items"]] == [202, 202, 422]
    assert documents(archive)[1]["state"] == "succeeded"
    assert len(documents(archive)[2]["items"]) == 3
    # every second of sixteen, sent once more by command
    assert "8 frames: 0 received, 8 already there" in archive


@pytest.mark.thorough
def test_frames_can_be_looked_at_and_edited(outputs):
    page, monday, posed, named = one(outputs, "Look around")
    assert len(page["items"]) == 2
    assert [f["session"] for f in monday["items"]] == ["monday"]
    assert [f["session"] for f in posed["items"]] == ["monday"]
    assert all(f["name"].startswith("frame-0000") for f in named["items"])
    trajectory = outputs["Sessions and trajectories"][0]
    assert "1794821400.0 0.0 0.0 1.2 0.0 0.0 0.0 1.0" in trajectory
    edited, refused, titled = one(outputs, "Edit")
    assert edited["tags"] == ["door", "north"]
    assert refused["type"] == "/problems/precondition-failed"
    assert titled["title"] == "Two rooms, and a door"


@pytest.mark.thorough
def test_queries_answer_as_the_page_says(outputs):
    asked, of_map, less, listed = outputs["Where was this taken?"]
    answer = documents(asked)[0]
    assert answer["status"] == "found"
    assert answer["matches"][0]["validation"]["status"] == "accepted"
    assert answer["counts"]["map"] == 14
    again = documents(of_map)[0]
    assert (again["status"], again["seed"]) == ("found", 7)
    assert answer["location"]["confidence"] >= 0.99
    assert documents(less)[0]["location"]["confidence"] >= 0.9
    unvalidated = documents(listed)[0]
    assert (unvalidated["status"], unvalidated["counts"]["selected"]) == ("unvalidated", 5)
    explained = one(outputs, "Why is a frame not a match?")[0]
    assert [each["rank"] for each in explained["explanations"]] == list(range(1, 15))
    assert explained["explained_frame"]["rank"] >= 1
    filtered = one(outputs, "Search only some frames")
    assert [each["counts"]["passed"] for each in filtered] == [8, 13]
    sure = one(outputs, "How sure is it?")[0]
    assert len(sure["location"]["uncertainty"]["covariance"]) == 36
    assert sure["location"]["base"]["child_frame"] == "base_link"
    kept = one(outputs, "Read an answer again")
    assert kept[0] == answer
    where = one(outputs, "Where am I?")[0]
    assert (where["status"], where["pose"]["parent_frame"]) == ("found", "room-001")
    alike, moved, believed = outputs["When several places look alike"]
    (unsure,) = [each for each in documents(alike) if "alternatives" in each]
    assert (unsure["status"], unsure["pose"]) == ("ambiguous", None)
    assert len(unsure["alternatives"]) >= 2
    assert "do not drive: move on, and ask again" in moved
    assert "at most one is right:" in moved
    there = documents(believed)[0]
    assert (there["status"], there["verified_by"]) == ("found", "prior")
    assert "several poses fit, and the prior decided" in believed
    named, every = one(outputs, "Search several maps")[2:]
    assert named["maps"] == ["building", "annex"]
    assert set(every["per_map"]) == {"annex", "building", "cabinet"}
    stored, sent = one(outputs, "Compare two frames")
    assert [each["validation"]["status"] for each in (stored, sent)] == ["accepted"] * 2


@pytest.mark.thorough
def test_places_are_rebuilt(outputs, with_open3d):
    rebuilt = one(outputs, "What does the place look like?")[-1]
    assert rebuilt["state"] == "succeeded"
    assert len(rebuilt["result"]["views"]) > 1


@pytest.mark.thorough
def test_robots_maps_are_joined(outputs):
    joined = one(outputs, "Join two robots' maps")
    (join,) = joined[-2]["result"]["joins"]
    assert (join["from_session"], join["to_session"]) == ("ann", "bob")
    assert join["transform"] is not None
    assert all(edge["consistent"] for edge in joined[-1]["items"])


@pytest.mark.thorough
def test_operators_see_what_goes_on(outputs):
    jobs = one(outputs, "Jobs")[0]
    assert [job["state"] for job in jobs["items"]] == ["succeeded"] * 3
    assert jobs["next_cursor"] is not None
    happened = outputs["Events"][0]
    assert len(documents(happened)[0]["items"]) == 3
    assert "retry: 1000" in happened
    operations = outputs["Operations"][0]
    assert documents(operations[: operations.index("# HELP")])[0]["status"] == "ready"
    assert 'sceneprint_answers_total{status="found"}' in operations
    made, listed, me = one(outputs, "Keys")
    assert made["secret"].startswith("sp_")
    assert [key["name"] for key in listed["items"]] == ["robot-7"]
    assert (me["name"], me["grants"]) == (None, {"*": "admin"})
    proxied, refused, audit, rotated = one(outputs, "Keys", 1)
    assert (proxied["name"], refused["type"]) == ("robot-7", "/problems/key-required")
    assert len(audit["items"]) == 3
    assert (rotated["name"], rotated["secret"] != made["secret"]) == ("robot-7", True)
    assert rotated["previous_until"] is not None
    restored, deleted = one(outputs, "Delete")
    assert restored["state"] == "indexed"
    assert deleted["frames"] == deleted["deletion"]["frames"] == 1
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
