"""The difference of two sessions by client, raw HTTP and command."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from sceneprint.errors import InvalidRequest, UnknownJob
from sceneprint.formats.dataset import write_depth_png
from sceneprint.lab.synth import SynthRoom
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.sessions import SAME

MAP = "changed"


@pytest.fixture(scope="module")
def changed(
    service_url: str, tmp_path_factory: pytest.TempPathFactory, room_views: Callable[..., SynthRoom]
) -> Iterator[Client]:
    """A client of a map with sessions a and b, of two frames each along one path."""
    path = tmp_path_factory.mktemp("changed") / "depth.png"
    with Client(service_url) as client:
        client.create_map(MAP, model="depth")
        jobs = []
        for i, frame in enumerate(room_views(21, 0, 4, along_path=True).frames):
            write_depth_png(path, frame.depth, 1000.0)
            k = frame.intrinsics
            assert frame.pose is not None
            fields = {
                "intrinsics": {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy,
                               "cx": k.cx, "cy": k.cy},
                "session": "ab"[i % 2],
                "pose": {"parent_frame": "room", "matrix": frame.pose.tolist()},
            }  # fmt: skip
            jobs.append(client.upload(MAP, path, FrameMeta.model_validate(fields)).job_id)
        assert {job.state for job in client.wait(jobs)} == {JobState.SUCCEEDED}
        yield client


def test_a_difference_is_told_listed_and_deleted(
    changed: Client, service_url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_what_cannot_be_compared_is_refused(
    changed: Client, capsys: pytest.CaptureFixture[str], service_url: str
) -> None:
    with pytest.raises(InvalidRequest, match="Name two sessions"):
        changed.compare_sessions(MAP, "a", "a")
    with pytest.raises(InvalidRequest, match="no indexed frame with a pose of session 'z'"):
        changed.compare_sessions(MAP, "a", "z")
    raw = httpx.post(f"{service_url}/v1/maps/{MAP}/differences", json={"before": "a"})
    assert (raw.status_code, raw.headers["content-type"]) == (422, "application/problem+json")
