"""The difference of two sessions by client, raw HTTP and command."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import httpx
import numpy as np
import pytest

from sceneprint.errors import InvalidRequest, UnknownJob
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.sessions import SAME

MAP = "changed"


@pytest.fixture(scope="module")
def changed(
    service_url: str, walk: Callable[..., list[tuple[bytes, FrameMeta]]]
) -> Iterator[Client]:
    """A client of a map with sessions a and b, of two frames each along one path."""
    with Client(service_url) as client:
        client.create_map(MAP, model="depth")
        frames = walk(sessions="ab", parent="room")
        jobs = [client.upload(MAP, *frame).job_id for frame in frames]
        assert {job.state for job in client.wait(jobs)} == {JobState.SUCCEEDED}
        yield client


def test_a_difference_is_told_listed_and_deleted(changed: Client, service_url: str) -> None:
    steps: list[tuple[int, int]] = []
    told = changed.compare_sessions(MAP, "a", "b", progress=lambda *step: steps.append(step))
    assert told.state is JobState.SUCCEEDED
    assert steps[-1] == (8, 8)
    result = told.result
    assert result is not None
    assert result.same > 500
    assert (result.parent_frame, result.frames_before, result.frames_after) == ("room", 2, 2)
    of = MAP, told.difference_id
    assert changed.difference(*of) == told
    assert told in list(changed.differences(MAP))
    found = changed.difference_points(*of)
    assert found.patches is not None
    assert (found.patches == SAME).sum() == result.same
    assert (np.diff(found.patches) >= 0).all()
    url = f"{service_url}/v1/maps/{MAP}/differences/{told.difference_id}/points"
    sent = httpx.get(url)
    assert sent.headers["content-type"] == "application/vnd.sceneprint.points"
    again = httpx.get(url, headers={"If-None-Match": sent.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")

    changed.delete_difference(*of)
    with pytest.raises(UnknownJob, match="no difference"):
        changed.difference(*of)


def test_what_cannot_be_compared_is_refused(changed: Client, service_url: str) -> None:
    with pytest.raises(InvalidRequest, match="Name two sessions"):
        changed.compare_sessions(MAP, "a", "a")
    with pytest.raises(InvalidRequest, match="no indexed frame with a pose of session 'z'"):
        changed.compare_sessions(MAP, "a", "z")
    raw = httpx.post(f"{service_url}/v1/maps/{MAP}/differences", json={"before": "a"})
    assert (raw.status_code, raw.headers["content-type"]) == (422, "application/problem+json")
