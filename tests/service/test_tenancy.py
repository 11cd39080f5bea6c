"""Tests of tenants: quotas that only operators set, retention and permanent deletion.

They use HTTP with keys on both databases, and execute the jobs in this process.
"""

import json

KEYS = {
    "boss": {"*": "admin"}, "tenant": {"alpha": "admin", "later": "admin"},
    "robot": {"alpha": "write"}, "other": {"bravo": "admin"},
}  # fmt: skip


def test_a_quota_is_the_operators(house, refused):
    path = "/v1/maps/alpha"
    for body in ({"quota_frames": 10}, {"quota_bytes": None}, {"title": "x", "quota_frames": 1}):
        for key in ("tenant", "robot"):
            answer = house.ask(key, "PATCH", path, json=body)
            refused(answer, 403, "forbidden", "'admin' for")
        refused(house.ask("other", "PATCH", path, json=body), 404, "unknown-map")
    assert house.ask("tenant", "GET", path).json()["title"] is None
    row = house.ask("boss", "PATCH", path, json={"quota_frames": 10, "quota_bytes": 10**9}).json()
    assert (row["quota_frames"], row["quota_bytes"], row["used_frames"]) == (10, 10**9, 0)
    new = {"name": "later", "model": "depth"}
    refused(
        house.ask("tenant", "POST", "/v1/maps", json=new | {"quota_frames": 5}), 403, "forbidden"
    )
    assert (
        house.ask("tenant", "POST", "/v1/maps", json=new | {"retention_days": 5}).status_code == 201
    )
    # and it is not lost by deleting the map and making it anew
    assert house.ask("tenant", "DELETE", path).status_code == 204
    created = house.ask("tenant", "POST", "/v1/maps", json={"name": "alpha", "model": "depth"})
    assert (created.status_code, created.json()["quota_frames"]) == (201, 10)
    audited = house.ask("boss", "GET", "/v1/audit").json()["items"]
    [change] = [line for line in audited if line["action"] == "map.edited"]
    assert (change["actor"], change["map"]) == ("boss", "alpha")
    assert change["data"] == {
        "fields": ["quota_bytes", "quota_frames"], "quota_bytes": 10**9, "quota_frames": 10
    }  # fmt: skip


def test_beyond_the_quota_nothing_is_taken(house, refused, small_shots):
    path, (a, b, c, *_) = "/v1/maps/alpha/frames", small_shots
    house.ask("boss", "PATCH", "/v1/maps/alpha", json={"quota_frames": 2})
    assert house.ask("robot", "POST", path, **a.form()).status_code == 202
    batch = {
        "files": [("frame", ("f.png", shot.png, "image/png")) for shot in (a, b, c)],
        "data": {"metas": json.dumps({"intrinsics": a.camera})},
    }
    items = house.ask("robot", "POST", f"{path}/batch", **batch).json()["items"]
    assert [item["status"] for item in items] == [200, 202, 403]
    assert items[2]["problem"]["type"] == "/problems/quota-exceeded"
    for method, place in (("POST", path), ("PUT", f"{path}/mine")):
        answer = house.ask("robot", method, place, **c.form())
        refused(answer, 403, "quota-exceeded", "has 2 frames, and its quota is 2")
    assert house.ask("robot", "GET", f"{path}/mine").status_code == 404
    record = house.ask("tenant", "GET", "/v1/maps/alpha").json()
    assert (record["used_frames"], record["used_bytes"]) == (2, len(a.png) + len(b.png))
    # of another's use nobody is told
    assert [map_["name"] for map_ in house.ask("other", "GET", "/v1/maps").json()["items"]] == [
        "bravo"
    ]
    other = house.ask("other", "GET", "/v1/maps/bravo").json()
    assert (other["used_frames"], other["quota_frames"]) == (0, None)


def test_a_frame_that_is_there_and_not_signed_yet_is_waited_for(house, small_shots):
    """Sent again by a robot that lost the first answer."""
    path, form = "/v1/maps/alpha/frames", small_shots[0].form()
    first = house.ask("robot", "POST", path, **form)
    assert (first.status_code, first.headers.get("preference-applied")) == (202, None)
    again = house.ask("robot", "POST", path, headers={"Prefer": "wait=1"}, **form)
    assert (again.status_code, again.headers["preference-applied"]) == (200, "wait=1")
    assert again.json() == first.json()
    assert again.json()["state"] == "received"


def test_retention_is_tried_set_and_told(house, small_shots):
    path = "/v1/maps/alpha"
    house.ask("robot", "POST", f"{path}/frames", **small_shots[0].form())
    tried = house.ask("tenant", "PATCH", f"{path}?dry_run=true", json={"retention_days": 1e-9})
    assert (tried.json()["overdue"], tried.json()["retention_days"]) == (1, 1e-9)
    assert house.ask("tenant", "GET", path).json()["retention_days"] is None
    assert house.ask("robot", "PATCH", path, json={"retention_days": 1}).status_code == 403
    assert house.ask("tenant", "PATCH", path, json={"retention_days": 1e-9}).json()["overdue"] == 1
