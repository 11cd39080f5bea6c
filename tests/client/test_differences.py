"""The difference of two sessions by client and raw HTTP."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import httpx
import numpy as np
import pytest

from sceneprint.errors import InvalidRequest
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.sessions import SAME, Difference

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


def test_the_cells_of_a_difference_are_sent(changed: Client, service_url: str) -> None:
    told = changed.compute(Difference, MAP, before="a", after="b")
    result = told.result
    assert result is not None
    assert result.same > 500
    assert (result.parent_frame, result.frames_before, result.frames_after) == ("room", 2, 2)
    of = MAP, told.job_id
    found = changed.difference_points(*of)
    assert found.patches is not None
    assert (found.patches == SAME).sum() == result.same
    assert (np.diff(found.patches) >= 0).all()
    url = f"{service_url}/v1/maps/{MAP}/differences/{told.job_id}/points"
    sent = httpx.get(url)
    assert sent.headers["content-type"] == "application/vnd.sceneprint.points"
    again = httpx.get(url, headers={"If-None-Match": sent.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_what_cannot_be_compared_is_refused(changed: Client) -> None:
    with pytest.raises(InvalidRequest, match="Name two sessions"):
        changed.compute(Difference, MAP, before="a", after="a")
    with pytest.raises(InvalidRequest, match="no indexed frame with a pose of session 'z'"):
        changed.compute(Difference, MAP, before="a", after="z")
