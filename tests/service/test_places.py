"""Tests of when a request is read: not before its key and its place, and within limits.

The application runs in this process, and a test sends the body in pieces.
"""

import asyncio
import errno
import json
from collections.abc import Awaitable
from tempfile import SpooledTemporaryFile

import pytest
import starlette.formparsers

from sceneprint.settings import Settings
from service.app import create_app
from service.running_service import UPLOADS

JSON, FORM = "application/json", "multipart/form-data; boundary=x"
#: The beginning of a form whose file is larger than is kept in memory, and its end.
HEAD = b'--x\r\nContent-Disposition: form-data; name="frame"; filename="a"\r\n\r\n' + bytes(1 << 21)
END = b"\r\n--x--\r\n"


class Asked:
    """One request that is being answered, and how many pieces of its body were asked for."""

    def __init__(self, app, path, kind, pieces):
        self.read, self.status, self.body = 0, 0, b""
        self._pieces, self.more = pieces, asyncio.Event()
        self.more.set()
        headers = [
            (b"host", b"localhost"), (b"content-type", kind.encode()),
            (b"transfer-encoding", b"chunked"),
        ]  # fmt: skip
        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST",
            "scheme": "http", "path": path, "raw_path": path.encode(), "query_string": b"",
            "headers": headers, "server": ("localhost", 80), "client": ("127.0.0.1", 9),
        }  # fmt: skip
        self._done: Awaitable[None] = asyncio.ensure_future(app(scope, self._receive, self._send))

    async def _receive(self):
        self.read += 1
        piece = self._pieces.pop(0)
        if not self._pieces:
            await self.more.wait()  # the last piece comes when the test lets it
        return {"type": "http.request", "body": piece, "more_body": bool(self._pieces)}

    async def _send(self, message):
        self.status = message.get("status", self.status)
        self.body += message.get("body", b"")

    async def answer(self):
        """What it is answered with."""
        await self._done
        return json.loads(self.body)

    async def problem(self):
        """What it is refused with."""
        result = await self.answer()
        assert result["status"] == self.status
        return result


@pytest.fixture
def inside(tmp_path):
    """Runs a test's coroutine with an application of these settings."""

    def run(test, **settings):
        app = create_app(Settings(data_dir=tmp_path, **settings))

        async def whole():
            async with app.router.lifespan_context(app):
                return await test(app)

        return asyncio.run(whole())

    return run


@pytest.mark.parametrize("path", ["/v1/maps", "/v1/maps/a/queries"])
def test_of_json_no_more_is_read_than_anyone_has_to_say(inside, path):
    async def test(app):
        request = Asked(app, path, JSON, [b" " * (1 << 16)] * 100)
        problem = await request.problem()
        assert (problem["status"], problem["type"]) == (413, "/problems/too-large")
        assert request.read == 5  # four pieces are 256 KiB

    inside(test)


def test_at_most_twenty_fields_are_listed(inside):
    async def test(app):
        wrong = {f"x{i}": 1 for i in range(300)} | {"y" * 999: 1, "name": "a"}
        problem = await Asked(app, "/v1/maps", JSON, [json.dumps(wrong).encode()]).problem()
        assert [error["field"] for error in problem["errors"]] == [f"x{i}" for i in range(20)]
        assert "(and 298 more; 20 of 301 are listed)" in problem["detail"]

    inside(test)


@pytest.mark.parametrize(("kind", "other"), [("frames", "queries"), ("queries", "frames")])
def test_bodies_that_are_still_read_take_places_among_their_like(inside, kind, other):
    async def test(app):
        path = f"/v1/maps/a/{kind}"
        # uploads mostly wait for the disk, and more of them are in hand at once
        places = 2 + (UPLOADS if kind == "frames" else 1)
        slow = [Asked(app, path, FORM, [HEAD, END]) for _ in range(places)]
        for request in slow:
            request.more.clear()
        for _ in range(3000):  # half a minute
            if sum(request.read for request in slow) == 2 * places:
                break
            await asyncio.sleep(0.01)
        assert [(one.read, one.status, one.body) for one in slow] == [(2, 0, b"")] * places
        late = Asked(app, path, FORM, [HEAD, END])
        assert (await late.problem())["type"] == "/problems/busy"
        assert late.read == 0  # and so nothing is spooled
        welcome = Asked(app, f"/v1/maps/a/{other}", FORM, [HEAD, END])  # uploads stop no query
        assert (await welcome.problem())["type"] == "/problems/invalid-request"
        by_id = Asked(app, "/v1/maps/a/queries", JSON, [b'{"frame_id": "a"}'])
        problem = await by_id.problem()
        busy = kind == "queries"
        assert (problem["status"], by_id.read > 0) == (503 if busy else 404, not busy)
        for request in slow:
            request.more.set()
            assert (await request.problem())["detail"].startswith("The form has no field `meta`.")
        for _ in range(4):  # all places are free again
            after = Asked(app, "/v1/maps/a/queries", JSON, [b'{"frame_id": "a"}'])
            assert (await after.problem())["type"] == "/problems/unknown-map"

    inside(test, concurrent_requests=1, queued_requests=2)


@pytest.mark.parametrize(
    ("number", "status", "kind"),
    [
        (errno.ENOSPC, 507, "store-full"),
        (errno.EDQUOT, 507, "store-full"),
        (errno.ENOENT, 503, "unusable-store"),
    ],
)
def test_where_there_is_no_room_to_read_nothing_is_taken(
    inside, monkeypatch, caplog, number, status, kind
):
    class Full(SpooledTemporaryFile[bytes]):
        def write(self, data):
            raise OSError(number, "no room in /the/folder")

    monkeypatch.setattr(starlette.formparsers, "SpooledTemporaryFile", Full)

    async def test(app):
        for _ in range(3):  # each gives its place back
            request = Asked(app, "/v1/maps/a/frames", FORM, [HEAD, END])
            problem = await request.problem()
            assert (problem["status"], problem["type"]) == (status, f"/problems/{kind}")
            assert "folder" not in problem["detail"]

    inside(test, concurrent_requests=1, queued_requests=0)
    records = [record for record in caplog.records if record.message == "request failed"]
    assert ["no room in /the/folder" in str(vars(r)["error"]) for r in records] == [True] * 3
