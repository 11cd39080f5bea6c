"""Uploads with what a robot made of its frame, over HTTP."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sceneprint.engine.jobs.robot_signatures import FIRST
from sceneprint.formats.signature_package import MAXIMUM_PACKAGE, read_package
from sceneprint.store.keys import find_named_key
from sceneprint.store.sender_rows import add_verified, distrust_sender

KEYS = {"boss": {"*": "admin"}, "cart": {"hall": "write"}, "screen": {"hall": "read"}}
FRAMES = "/v1/maps/hall/frames"


@pytest.fixture
def house(open_house: Callable[..., Any], tmp_path: Path) -> Iterator[Any]:
    """A service that trusts robots, with a map and keys."""
    with open_house(tmp_path, None, KEYS, trust_signatures=True, signed_sample=1e-9) as opened:
        made = opened.ask("boss", "POST", "/v1/maps", json={"name": "hall", "model": "depth"})
        assert made.status_code == 201
        with opened.engine.store.database.write() as connection:
            key = find_named_key(connection, "cart").id
            for _ in range(FIRST):
                add_verified(connection, key)
        yield opened


def sign(house: Any, shot: Any, key: str = "screen") -> bytes:
    answer = house.ask(key, "POST", "/v1/maps/hall/signatures", **shot.form())
    assert (answer.status_code, answer.headers["Content-Type"]) == (200, "application/octet-stream")
    return bytes(answer.content)


def form(shot: Any, package: bytes, **fields: Any) -> dict[str, Any]:
    sent = shot.form()
    return {
        "files": {**sent["files"], "signed": ("signed", package, "application/octet-stream")},
        "data": {**sent["data"], **fields},
    }


def test_an_upload_that_no_worker_signs(house, small_shots) -> None:
    shot = small_shots[0]
    before = house.engine.counts()
    package = sign(house, shot)
    assert house.engine.counts() == before  # nothing was stored
    added = house.ask("cart", "POST", FRAMES, **form(shot, package)).json()
    assert added["signed"] == "kept"
    used = house.ask("boss", "GET", "/v1/maps/hall").json()["used_bytes"]
    assert used == len(shot.png) + len(package)
    house.work()
    frame = house.ask("screen", "GET", f"{FRAMES}/{added['frame_id']}").json()
    assert (frame["state"], frame["signed_by"]) == ("indexed", "robot")
    job = house.ask("boss", "GET", f"/v1/jobs/{added['job_id']}").json()
    assert job["result"] == {"signed_by": "robot", "sent": "taken"}
    signature = house.ask("screen", "GET", f"{FRAMES}/{added['frame_id']}/signature").json()
    assert b64decode(signature["base64"]) == read_package(package).vector
    house.engine.publish_due()  # which removes packages of frames that are signed
    assert house.ask("boss", "GET", "/v1/maps/hall").json()["used_bytes"] == len(shot.png)


def test_put_takes_one_too(house, small_shots) -> None:
    package = sign(house, small_shots[0])
    added = house.ask("cart", "PUT", f"{FRAMES}/scan-1", **form(small_shots[0], package)).json()
    assert (added["frame_id"], added["signed"]) == ("scan-1", "kept")
    house.work()
    assert house.ask("screen", "GET", f"{FRAMES}/scan-1").json()["signed_by"] == "robot"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda package: package[:-1], "damaged"),
        (lambda _: b"nothing", "not a package"),
        (lambda _: b"SPSIG" * (MAXIMUM_PACKAGE // 5 + 1), "too large"),
    ],
)
def test_what_is_no_package(house, small_shots, spoil, reason) -> None:
    package = spoil(sign(house, small_shots[0]))
    answer = house.ask("cart", "POST", FRAMES, **form(small_shots[0], package))
    assert answer.status_code == 422
    assert answer.json()["errors"] == [{"field": "signed", "reason": reason}]
    assert house.ask("boss", "GET", "/v1/maps/hall").json()["used_frames"] == 0


def test_what_is_of_another_frame(house, small_shots) -> None:
    package = sign(house, small_shots[1])
    answer = house.ask("cart", "POST", FRAMES, **form(small_shots[0], package))
    assert answer.status_code == 422
    assert answer.json()["errors"] == [{"field": "signed", "reason": "of another frame"}]


def test_the_part_is_one_file(house, small_shots) -> None:
    sent = small_shots[0].form()
    text = {"files": sent["files"], "data": {**sent["data"], "signed": "text"}}
    twice = {
        "files": [
            ("frame", sent["files"]["frame"]), *[("signed", ("signed", b"x"))] * 2,
        ],
        "data": sent["data"],
    }  # fmt: skip
    answer = house.ask("cart", "POST", FRAMES, **text)
    assert (answer.status_code, answer.json()["errors"][0]["reason"]) == (422, "not one file")
    assert house.ask("cart", "POST", FRAMES, **twice).status_code in (400, 422)
    # and queries know of none
    asked = house.ask("screen", "POST", "/v1/maps/hall/queries", **form(small_shots[0], b"x"))
    assert asked.status_code == 400


def test_a_retry_with_an_idempotency_key(house, small_shots) -> None:
    package = sign(house, small_shots[0])
    key = {"Idempotency-Key": "one"}
    first = house.ask("cart", "POST", FRAMES, **form(small_shots[0], package), headers=key)
    again = house.ask("cart", "POST", FRAMES, **form(small_shots[0], package), headers=key)
    assert (again.headers["Idempotent-Replayed"], again.json()) == ("true", first.json())
    other = house.ask("cart", "POST", FRAMES, **small_shots[0].form(), headers=key)
    assert other.status_code == 422


def test_who_may_sign(house, small_shots) -> None:
    assert house.ask("screen", "POST", FRAMES, **small_shots[0].form()).status_code == 403
    answer = house.ask("cart", "POST", "/v1/maps/attic/signatures", **small_shots[0].form())
    assert answer.status_code == 404


def test_the_operator_sees_a_key_that_is_trusted_no_more(house, small_shots) -> None:
    with house.engine.store.database.write() as connection:
        distrust_sender(connection, find_named_key(connection, "cart").id, "hall", "f")
    package = sign(house, small_shots[0])
    added = house.ask("cart", "POST", FRAMES, **form(small_shots[0], package)).json()
    assert added["signed"] == "distrusted"
    keys = {one["name"]: one for one in house.ask("boss", "GET", "/v1/keys").json()["items"]}
    assert keys["cart"]["signatures_distrusted_at"] is not None
    assert keys["screen"]["signatures_distrusted_at"] is None
    figures = house.ask("boss", "GET", "/metrics").text
    assert "sceneprint_robot_keys_distrusted 1.0" in figures
    assert f"sceneprint_robot_signatures_verified {FIRST}.0" in figures
