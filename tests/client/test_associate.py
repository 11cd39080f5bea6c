"""Tests of associations by client, HTTP and command line: edges, graphs and joins."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint_client import Client
from sceneprint_client.api import JobState
from sceneprint_client.api.sessions import Association

MAP = "associated"


@dataclass(frozen=True)
class Filled:
    """A client of a map with both runs."""

    client: Client
    numbers: dict[str, int]


@pytest.fixture(scope="module")
def associated(service_url, walk):
    """Six frames along a path, some two degrees apart, one to each of two runs in turn."""
    with Client(service_url) as client:
        client.create_map(MAP, model="depth")
        sent = walk(12, sessions="ab", step=2)
        ids = [client.upload(MAP, *frame, wait_s=PATIENCE_S).frame_id for frame in sent]
        assert {frame.state for frame in client.frames(MAP)} == {"indexed"}
        yield Filled(client, {frame_id: i for i, frame_id in enumerate(ids)})


def test_edges_and_graphs(associated):
    client, steps = associated.client, []
    found = client.compute(
        Association, MAP, sessions=["a", "b"], k=2, seed=3, progress=lambda *n: steps.append(n)
    )
    assert found.state is JobState.SUCCEEDED
    name = found.job_id
    edges = list(client.edges(MAP, name))
    assert found.result.edges == len(edges) > 4
    assert found.result.joins[0].transform is not None
    assert {one.from_frame for one in edges} <= associated.numbers.keys()
    assert steps[-1] == (3, 3)
    middle = sorted(edge.overlap for edge in edges)[len(edges) // 2]
    strongest = json.loads(client.graph(MAP, name, "json", min_overlap=middle))
    assert len(strongest["edges"]) == len(edges) - len(edges) // 2
    assert client.graph(MAP, name, odometry=True).count("EDGE_SE3:QUAT") > len(edges)
    rows = [line.split() for line in client.graph(MAP, name, "tum").splitlines()]
    assert len([row for row in rows if row[0] != "#"]) == 6
    # over HTTP
    http, place = client._http, f"/v1/maps/{MAP}/associations/{name}"
    for kind, media in (
        ("g2o", "text/x-g2o"), ("tum", "text/plain; charset=utf-8"), ("json", "application/json"),
    ):  # fmt: skip
        by_name = http.get(f"{place}/graph", params={"format": kind})
        by_type = http.get(f"{place}/graph", headers={"Accept": media.partition(";")[0]})
        assert by_name.headers["Content-Type"].partition(";")[0] == media.partition(";")[0]
        assert by_name.content == by_type.content
        assert by_name.text == client.graph(MAP, name, kind)
    page = http.get(f"{place}/edges", params={"limit": 3, "consistent": "true"}).json()
    assert [edge["number"] for edge in page["items"]] == [0, 1, 2]
    rest = http.get(f"{place}/edges", params={"cursor": page["next_cursor"]}).json()
    assert rest["items"][0]["number"] == 3
    for path, more in (("edges", {"min_overlap": 2}), ("graph", {"format": "gtsam"})):
        assert http.get(f"{place}/{path}", params=more).status_code == 422


def test_the_command(associated, service_url, tmp_path, capsys):
    client, out = associated.client, tmp_path / "graph.g2o"
    of = ["make", "association", MAP, "--url", service_url, "--session", "a"]
    assert main([*of, "--session", "b", "--out", str(out), "--odometry"]) == 0
    lines = capsys.readouterr().out.splitlines()
    newest = next(iter(client.products(Association, MAP)))
    assert lines[0].startswith(f"association {newest.job_id}: {newest.result.edges} edges")
    assert lines[2].startswith("joined strongly, ann/a onto ann/b: ") or lines[2].startswith(
        "joined weakly (check it before you rely on it)"
    )
    assert lines[-1] == f"wrote {out}"
    assert out.read_text() == client.graph(MAP, newest.job_id, odometry=True)
    undo = ["make", "association", MAP, "--url", service_url, "--undo"]
    assert main([*undo, newest.job_id]) == 0
    assert capsys.readouterr().out.splitlines() == lines[:-1]  # it moved no pose
    assert main([*undo, "0" * 32]) == 2
    assert "There is no association" in capsys.readouterr().err
    assert main([*of, "--apart", "2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["request"]["apart"] == 2
    assert told["result"]["joins"] == []
    assert main([*of, "--out", str(tmp_path / "graph.gtsam")]) == 2
    assert "has an unknown file type" in capsys.readouterr().err
    begun = len(list(client.products(Association, MAP)))
    assert main([*of, "--out", str(tmp_path / "no" / "graph.g2o")]) == 2  # before it is begun
    assert "No such file or directory" in capsys.readouterr().err
    assert len(list(client.products(Association, MAP))) == begun
    assert main([*of, "--session", "nobody"]) == 2
    assert "no indexed frame" in capsys.readouterr().err
