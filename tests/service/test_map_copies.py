"""Tests of the copies of a map that a service sends, on both databases."""

import base64
import json
import zlib
from hashlib import sha256

from sceneprint.models import parse_model, read_model

KEYS = {
    "boss": {"*": "admin"}, "reader": {"alpha": "read"}, "other": {"bravo": "admin"},
}  # fmt: skip
ALPHA = "/v1/maps/alpha"


def test_a_reader_copies_what_is_indexed_and_nothing_else(house, small_shots, refused):
    sent = [
        house.ask("boss", "POST", f"{ALPHA}/frames", **shot.form(tags=["b", "a"]))
        for shot in small_shots[:3]
    ]
    ids = [answer.json()["frame_id"] for answer in sent]
    house.work()
    house.ask("boss", "DELETE", f"{ALPHA}/frames/{ids[2]}")
    house.ask("boss", "POST", f"{ALPHA}/frames", **small_shots[3].form())

    def get(path, key="reader"):
        return house.ask(key, "GET", f"{ALPHA}/copy{path}")

    def copy(key="reader", **body):
        return house.ask(key, "POST", f"{ALPHA}/copy", json=body)

    def rows_of(answer):
        """The head of a copy, and the rows of its one part."""
        assert answer.headers["content-type"] == "application/octet-stream"
        line, _, data = answer.content.partition(b"\n")
        head = json.loads(line)
        [part] = head["parts"]
        assert part["sent"]
        assert (sha256(data).hexdigest(), len(data)) == (part["digest"], part["bytes"])
        names, *rows = [json.loads(part) for part in zlib.decompress(data).split(b"\n")]
        assert len(rows) == part["rows"]
        return head, [dict(zip(names, row, strict=True)) for row in rows]

    head, rows = rows_of(copy())
    model = read_model("depth")
    assert (head["name"], head["model_id"], head["revision"]) == ("alpha", model.id, 4)
    assert [row["id"] for row in rows] == ids[:2]  # of what waits and what is deleted, nothing
    for row in rows:
        assert len(base64.b64decode(row["vector"])) == model.signature_bytes
        data = get(f"/artifacts/{row['geometry']}")
        assert data.headers["content-type"] == "application/octet-stream"
        assert sha256(data.content).hexdigest() == row["geometry"]
    assert json.loads(rows[1]["tags"]) == ["b", "a"]
    assert parse_model(get("/model").content, "copy").id == model.id
    # what the caller has is not sent; each change makes another part
    digest = head["parts"][0]["digest"]
    line, _, data = copy(have=[digest]).content.partition(b"\n")
    assert json.loads(line)["parts"] == [head["parts"][0] | {"sent": False}]
    assert data == b""
    house.ask("boss", "PATCH", f"{ALPHA}/frames/{ids[0]}", json={"tags": ["c"]},
              headers={"Content-Type": "application/merge-patch+json"})  # fmt: skip
    changed, rows = rows_of(copy(have=[digest]))
    assert changed["parts"][0]["digest"] != digest
    assert rows[0]["tags"] == '["c"]'
    refused(get(f"/artifacts/{rows[0]['blob']}"), 404, "not-found")  # an upload is no artifact
    refused(get("/artifacts/x"), 422, "invalid-request")
    refused(copy(have=["x"]), 422, "invalid-request")
    refused(copy(have=["0" * 64] * 3_501), 422, "invalid-request")
    refused(copy(key="other"), 404, "unknown-map")
    assert house.ask("boss", "POST", "/v1/maps/bravo/copy", json={}).status_code == 200
    for path in (f"/artifacts/{rows[0]['geometry']}", "/model"):
        refused(get(path, key="other"), 404, "unknown-map")
        other = house.ask("boss", "GET", f"/v1/maps/bravo/copy{path}")
        assert other.status_code == (404 if "artifacts" in path else 200)
