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
    client = associated.client
    result = client.compute(Association, MAP, sessions=["a", "b"], k=2, seed=3)
    assert result.state is JobState.SUCCEEDED
    name = result.job_id
    edges = list(client.edges(MAP, name))
    assert result.result.edges == len(edges) > 4
    assert result.result.joins[0].transform is not None
    assert {edge.from_frame for edge in edges} <= associated.numbers.keys()
    middle = sorted(edge.overlap for edge in edges)[len(edges) // 2]
    strongest = json.loads(client.graph(MAP, name, "json", min_overlap=middle))
    assert len(strongest["edges"]) == len(edges) - len(edges) // 2
    assert client.graph(MAP, name, odometry=True).count("EDGE_SE3:QUAT") > len(edges)
    rows = [line.split() for line in client.graph(MAP, name, "tum").splitlines()]
    assert len([row for row in rows if row[0] != "#"]) == 6
    http, place = client._http, f"/v1/maps/{MAP}/associations/{name}"
    by_type = http.get(f"{place}/graph", headers={"Accept": "text/plain"})
    assert by_type.text == client.graph(MAP, name, "tum")
    page = http.get(f"{place}/edges", params={"limit": 3, "consistent": "true"}).json()
    rest = http.get(f"{place}/edges", params={"cursor": page["next_cursor"]}).json()
    assert [edge["number"] for edge in page["items"] + rest["items"][:1]] == [0, 1, 2, 3]
    for path, more in (("edges", {"min_overlap": 2}), ("graph", {"format": "gtsam"})):
        assert http.get(f"{place}/{path}", params=more).status_code == 422


def test_the_command(associated, service_url, tmp_path, capsys):
    client, out = associated.client, tmp_path / "graph.g2o"
    of = ["make", "association", MAP, "--url", service_url, "--session", "a"]
    assert main([*of, "--session", "b", "--out", str(out), "--odometry"]) == 0
    lines = capsys.readouterr().out.splitlines()
    newest = next(iter(client.products(Association, MAP)))
    assert lines[0].startswith(f"association {newest.job_id}: {newest.result.edges} edges")
    assert lines[-1] == f"wrote {out}"
    assert out.read_text() == client.graph(MAP, newest.job_id, odometry=True)
    undo = ["make", "association", MAP, "--url", service_url, "--undo"]
    assert main([*undo, newest.job_id]) == 0
    assert capsys.readouterr().out.splitlines() == lines[:-1]  # it moved no pose
    begun = len(list(client.products(Association, MAP)))
    for wrong, message in (
        ([*undo, "0" * 32], "There is no association"),
        ([*of, "--out", str(tmp_path / "graph.gtsam")], "has an unknown file type"),
        ([*of, "--out", str(tmp_path / "no" / "graph.g2o")], "No such file or directory"),
        ([*of, "--session", "nobody"], "no indexed frame"),
    ):
        assert main(wrong) == 2
        assert message in capsys.readouterr().err
    assert len(list(client.products(Association, MAP))) == begun
