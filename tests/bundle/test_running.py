"""Tests of backups of a running service while robots upload and delete."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder
from sceneprint_client import Client
from sceneprint_lab.cli.demo import serving
from tests.whole_engine import Engine


@dataclass(eq=False)
class Robot(threading.Thread):
    """Uploads frames to the map `busy`, and deletes each third of them again.

    It notes when the service has acknowledged each, and when it began to delete.
    """

    url: str
    uploads: list
    received: dict[str, float] = field(default_factory=dict)
    deleting: dict[str, float] = field(default_factory=dict)
    failed: list[Exception] = field(default_factory=list)

    def __post_init__(self):
        super().__init__(daemon=True)
        self.over = threading.Event()

    def run(self):
        import httpx

        try:
            with httpx.Client(base_url=self.url, timeout=PATIENCE_S, trust_env=False) as client:
                while not self.over.is_set():
                    self.round(client)
        except Exception as error:
            self.failed.append(error)

    def round(self, client):
        for each in self.uploads:
            if self.over.is_set():
                return
            answer = client.post(
                "/v1/maps/busy/frames",
                files={"frame": ("frame.png", each.data, "image/png")},
                data={"meta": each.meta.model_dump_json()},
            )
            assert answer.status_code in (200, 202), answer.text
            self.received.setdefault(answer.json()["frame_id"], time.monotonic())
            time.sleep(0.03)
        for frame in [one for one in self.received if one not in self.deleting][::3]:
            self.deleting[frame] = time.monotonic()
            answer = client.delete(f"/v1/maps/busy/frames/{frame}")
            assert answer.status_code == 204, answer.text


@contextmanager
def at_work(url, uploads):
    robots = [Robot(url, uploads[i::2]) for i in range(2)]
    for robot in robots:
        robot.start()
    yield robots
    for robot in robots:
        robot.over.set()
        robot.join()
    assert [robot.failed for robot in robots] == [[], []]


@pytest.mark.thorough
def test_it_holds_one_state_and_all_of_it(data, tmp_path, uploads, rows, answers, settings):
    asked = uploads[:6]
    names = list[str]()
    with serving(data, 1) as url:
        with Client(url) as client:
            client.create_map("busy", model="depth")
            client.wait([row[0] for row in rows(data, "SELECT id FROM jobs")], timeout_s=PATIENCE_S)
        with at_work(url, uploads[6:]) as robots:
            began, ended = [], []
            for _ in range(3):
                time.sleep(0.4)
                began.append(time.monotonic())
                taken = take_backup(settings(data), str(tmp_path / "place"))
                ended.append(time.monotonic())
                assert taken.lost == ()
                names.append(taken.manifest.name)
        received = {k: v for robot in robots for k, v in robot.received.items()}
        deleting = {k: v for robot in robots for k, v in robot.deleting.items()}
    original = answers(data, asked)
    assert any(one.status == "found" for one in original)
    unfinished = 0
    for name, start, end in zip(names, began, ended, strict=True):
        new = tmp_path / f"of {name}"
        restored = restore_to_folder(str(tmp_path / "place"), new, name)  # which finds every blob
        assert restored.lost == ()
        states = dict(rows(new, "SELECT id, state FROM frames"))
        # what was acknowledged before is in it; what was not yet asked to go when it ended, too
        for frame, at in received.items():
            if at < start:
                assert frame in states
                if deleting.get(frame, end) >= end:
                    assert states[frame] != "deleted"
        pending = sum(state in ("received", "signing") for state in states.values())
        unfinished += pending
    assert answers(new, asked) == original
    assert unfinished
    assert deleting
    rows(new, "UPDATE jobs SET leased_until = 0 WHERE state = 'running'")  # as after a minute
    with Engine(settings(new)) as engine:  # what was being signed, and what waited, can be
        for _ in range(min(pending, 2)):
            work = engine.claim("w")
            assert work is not None
            assert engine.run(work) == "succeeded"
