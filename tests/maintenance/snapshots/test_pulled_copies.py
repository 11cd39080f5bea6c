"""Copies of a service's maps on a robot: the same answers without it, renewed as a whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.cli.demo import serving
from sceneprint.lab.synth import SynthRoom
from sceneprint.types import DepthFrame
from sceneprint_client import Client, Tracker
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose

MAP = "hall"
#: What tells one query from another, and says nothing of the answer.
OF_THE_QUERY = ("query_id", "milliseconds")


@pytest.fixture(scope="module")
def walk(room_views: Callable[..., SynthRoom]) -> tuple[DepthFrame, ...]:
    return room_views(5, 1, 24, along_path=True).frames


@pytest.fixture(scope="module")
def nowhere(room_views: Callable[..., SynthRoom]) -> DepthFrame:
    """A view that is nowhere in the map."""
    return room_views(5, 3, 2).frames[0]


def camera_of(view: DepthFrame) -> CameraIntrinsics:
    k = view.intrinsics
    return CameraIntrinsics(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)


def upload(client: Client, views: tuple[DepthFrame, ...]) -> None:
    for view in views:
        pose = GivenPose(parent_frame="room", matrix=np.array(view.pose).tolist())
        meta = FrameMeta(intrinsics=camera_of(view), session="s", pose=pose)
        assert client.upload(MAP, view.depth, meta, wait_s=PATIENCE_S).state == "indexed"


def answers(client: Client, views: tuple[DepthFrame, ...]) -> list[dict[str, Any]]:
    """All that is answered to each view."""
    asked = [client.query(MAP, one.depth, camera_of(one)) for one in views]
    told = [one.model_dump(mode="json") for one in asked]
    return [{name: one[name] for name in one if name not in OF_THE_QUERY} for one in told]


def states(client: Client, views: tuple[DepthFrame, ...]) -> list[tuple[Any, ...]]:
    tracker = Tracker(client, MAP, camera=camera_of(views[0]))
    first = np.linalg.inv(np.array(views[0].pose))
    found = [
        tracker.update(one.depth, first @ np.array(one.pose), stamp=2.0 * i)
        for i, one in enumerate(views)
    ]
    return [(one.status, one.reason, np.asarray(one.T_map_odom).tolist()) for one in found]


@pytest.mark.sqlite_only("the service of this test is one process with SQLite")
def test_a_copy_answers_as_the_service_did_and_is_renewed(
    walk: tuple[DepthFrame, ...], nowhere: DepthFrame, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    data, copy = tmp_path / "data", tmp_path / "robot" / "copy"
    data.mkdir()
    with serving(data, 1) as url, Client(url) as client:
        client.create_map(MAP, model="depth")
        pull = ["pull", "--url", url, "--data", str(copy)]
        assert main(pull) == 2
        assert "keeps no snapshot" in capsys.readouterr().err
        upload(client, walk[:14:2])
        first = client.take_snapshot(wait_s=PATIENCE_S)
        online, tracked = answers(client, (*walk[3:10:2], nowhere)), states(client, walk[3:10:2])
        assert main(pull) == 0
        upload(client, walk[14:15])
        client.take_snapshot(wait_s=PATIENCE_S)
        capsys.readouterr()
        second = [path.name for path in copy.parent.iterdir()]
        renewed = answers(client, (walk[15], nowhere))
    # nobody answers at the address any more
    assert first.result is not None
    assert second == ["copy"]
    assert [one["status"] for one in online].count("found") >= 2
    assert online[-1]["status"] == "not_found"
    with Client.embedded(copy) as offline:
        assert list(offline.queries()) == []  # the service's are none of the robot's
        assert answers(offline, (*walk[3:10:2], nowhere)) == online
        assert len(list(offline.queries())) == len(online)
        assert states(offline, walk[3:10:2]) == tracked
        assert {one[0] for one in tracked} & {"tracking"}
    with serving(data, 1) as url:
        pull = ["pull", "--url", url, "--data", str(copy)]
        assert main(pull) == 0
        assert main(pull) == 0  # nothing is newer
        assert "the newest snapshot" in capsys.readouterr().out
        assert [path.name for path in copy.parent.iterdir()] == ["copy"]  # the first copy is gone
        with Client.embedded(copy) as offline:
            assert answers(offline, (walk[15], nowhere)) == renewed
            assert sum(1 for _ in offline.frames(MAP)) == 8
            upload(offline, walk[16:17])
        with Client(url) as client:
            client.take_snapshot(wait_s=PATIENCE_S)
        assert main(pull) == 0
        aside = Path(capsys.readouterr().err.strip().splitlines()[-1].rpartition(": ")[2])
        with Client.embedded(aside) as offline:  # what a robot added is never thrown away
            assert sum(1 for _ in offline.frames(MAP)) == 9
        assert main(["pull", "--url", url, "--data", str(data)]) == 2  # somebody's data
        assert "not empty and no copy" in capsys.readouterr().err
    assert (data / "sceneprint.db").is_file()
