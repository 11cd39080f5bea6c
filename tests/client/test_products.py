"""Tests of operations that all products of maps share, by client and HTTP."""

import httpx
import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import UnknownJob, UnknownMap
from sceneprint_client.api import JobState
from sceneprint_client.api.coverage import MapCoverage
from sceneprint_client.api.sessions import SAME, Association, Difference

MAP = "produced"


@pytest.fixture
def client(produced):
    return produced


@pytest.mark.parametrize(
    ("kind", "job_kind", "request_", "bad", "steps"),
    [
        (MapCoverage, "coverage", {"not_within_s": 0}, {"every": 0}, 4),
        (Association, "associate", {"sessions": ["a", "b"]}, {"sessions": ["a", "b", "c"]}, 2),
        (Difference, "difference", {"before": "a", "after": "b"}, {"before": "a"}, 8),
    ],
)
def test_a_product_from_request_to_deletion(
    client, service_url, kind, job_kind, request_, bad, steps
):
    root = f"/v1/maps/{MAP}/{kind.collection}"
    with httpx.Client(base_url=service_url, trust_env=False, timeout=PATIENCE_S) as http:
        first, second = (http.post(root, json=request_) for _ in range(2))
        assert (first.status_code, first.json()["progress"]["total"]) == (202, steps)
        seen = []
        done = client.wait_for_product(
            kind.model_validate(first.json()), progress=lambda *step: seen.append(step)
        )
        assert (done.state, seen[-1]) == (JobState.SUCCEEDED, (steps, steps))
        assert client.product(kind, MAP, done.job_id) == done
        place = first.headers["Location"]
        assert place == f"{root}/{done.job_id}"
        assert http.get(f"/v1/jobs/{done.job_id}").json()["kind"] == job_kind
        ids = [second.json()["job_id"], done.job_id]
        page = http.get(root, params={"limit": 1}).json()
        rest = http.get(root, params={"cursor": page["next_cursor"]}).json()
        assert [item["job_id"] for item in page["items"] + rest["items"]] == ids
        for status, method, path, more in (
            (404, "GET", f"{root}/{'0' * 32}", {}),
            (404, "GET", f"/v1/maps/nowhere/{kind.collection}/{done.job_id}", {}),
            (404, "DELETE", f"{root}/nothing", {}),
            (422, "GET", root, {"params": {"cursor": "x"}}),
            (422, "POST", root, {"json": bad}),
            (422, "POST", root, {"json": []}),
            (415, "POST", root, {"content": b"every=5"}),
            (400, "POST", root, {"content": b"{", "headers": {"Content-Type": "application/json"}}),
        ):
            refused = http.request(method, path, **more)
            assert refused.status_code == status, (method, path, refused.text)
            assert refused.headers["Content-Type"] == "application/problem+json"
        client.delete_product(kind, MAP, ids[0])
        assert [product.job_id for product in client.products(kind, MAP)] == ids[1:]
        assert http.delete(place).status_code == 204
    for name in (done.job_id, "../jobs"):
        with pytest.raises(UnknownJob, match=f"no {kind.noun} "):
            client.product(kind, MAP, name)
    with pytest.raises(UnknownMap):
        next(client.products(kind, "nowhere"))


def test_the_cells_of_a_difference_are_sent(client):
    job = client.compute(Difference, MAP, before="a", after="b")
    result = job.result
    assert result.same > 500
    assert (result.parent_frame, result.frames_before, result.frames_after) == ("room", 2, 2)
    actual = client.difference_points(MAP, job.job_id)
    assert actual.patches is not None
    assert (actual.patches == SAME).sum() == result.same
    assert (np.diff(actual.patches) >= 0).all()


def test_frames_and_changes_of_coverage(client):
    first, second = (
        client.compute(MapCoverage, MAP, not_within_s=0.0, cell_m=0.5) for _ in range(2)
    )
    assert (first.result.frames, first.result.found) == (4, 4)
    frames = list(client.coverage_frames(MAP, first.job_id))
    assert {frame.frame_id for frame in frames} == {frame.frame_id for frame in client.frames(MAP)}
    assert list(client.coverage_frames(MAP, first.job_id, "not_found")) == []
    changes = client.coverage_changes(MAP, second.job_id, first.job_id)
    assert set(changes.trends) - {"same"} == {"better", "worse", "new", "gone"}
    assert changes.trends["same"] == sum(len(plan.cells) for plan in changes.plans) > 0
