"""Coverage by client and raw HTTP."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest, JobOver, NotIndexed, UnknownJob, UnknownMap
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.coverage import (
    MapCoverage,
    NewMapCoverage,
)

MAP = "covered"


@pytest.fixture(scope="module")
def covered(
    service_url: str, walk: Callable[..., list[tuple[bytes, FrameMeta]]]
) -> Iterator[Client]:
    """A client of a map with four frames along a path, a second apart."""
    with Client(service_url) as client:
        client.create_map(MAP, model="depth")
        jobs = [client.upload(MAP, *frame).job_id for frame in walk()]
        assert {job.state for job in client.wait(jobs)} == {JobState.SUCCEEDED}
        yield client


@pytest.fixture(scope="module")
def whole(covered: Client) -> MapCoverage:
    steps: list[tuple[int, int]] = []
    told = covered.coverage(MAP, not_within_s=0.0, cell_m=0.5, progress=lambda *n: steps.append(n))
    assert told.state is JobState.SUCCEEDED
    assert steps[-1] == (4, 4)
    return told


def test_a_result_with_its_frames_plan_and_changes(covered: Client, whole: MapCoverage) -> None:
    of = MAP, whole.coverage_id
    assert covered.coverage_result(*of) == whole
    assert whole.result is not None
    assert (whole.result.frames, whole.result.found) == (4, 4)
    frames = list(covered.coverage_frames(*of))
    assert {frame.frame_id for frame in frames} == {one.frame_id for one in covered.frames(MAP)}
    assert list(covered.coverage_frames(*of, "not_found")) == []
    again = covered.coverage(MAP, like=whole)
    assert (again.result, again.plans) == (whole.result, whole.plans)
    told = covered.coverage_changes(MAP, again.coverage_id, whole.coverage_id)
    assert set(told.trends) - {"same"} == {"better", "worse", "new", "gone"}
    assert told.trends["same"] == sum(len(plan.cells) for plan in told.plans) > 0
    listed = [one.coverage_id for one in covered.coverage_jobs(MAP)]
    assert listed[:2] == [again.coverage_id, whole.coverage_id]
    covered.delete_coverage(MAP, again.coverage_id)
    assert again.coverage_id not in [one.coverage_id for one in covered.coverage_jobs(MAP)]


def test_refusals(covered: Client, whole: MapCoverage) -> None:
    for name in ("0" * 32, "../jobs"):
        with pytest.raises(UnknownJob):
            covered.coverage_result(MAP, name)
    with pytest.raises(UnknownMap):
        covered.coverage("nowhere")
    with pytest.raises(InvalidRequest, match="no indexed frame"):
        covered.coverage(MAP, session="nobody")
    with pytest.raises(InvalidRequest, match="every"):
        covered.coverage(MAP, every=0)
    for _ in range(20):
        begun = covered.coverage(MAP, timeout_s=0)
        try:
            covered.cancel_job(begun.coverage_id)
            break
        except JobOver:  # the worker was faster
            covered.delete_coverage(MAP, begun.coverage_id)
    with pytest.raises(NotIndexed, match="is cancelled"):
        covered.coverage_changes(MAP, begun.coverage_id, whole.coverage_id)
    covered.delete_coverage(MAP, begun.coverage_id)


def test_over_http(covered: Client, whole: MapCoverage, service_url: str) -> None:
    root = f"/v1/maps/{MAP}/coverage"
    with httpx.Client(base_url=service_url, trust_env=False, timeout=PATIENCE_S) as http:
        begun = http.post(root)  # without a body: the defaults
        assert begun.status_code == 202
        place = begun.headers["Location"]
        assert place == f"{root}/{begun.json()['coverage_id']}"
        assert begun.json()["asked"] == NewMapCoverage().model_dump(mode="json")
        done = covered.wait_for_coverage(MapCoverage.model_validate(begun.json()))
        assert done.result is not None
        assert done.result.not_found == 4  # all within ten seconds
        job = http.get(f"/v1/jobs/{done.coverage_id}").json()
        assert (job["kind"], job["priority"]) == ("coverage", -11)
        page = http.get(f"{root}/{whole.coverage_id}/frames", params={"limit": 3}).json()
        assert [frame["number"] for frame in page["items"]] == [0, 1, 2]
        rest = {"cursor": page["next_cursor"]}
        rest_of = http.get(f"{root}/{whole.coverage_id}/frames", params=rest).json()
        assert [frame["number"] for frame in rest_of["items"]] == [3]
        since = {"since": done.coverage_id}
        for status, method, path, more in (
            (404, "GET", f"{root}/{'0' * 32}", {}),
            (404, "DELETE", f"{root}/nothing", {}),
            (422, "GET", f"{root}/{whole.coverage_id}/frames", {"params": {"outcome": "lost"}}),
            (422, "GET", f"{root}/{whole.coverage_id}/changes", {}),
            (422, "GET", f"{root}/{whole.coverage_id}/changes", {"params": since}),
            (422, "POST", root, {"json": {"every": 0}}),
            (422, "POST", root, {"json": []}),
            (415, "POST", root, {"content": b"every=5"}),
            (400, "POST", root, {"content": b"{", "headers": {"Content-Type": "application/json"}}),
        ):
            refused = http.request(method, path, **more)
            assert refused.status_code == status, (method, path, refused.text)
            assert refused.headers["Content-Type"] == "application/problem+json"
        assert http.delete(place).status_code == 204
        assert http.get(place).status_code == 404
