"""Associations by client, raw HTTP and command."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.errors import InvalidRequest, UnknownJob, UnknownMap
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState

MAP = "associated"


@dataclass(frozen=True)
class Filled:
    """A client of a map with both runs."""

    client: Client
    numbers: dict[str, int]


@pytest.fixture(scope="module")
def associated(
    service_url: str, walk: Callable[..., list[tuple[bytes, FrameMeta]]]
) -> Iterator[Filled]:
    """Six frames along a path, some two degrees apart, one to each of two runs in turn."""
    with Client(service_url) as client:
        client.create_map(MAP, model="depth")
        sent = walk(12, sessions="ab", step=2)
        ids = [client.upload(MAP, *frame, wait_s=PATIENCE_S).frame_id for frame in sent]
        assert {frame.state for frame in client.frames(MAP)} == {"indexed"}
        yield Filled(client, {frame_id: i for i, frame_id in enumerate(ids)})


def test_edges_and_graphs(associated: Filled) -> None:
    client, steps = associated.client, []
    found = client.associate(MAP, "a", "b", k=2, seed=3, progress=lambda *n: steps.append(n))
    assert found.state is JobState.SUCCEEDED
    name = found.association_id
    assert client.association(MAP, name) == found
    edges = list(client.edges(MAP, name))
    assert found.result is not None
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


def test_list_remove_and_refusals(associated: Filled) -> None:
    client = associated.client
    before = [one.association_id for one in client.associations(MAP)]
    begun = client.associate(MAP, "a", apart=2, timeout_s=0)
    assert [one.association_id for one in client.associations(MAP)] == [
        begun.association_id, *before,
    ]  # fmt: skip
    done = client.wait_for_association(begun, timeout_s=PATIENCE_S)
    assert done.result is not None
    assert done.result.frames == 3
    of = MAP, begun.association_id
    for ask, field in (
        (lambda: client.graph(*of, "gtsam"), "format"),  # type: ignore[arg-type]
        (lambda: client.graph(*of, min_overlap=2.0), "min_overlap"),
        (lambda: list(client.edges(*of, min_overlap=-0.1)), "min_overlap"),
    ):
        with pytest.raises(InvalidRequest) as caught:
            ask()
        assert [name for name, _ in caught.value.fields] == [field]
    client.delete_association(MAP, begun.association_id)
    assert [one.association_id for one in client.associations(MAP)] == before
    for name in (begun.association_id, "../jobs"):
        with pytest.raises(UnknownJob):
            client.association(MAP, name)
    with pytest.raises(UnknownMap):
        client.associate("nowhere", "a")
    with pytest.raises(InvalidRequest):
        client.associate(MAP, "a", "nobody")
    with pytest.raises(InvalidRequest):
        client.associate(MAP, "a", "a")


def test_over_http(associated: Filled, service_url: str) -> None:
    client = associated.client
    root = f"/v1/maps/{MAP}/associations"
    with httpx.Client(base_url=service_url, trust_env=False, timeout=PATIENCE_S) as http:
        answer = http.post(root, json={"sessions": ["a", "b"]})
        assert answer.status_code == 202
        begun = client.wait_for_association(
            client.association(MAP, answer.json()["association_id"]), timeout_s=PATIENCE_S
        )
        place = answer.headers["Location"]
        assert place == f"{root}/{begun.association_id}"
        assert http.get(place).json()["state"] == "succeeded"
        assert http.get(f"/v1/jobs/{begun.association_id}").json()["kind"] == "associate"
        for kind, media in (
            ("g2o", "text/x-g2o"), ("tum", "text/plain; charset=utf-8"),
            ("json", "application/json"),
        ):  # fmt: skip
            by_name = http.get(f"{place}/graph", params={"format": kind})
            by_type = http.get(f"{place}/graph", headers={"Accept": media.partition(";")[0]})
            assert by_name.headers["Content-Type"].partition(";")[0] == media.partition(";")[0]
            assert by_name.content == by_type.content
            assert by_name.text == client.graph(MAP, begun.association_id, kind)  # type: ignore[arg-type]
        page = http.get(f"{place}/edges", params={"limit": 3, "consistent": "true"}).json()
        assert [edge["number"] for edge in page["items"]] == [0, 1, 2]
        rest = http.get(f"{place}/edges", params={"cursor": page["next_cursor"]}).json()
        assert rest["items"][0]["number"] == 3
        for status, method, path, more in (
            (404, "GET", f"{root}/{'0' * 32}", {}),
            (404, "GET", f"/v1/maps/nowhere/associations/{begun.association_id}", {}),
            (404, "DELETE", f"{root}/nothing", {}),
            (422, "GET", f"{place}/edges", {"params": {"min_overlap": 2}}),
            (422, "GET", f"{place}/graph", {"params": {"format": "gtsam"}}),
            (422, "POST", root, {"json": {"sessions": ["a", "b", "c"]}}),
            (422, "POST", root, {"json": []}),
            (422, "POST", root, {"json": {"sessions": ["nobody"]}}),
            (415, "POST", root, {"content": b"sessions=a"}),
            (400, "POST", root, {"content": b"{", "headers": {"Content-Type": "application/json"}}),
        ):
            refused = http.request(method, path, **more)
            assert refused.status_code == status, (method, path)
            assert refused.headers["Content-Type"] == "application/problem+json"
        assert http.delete(place).status_code == 204
        assert http.get(f"{place}/edges").status_code == 404


def test_the_command(
    associated: Filled, service_url: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    client, out = associated.client, tmp_path / "graph.g2o"
    of = ["associate", MAP, "--url", service_url, "--session", "a"]
    assert main([*of, "--session", "b", "--out", str(out), "--odometry"]) == 0
    lines = capsys.readouterr().out.splitlines()
    newest = next(iter(client.associations(MAP)))
    assert newest.result is not None
    assert lines[0].startswith(f"association {newest.association_id}: {newest.result.edges} edges")
    assert lines[2].startswith("joined surely, ann/a onto ann/b: ") or lines[2].startswith(
        "joined weakly (check it before you rely on it)"
    )
    assert lines[-1] == f"wrote {out}"
    assert out.read_text() == client.graph(MAP, newest.association_id, odometry=True)
    undo = ["associate", MAP, "--url", service_url, "--undo"]
    assert main([*undo, newest.association_id]) == 0
    assert capsys.readouterr().out.splitlines() == lines[:-1]  # it moved no pose
    assert main([*undo, "0" * 32]) == 2
    assert "There is no association" in capsys.readouterr().err
    assert main([*of, "--apart", "2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["asked"]["apart"] == 2
    assert told["result"]["joins"] == []
    assert main([*of, "--out", str(tmp_path / "graph.gtsam")]) == 2
    assert "has no known file type" in capsys.readouterr().err
    begun = len(list(client.associations(MAP)))
    assert main([*of, "--out", str(tmp_path / "no" / "graph.g2o")]) == 2  # before it is begun
    assert "No such file or directory" in capsys.readouterr().err
    assert len(list(client.associations(MAP))) == begun
    assert main([*of, "--session", "nobody"]) == 2
    assert "no indexed frame" in capsys.readouterr().err
