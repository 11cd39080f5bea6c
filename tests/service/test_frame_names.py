"""Tests of frame names and sequence numbers in forms, query strings, lists and imports."""

import json

import pytest


def test_names_are_sent_in_every_way_and_searched(served, make_map, small_shots):
    path, ask = make_map(served, "frame-names"), served.client
    one, two, three, four = small_shots[:4]
    sent = ask.post(f"{path}/frames", **one.form(session="s", name="depth/2.png", sequence=2))
    assert sent.status_code == 202, sent.text
    query = {**two.camera, "session": "s", "name": "depth/1.png", "sequence": "1"}
    headers = {"Content-Type": "image/png"}
    sent = ask.post(f"{path}/frames", params=query, content=two.png, headers=headers)
    assert sent.status_code == 202, sent.text
    metas = [
        {"intrinsics": shot.camera, "session": "s", "name": name, "sequence": i}
        for i, (shot, name) in enumerate(((three, "depth/10.png"), (four, "Depth/1.png")), 3)
    ]
    files = [("frame", ("f", shot.png, "image/png")) for shot in (three, four)]
    batch = ask.post(f"{path}/frames/batch", files=files, data={"metas": json.dumps(metas)})
    assert [item["status"] for item in batch.json()["items"]] == [202, 202]

    def names(**wanted):
        listed = ask.get(f"{path}/frames", params=wanted)
        assert listed.status_code == 200, listed.text
        return [frame["name"] for frame in listed.json()["items"]]

    assert names(name="depth/1") == ["depth/1.png", "depth/10.png"]
    assert names(name="depth/1.png") == ["depth/1.png"]
    assert names(name="1.png") == []
    taken = ["depth/1.png", "depth/2.png", "depth/10.png", "Depth/1.png"]
    assert names(session="s", order="taken") == taken
    first = ask.get(f"{path}/frames", params={"session": "s", "order": "taken", "limit": 3}).json()
    assert names(session="s", order="taken", cursor=first["next_cursor"]) == taken[3:]


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
