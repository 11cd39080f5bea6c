"""Tests of coverage through the client: results, frames and changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.coverage import MapCoverage

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
    told = covered.compute(
        MapCoverage, MAP, not_within_s=0.0, cell_m=0.5, progress=lambda *n: steps.append(n)
    )
    assert told.state is JobState.SUCCEEDED
    assert steps[-1] == (4, 4)
    return told


def test_a_result_with_its_frames_plan_and_changes(covered: Client, whole: MapCoverage) -> None:
    of = MAP, whole.job_id
    assert whole.result is not None
    assert (whole.result.frames, whole.result.found) == (4, 4)
    frames = list(covered.coverage_frames(*of))
    assert {frame.frame_id for frame in frames} == {one.frame_id for one in covered.frames(MAP)}
    assert list(covered.coverage_frames(*of, "not_found")) == []
    again = covered.compute(MapCoverage, MAP, not_within_s=0.0, cell_m=0.5)
    assert (again.result, again.plans) == (whole.result, whole.plans)
    told = covered.coverage_changes(MAP, again.job_id, whole.job_id)
    assert set(told.trends) - {"same"} == {"better", "worse", "new", "gone"}
    assert told.trends["same"] == sum(len(plan.cells) for plan in told.plans) > 0
    page = covered._http.get(
        f"/v1/maps/{MAP}/coverage/{whole.job_id}/frames", params={"limit": 3}
    ).json()
    assert [frame["number"] for frame in page["items"]] == [0, 1, 2]
    rest = {"cursor": page["next_cursor"]}
    left = covered._http.get(f"/v1/maps/{MAP}/coverage/{whole.job_id}/frames", params=rest).json()
    assert [frame["number"] for frame in left["items"]] == [3]
