"""What a service tells of a map to who copies it, on both databases."""

from __future__ import annotations

from hashlib import sha256
from typing import Any

from sceneprint.engine.maps.map_copy import copy_tag, row_values
from sceneprint.models import read_model
from sceneprint_client.api.admin import Scope
from sceneprint_client.api.copies import FrameRowRecord

KEYS: dict[str, dict[str, Scope]] = {
    "boss": {"*": "admin"}, "reader": {"alpha": "read"}, "other": {"bravo": "admin"},
}  # fmt: skip
ALPHA = "/v1/maps/alpha"


def test_a_reader_copies_what_is_indexed_and_nothing_else(house, small_shots, refused):
    meta = {
        "session": "s", "robot": "spot", "tags": ["b", "a"], "up": [0, -1, 0], "sequence": 3,
        "captured_at": "2026-11-16T09:30:00.123Z", "name": "a/b.png",
        "pose": {
            "parent_frame": "room", "translation": {"x": 0.1, "y": 2, "z": -3.7},
            "rotation": {"x": 0, "y": 0, "z": 0.6, "w": 0.8},
        },
    }  # fmt: skip
    ids = []
    for number, shot in enumerate(small_shots[:3]):
        known = meta if number else {}
        sent = house.ask("boss", "POST", f"{ALPHA}/frames", **shot.form(**known))
        ids.append(sent.json()["frame_id"])
    house.work()
    house.ask("boss", "DELETE", f"{ALPHA}/frames/{ids[2]}")
    waiting = house.ask("boss", "POST", f"{ALPHA}/frames", **small_shots[3].form())

    def get(path: str, key: str = "reader", **params: Any) -> Any:
        return house.ask(key, "GET", f"{ALPHA}/copy{path}", params=params)

    part = get("", limit=1).json()
    rest = get("", limit=1, cursor=part["next_cursor"]).json()
    assert [one["frame_id"] for one in part["items"] + rest["items"]] == ids[:2]
    assert rest["next_cursor"] is None
    model = read_model("depth")
    assert (part["name"], part["model_id"], part["revision"]) == ("alpha", model.id, 4)
    asked = [*ids, waiting.json()["frame_id"], "nothing"]
    rows = get("/frames", frame_id=asked).json()["items"]
    assert [one["frame_id"] for one in rows] == ids[:2]
    for listed, told in zip(part["items"] + rest["items"], rows, strict=True):
        row = FrameRowRecord.model_validate(told)
        assert copy_tag(row_values(row)) == listed["tag"]  # the same after its way through JSON
        assert len(row.vector) == model.signature_bytes
        data = get(f"/artifacts/{row.geometry}")
        assert data.headers["content-type"] == "application/octet-stream"
        assert sha256(data.content).hexdigest() == row.geometry
    assert rows[1]["tags"] == ["b", "a"]
    # each change has another tag
    before = part["items"][0]["tag"]
    house.ask("boss", "PATCH", f"{ALPHA}/frames/{ids[0]}", json={"tags": ["c"]},
              headers={"Content-Type": "application/merge-patch+json"})  # fmt: skip
    assert get("", limit=1).json()["items"][0]["tag"] != before
    assert sha256(get("/model").content).hexdigest() != before
    assert get("/model").status_code == 200

    upload = get("/frames", frame_id=ids[0]).json()["items"][0]["blob"]
    refused(get(f"/artifacts/{upload}"), 404, "not-found")  # an upload is no artifact
    refused(get("/artifacts/x"), 422, "invalid-request")
    refused(get("/frames"), 422, "invalid-request")
    refused(get("/frames", frame_id=["x"] * 51), 422, "invalid-request")
    refused(get("/frames", frame_id="x" * 65), 422, "invalid-request")
    refused(get("", cursor="x"), 422, "invalid-request")
    refused(get("", limit=1001), 422, "invalid-request")
    for path in ("", "/frames?frame_id=x", f"/artifacts/{rows[0]['geometry']}", "/model"):
        refused(get(path, key="other"), 404, "unknown-map")
        other = house.ask("boss", "GET", f"/v1/maps/bravo/copy{path}")
        assert other.status_code == (404 if "artifacts" in path else 200)
