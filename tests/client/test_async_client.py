"""Tests of AsyncClient: its methods against a service, concurrency, retries, cancellation."""

import asyncio
import inspect
from contextlib import asynccontextmanager

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import AsyncClient, Client
from sceneprint_client.api import FrameState
from sceneprint_client.api.coverage import MapCoverage
from sceneprint_client.errors import Busy, UnknownMap

BUSY = (503, {}, {"type": "/problems/busy", "title": "", "status": 503, "detail": "later"})


def public_methods(kind):
    result = inspect.getmembers(kind, inspect.isfunction)
    return {name: one for name, one in result if not name.startswith("_")}


def test_both_clients_have_the_same_methods():
    blocking, others = public_methods(Client), public_methods(AsyncClient)
    assert blocking.keys() == others.keys()
    assert len(others) > 90
    for name, one in others.items():
        own, other = inspect.signature(blocking[name]), inspect.signature(one)
        assert own.parameters == other.parameters
        items = other.return_annotation.startswith("AsyncIterator[")
        assert inspect.iscoroutinefunction(one) != items, name
        assert not inspect.iscoroutinefunction(blocking[name])
        assert own.return_annotation == other.return_annotation.replace("AsyncI", "I")
        assert one.__doc__ == blocking[name].__doc__


def test_a_map_from_upload_to_deletion(service_url, map_name, references):
    async def session():
        async with AsyncClient(service_url) as client:
            created = await client.create_map(map_name, model="depth")
            added = await client.upload(map_name, references[3], wait_s=PATIENCE_S)
            assert added.state is FrameState.INDEXED
            assert [frame.frame_id async for frame in client.frames(map_name)] == [added.frame_id]
            coverage = await client.compute(MapCoverage, map_name, timeout_s=PATIENCE_S)
            assert coverage.state == "succeeded"
            kinds = [event.kind async for event in client.events(map_name, follow=False)]
            assert kinds.count("frame.indexed") == 1
            await client.delete_map(created.name)
            with pytest.raises(UnknownMap, match=map_name):
                await anext(client.frames(map_name))

    asyncio.run(session())


@asynccontextmanager
async def answering(respond):
    """Run a server in this event loop, and yield its address."""

    async def answer(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        body = await respond(reader)
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body))
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1") as server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"


def test_ten_requests_are_in_progress_at_once():
    async def session():
        together = asyncio.Barrier(10)

        async def respond(_):
            await together.wait()
            return b'{"status": "ok"}'

        async with answering(respond) as url, AsyncClient(url) as client:
            return await asyncio.gather(*(client.healthy() for _ in range(10)))

    assert asyncio.run(session()) == [True] * 10


def test_a_cancelled_call_closes_its_connection():
    async def session():
        begun, rest = asyncio.Event(), list[bytes]()

        async def respond(reader):
            begun.set()
            rest.append(await reader.read())  # until the client closes the connection
            return b""

        async with answering(respond) as url, AsyncClient(url) as client:
            call = asyncio.create_task(client.map("hall"))
            await begun.wait()
            call.cancel()
            with pytest.raises(asyncio.CancelledError):
                await call
            async with asyncio.timeout(PATIENCE_S):
                while not rest:
                    await asyncio.sleep(0)
        return rest

    assert asyncio.run(session()) == [b""]


def test_requests_are_repeated(hasty, scripted):
    page = {"items": [], "next_cursor": None}
    lost = (0, {}, None)
    server = scripted([BUSY, lost, (200, {}, page), lost, (404, {}, None), BUSY])

    async def session():
        async with AsyncClient(server.url) as client:
            assert await client.maps() == []
            await client.delete_map("hall")  # the answer to the first deletion was lost
            with pytest.raises(Busy, match="later"):
                await client.map("hall")

    asyncio.run(session())
    assert [method for method, *_ in server.requests] == ["GET"] * 3 + ["DELETE"] * 2 + ["GET"] * 8
