"""Tests that every operation that changes data writes to the audit log."""

import io
import json
import zipfile

import pytest

pytestmark = pytest.mark.thorough

#: Operations that store nothing but an answer.
READING = {
    "ask", "ask_several", "compare", "copy_map", "localize", "localize_sequence",
}  # fmt: skip


class Recorder:
    """Sends requests and finds the lines of the audit log that each one wrote."""

    def __init__(self, client):
        self._client, self._sent = client, 0
        self.tried: set[str] = set()
        document = client.get("/openapi.json").json()
        self.operations = {
            operation["operationId"]: (method.upper(), path)
            for path, methods in document["paths"].items()
            for method, operation in methods.items()
        }

    def do(self, name, wanted, path, **more):
        """Send a request; its answer. The actions of its lines must be the wanted ones."""
        self._sent += 1
        request_id = f"audited-{self._sent}"
        headers = {"X-Request-Id": request_id, **more.pop("headers", {})}
        method, pattern = self.operations[name]
        answer = self._client.request(method, pattern.format(**path), headers=headers, **more)
        assert answer.is_success, (name, answer.text)
        lines = self._client.get("/v1/audit", params={"limit": 1000}).json()["items"]
        result = [line for line in reversed(lines) if line["request_id"] == request_id]
        assert [item["action"] for item in result] == wanted, name
        assert {item["address"] for item in result} <= {"127.0.0.1"}
        self.tried.add(name)
        return answer


@pytest.fixture(scope="module")
def recorder(begin):
    return Recorder(begin().client)


def pose_of(x):
    return {
        "parent_frame": "hall", "translation": {"x": x, "y": 0, "z": 0},
        "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
    }  # fmt: skip


def test_each_change_has_its_lines(recorder, small_shots, until):
    do, client, hall = recorder.do, recorder._client, {"map_name": "hall"}

    def state(job_id):
        return str(client.get(f"/v1/jobs/{job_id}").json()["state"])

    def job_of(answer):
        return {**hall, "job_id": answer.headers["location"].rpartition("/")[2]}

    do("create_map", ["map.created"], {}, json={"name": "hall", "model": "depth"})
    do("create_map", [], {}, json={"name": "hall", "model": "depth"})  # it is there
    do("patch_map", ["map.edited"], hall, json={"title": "Hall"})
    do("patch_map", [], hall, json={"title": "Hall"})
    forms = [
        shot.form(session=f"s{i // 2}", pose=pose_of(i), captured_at=f"2026-11-16T09:30:0{i}Z")
        for i, shot in enumerate(small_shots[:4])
    ]
    wait = {"Prefer": "wait=200"}
    taken = [
        do("add_frame", ["frame.received"], hall, headers=wait, **form).json()["frame_id"]
        for form in forms
    ]
    do("add_frame", [], hall, **forms[0])  # nor has a duplicate a line
    frame = {**hall, "frame_id": taken[0]}
    put = {**hall, "frame_id": "mine"}
    do("put_frame", ["frame.received"], put, **small_shots[4].form())
    do("patch_frame", ["frame.edited"], frame, json={"tags": ["a"]})
    do("edit_frames", ["frame.edited"] * 2, hall, json={"frame_ids": taken[:2], "add_tags": ["b"]})
    session = {"params": {"session": "s1"}}
    do("patch_session", ["frame.edited"] * 2, hall, json={"add_tags": ["c"]}, **session)
    do("delete_frame", ["frame.deleted"], put)
    do("restore_frame", ["frame.restored"], put)
    done = do("delete_frames", ["frame.deleted"], hall, json={"frame_ids": ["mine"]}).json()
    deletion = {**hall, "deletion_id": done["deletion"]["deletion_id"]}
    do("restore_deletion", ["frame.restored"], deletion)
    query = client.post("/v1/maps/hall/queries", json={"frame_id": taken[0]}).json()["query_id"]
    answer = {"query_id": query}
    do("keep_answer", ["answer.kept"], answer, json={})
    do("release_answer", ["answer.released"], answer)
    query = client.post("/v1/maps/hall/queries", json={"frame_id": taken[0]}).json()["query_id"]
    fused = do("reconstruct", ["job.queued"], {"query_id": query}, json={})
    do("delete_reconstruction", ["job.removed"], job_of(fused))
    do("delete_queries", ["queries.removed"], {}, params={"map": "hall"})
    for kind, body in (
        ("association", {"sessions": ["s0", "s1"]}), ("coverage", {}),
        ("difference", {"before": "s0", "after": "s1"}),
    ):  # fmt: skip
        begun = job_of(do(f"begin_{kind}", ["job.queued"], hall, json=body))
        until(lambda of=begun["job_id"]: state(of) in ("succeeded", "failed"))
        if kind == "association":
            do("undo_join", [], begun)  # there is none
        do(f"delete_{kind}", ["job.removed"], begun)
    do("delete_surface", ["surface.removed"], hall)
    do("begin_surface", ["surface.requested"], hall)
    key = {"key_name": "robot"}
    do("create_key", ["key.created"], {}, json={"name": "robot", "grants": {"hall": "read"}})
    do("rotate_key", ["key.rotated"], key)
    do("revoke_key", ["key.revoked"], key)
    do("delete_session_frames", ["frame.deleted"] * 2, hall, **session)
    do("delete_map", ["map.deleted"], hall)


def test_each_change_of_a_job_has_its_line(begin, recorder, small_shots):
    """Without a worker, so that they wait."""
    idle = Recorder(begin("--workers", "0").client)
    hall = {"map_name": "hall"}
    idle.do("create_map", ["map.created"], {}, json={"name": "hall", "model": "depth"})
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a.png", small_shots[0].png)
    job = idle.do(
        "add_import", ["job.queued"], hall, content=data.getvalue(),
        headers={"Content-Type": "application/zip"},
    ).json()["job_id"]  # fmt: skip
    idle.do("cancel_job", ["job.cancelled"], {"job_id": job})
    idle.do("cancel_job", [], {"job_id": job})
    idle.do("retry_job", ["job.retried"], {"job_id": job})
    idle.do("retry_dead_jobs", [], {})
    signing = idle.do("add_frame", ["frame.received"], hall, **small_shots[0].form())
    sign = {"job_id": signing.json()["job_id"]}
    idle.do("cancel_job", ["job.cancelled", "frame.failed"], sign)
    idle.do("retry_job", ["job.retried", "frame.received"], sign)
    parts = [("frame", ("frame.png", shot.png)) for shot in small_shots[1:3]]
    meta = {"metas": json.dumps([{"intrinsics": small_shots[1].camera}] * 2)}
    idle.do("add_batch", ["frame.received"] * 2, hall, files=parts, data=meta)
    idle.do("reencode", ["map.reencoding"], hall, json={"model": "paper"})
    idle.do("reencode", ["map.reencoding_retried"], hall, json={"model": "paper"})
    idle.do("cancel_reencoding", ["map.reencoding_cancelled"], hall)
    recorder.tried |= idle.tried


def test_no_operation_was_left_out(recorder):
    changing = {name for name, (method, _) in recorder.operations.items() if method != "GET"}
    assert changing - READING - recorder.tried == set()
