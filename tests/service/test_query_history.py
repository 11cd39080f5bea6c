"""The history of queries over HTTP: what each leaves, who may list it, and what leaves none.

On both databases; a service without workers, whose jobs are done here.
"""

from __future__ import annotations

import json
from typing import Any

from sceneprint_client.api.admin import Scope

KEYS: dict[str, dict[str, Scope]] = {
    "boss": {"*": "admin"}, "robot": {"alpha": "write"}, "other": {"bravo": "admin"},
    "both": {"alpha": "read", "bravo": "read"},
}  # fmt: skip
ALPHA = "/v1/maps/alpha"


def listed(house: Any, key: str, **params: Any) -> list[dict[str, Any]]:
    answer = house.ask(key, "GET", "/v1/queries", params=params)
    assert answer.status_code == 200, answer.text
    items: list[dict[str, Any]] = answer.json()["items"]
    return items


def test_each_query_leaves_a_record_of_what_came_of_it(house, shots, refused):
    ids = []
    for shot in shots[:2]:
        pose = {"parent_frame": "room", "matrix": shot.pose}
        sent = house.ask("robot", "POST", f"{ALPHA}/frames", **shot.form(pose=pose, session="s"))
        ids.append(sent.json()["frame_id"])
    house.work()
    mine = {"robot": "spot", "session": "monday"}
    found = house.ask("robot", "POST", f"{ALPHA}/queries", **shots[0].form(**mine))
    assert found.json()["status"] == "found", found.text
    lost = house.ask("robot", "POST", f"{ALPHA}/localize", **shots[2].form(robot="cart"))
    assert lost.json()["status"] == "not_found", lost.text
    odometry = {"parent_frame": "odom", "matrix": shots[0].pose}
    meta = {"intrinsics": shots[0].camera, "pose": odometry, **mine}
    parts = [("frame", (f"{i}.png", shots[0].png, "image/png")) for i in range(2)]
    several = house.ask(
        "both", "POST", f"{ALPHA}/localize/sequence",
        data={"metas": json.dumps([meta, meta])}, files=parts,
    )  # fmt: skip
    body = {"frame_id": ids[0], "robot": "arm", "stages": "retrieve"}
    ranked = house.ask("robot", "POST", f"{ALPHA}/queries", json=body).json()
    assert ranked["status"] == "unvalidated"
    broken = shots[0].form(robot="cart")
    broken["files"]["frame"] = ("frame.png", shots[0].png[:-400], "image/png")
    refused(house.ask("robot", "POST", f"{ALPHA}/queries", **broken), 422, "unreadable-frame")
    everywhere = {"maps": "*", "frame": {"map": "alpha", "frame_id": ids[0]}, "keep": False}
    spread = house.ask("both", "POST", "/v1/queries", json=everywhere).json()

    last, failed, rank, sequence, nowhere, first = listed(house, "robot")
    answer = found.json()
    assert first == {
        "query_id": answer["query_id"], "at": first["at"], "map": "alpha", "maps": ["alpha"],
        "robot": "spot", "session": "monday", "key": "robot", "status": "found", "cause": None,
        "reason": answer["reason"], "support": answer["location"]["support"],
        "confidence": answer["location"]["confidence"],
        "alternatives": 0, "kind": "depth",
        "pose": {
            name: answer["location"]["pose"][name]
            for name in ("parent_frame", "translation", "rotation")
        },
        "milliseconds": first["milliseconds"], "frame": None, "stored": True,
        "expires_at": first["expires_at"], "kept_at": None, "title": None,
    }  # fmt: skip
    assert first["milliseconds"] >= answer["milliseconds"]["total"]
    kept = house.ask("robot", "GET", f"/v1/queries/{first['query_id']}")
    assert (kept.status_code, first["expires_at"] > first["at"]) == (200, True)
    told = lost.json()
    assert (nowhere["query_id"], nowhere["status"], nowhere["robot"], nowhere["pose"]) == (
        told["query_id"], "not_found", "cart", None
    )  # fmt: skip
    assert (nowhere["cause"], nowhere["reason"]) == (told["cause"], told["reason"])
    assert (sequence["query_id"], sequence["key"], sequence["robot"]) == (
        several.json()["query_id"], "both", "spot"
    )  # fmt: skip
    assert (rank["status"], rank["robot"], rank["frame"]) == (
        "unvalidated", "arm", {"map": "alpha", "frame_id": ids[0]}
    )  # fmt: skip
    assert (failed["status"], failed["cause"], failed["stored"], failed["robot"]) == (
        "failed", "unreadable-frame", False, "cart"
    )  # fmt: skip
    assert (last["query_id"], last["map"], last["stored"]) == (
        spread["query_id"], "alpha", False
    )  # fmt: skip
    # who may not read a map is not told that it was asked
    assert (last["maps"], listed(house, "both")[0]["maps"]) == (["alpha"], ["alpha", "bravo"])

    lost_ones = listed(house, "robot", status=["failed", "not_found"])
    assert lost_ones == [last, failed, nowhere]
    assert listed(house, "boss", robot="spot") == [sequence, first]
    assert listed(house, "boss", until=first["at"]) == []
    events = house.ask("robot", "GET", "/v1/events", params={"kind": "query."}).json()["items"]
    assert [one["data"]["query_id"] for one in events] == [
        one["query_id"] for one in listed(house, "robot")
    ]
    assert events[-1]["kind"] == "query.answered"
    assert events[-1]["data"]["pose"] == first["pose"]
    assert events[-1]["data"]["robot"] == "spot"


def test_who_may_read_a_map_may_list_its_queries(house, small_shots, refused):
    shot = small_shots[0]
    for name in ("alpha", "bravo"):
        house.ask("boss", "POST", f"/v1/maps/{name}/frames", **shot.form())
    house.work()
    for name, key in (("alpha", "robot"), ("bravo", "other"), ("alpha", "boss")):
        asked = house.ask(key, "POST", f"/v1/maps/{name}/queries", **shot.form())
        assert asked.status_code == 200, asked.text
    both = [(one["map"], one["key"]) for one in listed(house, "both")]
    assert both == [("alpha", "boss"), ("bravo", "other"), ("alpha", "robot")]
    assert [one["map"] for one in listed(house, "robot")] == ["alpha", "alpha"]
    refused(house.ask("robot", "GET", "/v1/queries", params={"map": "bravo"}), 404, "unknown-map")
    refused(house.ask("boss", "GET", "/v1/queries", params={"map": "cellar"}), 404, "unknown-map")
    for wrong in ({"status": "fine"}, {"since": "2026-11-23T10:00:00"}, {"cursor": "x"}):
        answer = house.ask("boss", "GET", "/v1/queries", params=wrong)
        refused(answer, 422, "invalid-request")
    # none of these leaves a record, an event or a count
    quiet = shot.form()
    quiet["data"] |= {"record": "false"}
    before = listed(house, "boss")
    counted = house.ask("boss", "GET", "/metrics").text
    assert house.ask("robot", "POST", f"{ALPHA}/queries", **quiet).status_code == 200
    repeated = {"maps": ["alpha"], "query_id": before[0]["query_id"], "record": False}
    again = house.ask("boss", "POST", "/v1/queries", json=repeated)
    assert again.status_code == 200
    refused(house.ask("robot", "POST", f"{ALPHA}/queries", json={"frame_id": "x", "k": 0}), 422,
            "invalid-request")  # fmt: skip
    refused(house.ask("robot", "POST", f"{ALPHA}/queries", json={"frame_id": "x", "robot": ""}),
            422, "invalid-request", "robot")  # fmt: skip
    assert listed(house, "boss") == before
    answers = [
        [line for line in text.splitlines() if line.startswith("sceneprint_answers_total")]
        for text in (counted, house.ask("boss", "GET", "/metrics").text)
    ]
    assert answers[0] == answers[1]
    assert "sceneprint_queries_lost_total 0.0" in counted

    delete = {"params": {"map": "alpha"}}
    refused(house.ask("robot", "DELETE", "/v1/queries", **delete), 403, "forbidden")
    assert house.ask("boss", "DELETE", "/v1/queries", **delete).status_code == 204
    assert [one["map"] for one in listed(house, "boss")] == ["bravo"]
    assert house.ask("boss", "DELETE", "/v1/maps/bravo").status_code == 204
    assert listed(house, "boss") == []
