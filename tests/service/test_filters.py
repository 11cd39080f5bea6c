"""Filters and `if_novel` over HTTP: as a form and as JSON, and what is refused by its field."""

from __future__ import annotations

import json
from typing import Any

import pytest

AT = "2026-11-16T09:30:{:02d}Z"


@pytest.fixture(scope="module")
def rooms(served, make_map, shots) -> dict[str, Any]:
    """A map with three views of each of two rooms, ten seconds apart, by its path and frame ids."""
    path = make_map(served, "filtered")
    ids = []
    for i, shot in enumerate(shots):
        meta = {
            "session": f"run-{i // 3}", "robot": "r1", "captured_at": AT.format(10 * (i % 3)),
            "pose": {"matrix": shot.pose, "parent_frame": "house"}, "tags": ["day", f"n{i}"],
        }  # fmt: skip
        sent = served.client.post(
            f"{path}/frames", **shot.form(**meta), headers={"Prefer": "wait=60"}
        )
        assert sent.json()["state"] == "indexed"
        ids.append(sent.json()["frame_id"])
    return {"path": path, "ids": ids}


def by_form(served, rooms, shot, given: str, **meta: object) -> Any:
    form = shot.form(**meta)
    form["data"] |= {"stages": "retrieve", "k": "50", "filter": given}
    return served.client.post(f"{rooms['path']}/queries", **form)


def by_id(served, rooms, which: int, given: object) -> Any:
    body = {"frame_id": rooms["ids"][which], "stages": "retrieve", "k": 50, "filter": given}
    return served.client.post(f"{rooms['path']}/queries", json=body)


def places(rooms, answer: Any) -> list[int]:
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert told["counts"]["passed"] == len(told["matches"])
    return sorted(rooms["ids"].index(match["frame_id"]) for match in told["matches"])


def box(shot, *, around: float) -> dict[str, Any]:
    """A cube about the place of a frame."""
    place = {axis: shot.pose[i][3] for i, axis in enumerate("xyz")}
    return {
        "parent_frame": "house",
        "min": {axis: x - around for axis, x in place.items()},
        "max": {axis: x + around for axis, x in place.items()},
    }


@pytest.mark.parametrize(
    ("given", "passing"),
    [
        ({"session": "run-1"}, [3, 4, 5]),
        ({"session": ["run-0", "run-1"], "tags": ["n2"]}, [2]),
        ({"tags": ["day", "n2", "n3"]}, []),
        ({"captured_after": AT.format(10), "captured_before": AT.format(10)}, [1, 4]),
        ({"captured_after": "2026-11-16T10:30:20+01:00"}, [2, 5]),
        ({"robot": "r1", "session": "run-0"}, [0, 1, 2]),
        ({"robot": "r2"}, []),
        ({}, [0, 1, 2, 3, 4, 5]),
        (None, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_only_what_passes_is_found(served, rooms, shots, given, passing):
    assert places(rooms, by_form(served, rooms, shots[0], json.dumps(given))) == passing
    for form in (given, json.dumps(given)):  # JSON takes text as well
        others = [one for one in passing if one != 1]
        assert places(rooms, by_id(served, rooms, 1, form)) == others


def test_places_and_ids(served, rooms, shots):
    near = by_form(served, rooms, shots[0], json.dumps({"region": box(shots[4], around=1e-6)}))
    assert places(rooms, near) == [4]
    elsewhere = box(shots[4], around=1e6) | {"parent_frame": "garden"}
    assert places(rooms, by_form(served, rooms, shots[0], json.dumps({"region": elsewhere}))) == []
    but = {"exclude_frames": rooms["ids"][:5]}
    assert places(rooms, by_form(served, rooms, shots[0], json.dumps(but))) == [5]


def test_a_loop_closes_with_what_lies_behind(served, rooms, shots, refused):
    """The frame of 10 s in run 0: those of 0 and 20 s are near, run 1 is another run."""
    assert places(rooms, by_id(served, rooms, 1, {"not_within_s": 9.9})) == [0, 2, 3, 4, 5]
    assert places(rooms, by_id(served, rooms, 1, {"not_within_s": 10})) == [3, 4, 5]
    assert places(rooms, by_id(served, rooms, 0, {"not_within_s": 10})) == [2, 3, 4, 5]
    asked = '{"not_within_s": 5}'
    known = {"session": "run-0", "robot": "r1", "captured_at": AT.format(4)}
    found = by_form(served, rooms, shots[0], asked, **known)
    assert places(rooms, found) == [1, 2, 3, 4, 5]
    other = by_form(served, rooms, shots[0], asked, **known | {"robot": "r2"})
    assert places(rooms, other) == [0, 1, 2, 3, 4, 5]
    lacks = by_form(served, rooms, shots[0], asked, session="run-0")
    problem = refused(lacks, 422, "invalid-request", "no captured_at")
    reason = "needed by filter.not_within_s"
    assert problem["errors"] == [{"field": "captured_at", "reason": reason}]


@pytest.mark.parametrize(
    ("given", "field", "text"),
    [
        ('{"robot"', "filter", "not JSON"),
        ("[1]", "filter", ""),
        ('{"robots": "r1"}', "filter.robots", ""),
        ('{"robot": []}', "filter.robot", "at least 1"),
        ('{"robot": "a\\nb"}', "filter.robot.0", ""),
        ('{"not_within_s": 0}', "filter.not_within_s", "greater than 0"),
        ('{"not_within_s": NaN}', "filter.not_within_s", "finite"),
        ('{"not_within_s": 1e999}', "filter.not_within_s", "finite"),
        ('{"captured_after": "2026-11-16T09:30:00"}', "filter.captured_after", "timezone"),
        ('{"captured_after": "2026-11-16T09:30:00Z", "captured_before": "2026-11-16T09:29:59Z"}',
         "filter.captured_before", "earlier than `captured_after`"),
        ('{"tags": [' + '"a",' * 32 + '"a"]}', "filter.tags", "at most 32"),
        ('{"exclude_frames": [' + '"a",' * 1000 + '"a"]}', "filter.exclude_frames", "1000"),
        ('{"region": {"parent_frame": "house", "min": {"x": 0, "y": 1, "z": 0}, "max": {"x": 1, '
         '"y": 0, "z": 1}}}', "filter.region.max", "y: less than in `min`"),
        ('{"region": {"parent_frame": "house", "min": {"x": 0, "y": 1, "z": Infinity}, "max": '
         '{"x": 1, "y": 1, "z": 1}}}', "filter.region.min.z", "finite"),
        ('{"region": {"min": {"x": 0, "y": 1, "z": 0}, "max": {"x": 1, "y": 1, "z": 1}}}',
         "filter.region.parent_frame", "required"),
        ("[" * 5000, "filter", "not JSON"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_named(served, rooms, shots, refused, given, field, text):
    problem = refused(by_form(served, rooms, shots[0], given), 422, "invalid-request")
    assert [one["field"] for one in problem["errors"]] == [field]
    assert text in problem["errors"][0]["reason"]


def test_a_frame_is_kept_only_where_the_map_lacks_its_place(
    served, make_map, shots, refused, until
):
    path = make_map(served, "novel")
    wait = {"Prefer": "wait=60"}

    def send(shot, if_novel: str, headers: dict[str, str]) -> Any:
        form = shot.form()
        form["data"]["if_novel"] = if_novel
        return served.client.post(f"{path}/frames", **form, headers=headers)

    first = send(shots[0], "true", wait)
    assert (first.status_code, first.json()["state"]) == (201, "indexed")
    second = send(shots[1], "1", wait)
    told = second.json()
    assert (second.status_code, told["state"]) == (201, "redundant")
    assert first.json()["frame_id"] in told["reason"]
    assert "the map already has this place" in told["reason"]
    frame = served.client.get(f"{path}/frames/{told['frame_id']}").json()
    assert (frame["state"], frame["reason"]) == ("redundant", told["reason"])
    listed = served.client.get(f"{path}/frames?state=redundant").json()["items"]
    assert [one["frame_id"] for one in listed] == [told["frame_id"]]
    assert served.client.get(path).json()["frames"] == {"indexed": 1, "redundant": 1}
    assert served.client.get(f"/v1/jobs/{told['job_id']}").json()["state"] == "succeeded"
    figures = served.client.get("/metrics").text
    assert any(
        line.startswith('sceneprint_frames{state="redundant"}') and float(line.split()[-1]) >= 1
        for line in figures.splitlines()
    )
    asked = served.client.post(f"{path}/queries", json={"frame_id": told["frame_id"]})
    refused(asked, 422, "invalid-request", "is redundant: Not kept, as asked")
    again = send(shots[1], "false", {})  # it is sent once more, and to be kept
    assert (again.status_code, again.json()["frame_id"]) == (202, told["frame_id"])
    url = f"{path}/frames/{told['frame_id']}"
    until(lambda: served.client.get(url).json()["state"] == "indexed")
    for wrong in ("0", "2", "nan", "maybe", ""):
        problem = refused(send(shots[2], wrong, {}), 422, "invalid-request", "`if_novel` is")
        assert [one["field"] for one in problem["errors"]] == ["if_novel"]
