"""Tests of frame names and sequence numbers that are refused."""

import pytest


@pytest.mark.parametrize(
    ("meta", "field"),
    [
        ({"name": "../a"}, "name"), ({"name": "/a"}, "name"), ({"name": "a" * 256}, "name"),
        ({"sequence": -1}, "sequence"),
        ({"sequence": 2**53}, "sequence"), ({"sequence": 0.5}, "sequence"),
    ],
)  # fmt: skip
def test_what_is_no_name_or_place_is_refused(served, refused, small_shots, meta, field):
    answer = served.client.post("/v1/maps/unmade/frames", **small_shots[0].form(**meta))
    problem = refused(answer, 422, "invalid-request")
    assert problem["errors"][0]["field"].split(".")[-1] == field


def test_lists_refuse_what_they_cannot_have(served, make_map, refused):
    path = make_map(served, "unordered")
    for more in ({}, {"session": ["a", "b"]}):
        answer = served.client.get(f"{path}/frames", params={"order": "taken", **more})
        refused(answer, 422, "invalid-request", "order")
    for name in ("", "a\0", "a" * 256):
        refused(served.client.get(f"{path}/frames", params={"name": name}), 422, "invalid-request")
