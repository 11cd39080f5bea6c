"""Copies of a service's maps on a robot: the same answers without it, renewed as a whole."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.cli.demo import serving
from sceneprint.lab.synth import SynthRoom
from sceneprint.maintenance.snapshot.restoration import _replace_queries as replace_queries
from sceneprint.types import DepthFrame
from sceneprint_client import Client, Spool, Tracker
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose
from sceneprint_client.errors import FrameError

MAP = "hall"
CAMERA = CameraIntrinsics(width=16, height=12, fx=14, fy=14, cx=7.5, cy=5.5)
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
        asked = [one.query_id for one in offline.queries()]
        assert len(asked) == len(online)
        assert states(offline, walk[3:10:2]) == tracked
        assert {one[0] for one in tracked} & {"tracking"}
    with serving(data, 1) as url:
        pull = ["pull", "--url", url, "--data", str(copy)]
        assert main(pull) == 0
        assert main(pull) == 0  # nothing is newer
        assert "the newest snapshot" in capsys.readouterr().out
        assert [path.name for path in copy.parent.iterdir()] == ["copy"]  # the first copy is gone
        with Client.embedded(copy) as offline, Spool(tmp_path / "spool") as spool:
            own = [one.query_id for one in offline.queries()]
            assert own[-len(asked) :] == asked
            assert spool.add_queries(offline) == len(own)
            with Client(url) as client:
                report = spool.sync(client, MAP)
                assert (report.queries, report.queries_refused) == (len(own), 0)
                sent = [one.query_id for one in client.queries(MAP) if one.offline]
            assert sent == own
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


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_copys_records_follow_their_maps(tmp_path: Path) -> None:
    """Into a new copy, whose maps have other numbers; not those of a map that was created again."""
    ids = {}
    for folder in ("before", "made"):
        (tmp_path / folder).mkdir()
        with Client.embedded(tmp_path / folder) as client:
            for name in ("attic", "hall") if folder == "before" else ("hall", "attic"):
                client.create_map(name, model="depth")
                with pytest.raises(FrameError):
                    client.query(name, b"no image", FrameMeta(intrinsics=CAMERA))
            ids[folder] = {one.map: one.query_id for one in client.queries()}
    made, before = (tmp_path / one / "sceneprint.db" for one in ("made", "before"))
    with closing(sqlite3.connect(made)) as database, database:
        database.execute("ATTACH ? AS before", (str(before),))
        database.execute(
            "UPDATE maps SET created_at = (SELECT created_at FROM before.maps WHERE name = 'hall') "
            "WHERE name = 'hall'"
        )
    replace_queries(made, before)
    with Client.embedded(tmp_path / "made") as client:
        assert [(one.map, one.query_id) for one in client.queries()] \
            == [("hall", ids["before"]["hall"])]  # fmt: skip
    replace_queries(made, None)
    with Client.embedded(tmp_path / "made") as client:
        assert list(client.queries()) == []
