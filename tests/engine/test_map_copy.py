"""Tests of maps that a robot pulls: equal answers, incremental transfer and kills."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.bundle import rows
from sceneprint.engine.maps import map_copy
from sceneprint.engine.maps.map_copy import pull_map
from sceneprint.errors import Conflict, DamagedBlob, InvalidRequest, UnknownMap
from sceneprint.store import open_store
from sceneprint_client import Client
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose

pytestmark = pytest.mark.sqlite_only("a robot's copy is a folder")

MAP = "hall"
#: What tells one query from another, and says nothing of the answer.
OF_THE_QUERY = ("query_id", "milliseconds")


@pytest.fixture(scope="module")
def walk(room_views):
    return room_views(5, 1, 24, along_path=True).frames[:16]


def camera_of(view):
    k = view.intrinsics
    return CameraIntrinsics(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)


def upload(client, views, name=MAP):
    ids = []
    for number, view in enumerate(views):
        pose = GivenPose(parent_frame="room", matrix=np.array(view.pose).tolist())
        meta = FrameMeta(
            intrinsics=camera_of(view), session="s", robot="cart", pose=pose, sequence=number,
            captured_at="2026-11-16T09:30:00.125Z", up=(0.0, -1.0, 0.0), tags=["lit", "door"],
            name=f"a/{number}.png",
        )  # fmt: skip
        added = client.upload(name, view.depth, meta, wait_s=PATIENCE_S)
        assert added.state == "indexed"
        ids.append(added.frame_id)
    return ids


def answers(client, views):
    responses = [client.query(MAP, view.depth, camera_of(view), explain=True) for view in views]
    result = [response.model_dump(mode="json") for response in responses]
    frames = [
        frame.model_dump(mode="json", exclude={"job_id"}) for frame in client.frames(MAP)
        if frame.state == "indexed"  # of those that are gone, the copy need not have known
    ]  # fmt: skip
    return [
        *({name: one[name] for name in one if name not in OF_THE_QUERY} for one in result), *frames
    ]  # fmt: skip


@dataclass
class Robot:
    """A robot's folder, and the service that it pulls from."""

    service: Client
    folder: Path

    def pull(self, name=MAP):
        database = f"sqlite:///{self.folder}/sceneprint.db"
        with closing(open_store(database, self.folder / "blobs")) as store:
            return pull_map(self.service, store, name)

    def answers(self, views):
        with Client.embedded(self.folder) as client:
            return answers(client, views)


@pytest.fixture
def robot(tmp_path):
    with ExitStack() as stack:
        service = stack.enter_context(Client.embedded(tmp_path / "service"))
        (tmp_path / "robot").mkdir()
        yield Robot(service, tmp_path / "robot")


def test_a_pulled_map_answers_as_the_service_and_follows_it(robot, walk):
    service, queries = robot.service, walk[1:8:3]
    with pytest.raises(UnknownMap):
        robot.pull()
    service.create_map(MAP, title="The hall", model="depth")
    service.create_map("other", model="depth")
    ids = upload(service, walk[:10:2])
    first = robot.pull()
    assert (first.frames, first.written, first.removed, first.artifacts) == (5, 5, 0, 5)
    online = answers(service, queries)
    assert [answer["status"] for answer in online[:3]].count("found") >= 2
    assert robot.answers(queries) == online
    with Client.embedded(robot.folder) as client:
        assert [record.name for record in client.maps()] == [MAP]
        result = client.map(MAP)
        assert (result.title, result.created_at) == ("The hall", service.map(MAP).created_at)
    again = robot.pull()
    assert (again.written, again.removed, again.artifacts, again.bytes) == (0, 0, 0, 0)
    # one is new, one is gone, one edited, and one uploaded again under its id
    upload(service, walk[10:11])
    service.delete_frame(MAP, ids[1])
    service.edit_frame(MAP, ids[2], {"tags": ["dark"], "pose": None})
    service.delete_frame(MAP, ids[3])
    view = walk[12]
    service.put_frame(
        MAP, ids[3], view.depth, FrameMeta(intrinsics=camera_of(view)), wait_s=PATIENCE_S
    )
    second = robot.pull()
    assert (second.frames, second.written, second.removed, second.artifacts) == (5, 3, 1, 2)
    assert robot.answers(queries) == answers(service, queries)
    assert robot.pull().written == 0
    service.delete_map(MAP)
    service.create_map(MAP, model="depth")
    upload(service, walk[:2])
    third = robot.pull()
    assert (third.frames, third.written, third.artifacts) == (2, 2, 1)
    assert robot.answers(queries) == answers(service, queries)


def test_what_was_uploaded_into_the_copy_is_not_lost(robot, walk):
    robot.service.create_map(MAP, model="depth")
    robot.pull()
    with Client.embedded(robot.folder) as client:
        [own] = upload(client, walk[:1])
    with pytest.raises(Conflict, match=own):
        robot.pull()
    robot.service.delete_map(MAP)
    robot.service.create_map(MAP, model="depth")
    with pytest.raises(Conflict, match="has 1 uploaded frames"):
        robot.pull()
    with Client.embedded(robot.folder) as client:
        assert [frame.frame_id for frame in client.frames(MAP)] == [own]


#: Pulls in a process that is killed: after so many artifacts, or in the middle of the transaction.
CHILD = """
import os, signal, sys
from contextlib import closing
from pathlib import Path
from sceneprint.engine.maps import map_copy
from sceneprint.store import open_store
from sceneprint_client import Client
service, folder, what, count = sys.argv[1:]
seen = []
def counted(do):
    def done(*given):
        seen.append(given)
        if len(seen) > int(count):
            os.kill(os.getpid(), signal.SIGKILL)
        return do(*given)
    return done
store = open_store(f"sqlite:///{folder}/sceneprint.db", Path(folder) / "blobs")
with Client.embedded(service) as client, closing(store):
    if what == "artifacts":
        client.copied_artifact = counted(client.copied_artifact)
    else:
        map_copy.BLOCK, map_copy.add_copied = 1, counted(map_copy.add_copied)
    map_copy.pull_map(client, store, "hall")
"""


@pytest.mark.thorough
def test_a_killed_pull_leaves_the_copy_and_goes_on(robot, walk, tmp_path):
    service, queries = robot.service, walk[1:4:2]
    service.create_map(MAP, model="depth")
    upload(service, walk[:2])
    robot.pull()
    before = robot.answers(queries)
    upload(service, walk[2:6])

    def kill(what, count):
        arguments = [tmp_path / "service", robot.folder, what, str(count)]
        ran = subprocess.run([sys.executable, "-c", CHILD, *arguments], check=False)
        assert ran.returncode == -signal.SIGKILL
        assert robot.answers(queries) == before

    kill("artifacts", 2)
    kill("rows", 3)  # all four artifacts are there by then
    actual = robot.pull()
    assert (actual.frames, actual.written, actual.artifacts, actual.bytes) == (6, 4, 0, 0)
    assert robot.answers(queries) == answers(service, queries)


def test_a_copy_is_one_state_of_a_map_that_changes(robot, walk, monkeypatch):
    service = robot.service
    service.create_map(MAP, model="depth")
    ids = upload(service, walk[:6])
    monkeypatch.setattr(rows, "_ROWS", 1)  # a part for each row
    monkeypatch.setattr(map_copy, "MOST_BYTES", 1)  # and one of them in each answer
    ask, answered = service.map_copy, list[Any]()

    def changing(*arguments):
        answered.append(ask(*arguments))
        if len(answered) == 2:
            service.delete_frame(MAP, ids[0])
            service.edit_frame(MAP, ids[5], {"tags": ["dark"]})
        return answered[-1]

    monkeypatch.setattr(service, "map_copy", changing)
    actual = robot.pull()
    assert [len(parts) for _, parts in answered] == [1] * 6
    assert [len(head.parts) for head, _ in answered] == [6, 6, 5, 5, 5, 5]
    assert (actual.frames, actual.written) == (5, 5)
    assert actual.revision == service.map(MAP).revision
    with Client.embedded(robot.folder) as client:
        living = [frame for frame in client.frames(MAP) if frame.state == "indexed"]
        assert {frame.frame_id for frame in living} == set(ids[1:])
        assert client.frame(MAP, ids[5]).tags == ["dark"]
    again = robot.pull()
    assert (again.written, again.removed) == (0, 0)
    assert answered[-1][1] == {}  # the copy's own parts are those of the service


def test_other_bytes_than_were_named_are_refused(robot, walk, monkeypatch):
    robot.service.create_map(MAP, model="depth")
    upload(robot.service, walk[:1])
    read = robot.service.map_copy

    def other(*arguments):
        head, parts = read(*arguments)
        return head, dict.fromkeys(parts, b"other")

    for name, answer in (("copied_artifact", lambda *_: b"other"), ("map_copy", other)):
        with monkeypatch.context() as patch:
            patch.setattr(robot.service, name, answer)
            with pytest.raises(DamagedBlob, match="arrived damaged"):
                robot.pull()
    with Client.embedded(robot.folder) as client:
        assert list(client.maps()) == []


def test_a_folder_of_something_else_is_refused(tmp_path):
    map_copy.claim_folder(tmp_path / "new")
    (tmp_path / "new" / "sceneprint.db").touch()
    map_copy.claim_folder(tmp_path / "new")  # which is one already
    (tmp_path / "data").mkdir()
    map_copy.claim_folder(tmp_path / "data")
    other = tmp_path / "other"
    other.mkdir()
    (other / "sceneprint.db").touch()
    for folder in (other, other / "sceneprint.db"):
        with pytest.raises(InvalidRequest, match="but no pulled maps"):
            map_copy.claim_folder(folder)
