"""Tests of filters and `if_novel` over HTTP, in forms and JSON; errors name the field."""

from __future__ import annotations

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
            f"{path}/frames", **shot.form(**meta), headers={"Prefer": "wait=200"}
        )
        assert sent.json()["state"] == "indexed"
        ids.append(sent.json()["frame_id"])
    return {"path": path, "ids": ids}


def by_form(served, rooms, shot, given: str, **meta: object) -> Any:
    form = shot.form(**meta)
    form["data"] |= {"stages": "retrieve", "k": "50", "filter": given}
    return served.client.post(f"{rooms['path']}/queries", **form)


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
