"""Tests of requests while the application loads."""

import asyncio
import threading

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint import __version__
from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from service.app import create_app
from service.startup import Front


async def _lived(front, test):
    """Run a test between a front's start and its end."""
    messages = asyncio.Queue()
    said = asyncio.Queue()
    life = asyncio.create_task(front({"type": "lifespan"}, messages.get, said.put))
    await messages.put({"type": "lifespan.startup"})
    assert (await said.get())["type"] == "lifespan.startup.complete"
    async with httpx.AsyncClient(
        transport=httpx.ASGITransport(front), base_url="http://127.0.0.1"
    ) as client:
        result = await test(client)
    await messages.put({"type": "lifespan.shutdown"})
    assert (await said.get())["type"] == "lifespan.shutdown.complete"
    await life
    return result


@pytest.fixture
def slow(tmp_path):
    """A front whose application comes once the event is set."""
    settings, go = Settings(data_dir=tmp_path), threading.Event()

    def load():
        assert go.wait(PATIENCE_S)
        return create_app(settings)

    return Front(settings, load, lambda: None), go


def test_healthz_is_answered_before_there_is_an_application_and_as_by_it(slow):
    front, go = slow

    async def test(client):
        early, head = await client.get("/healthz"), await client.head("/healthz")
        assert front.app is None
        assert (early.status_code, early.json()) == (200, {"status": "ok", "version": __version__})
        assert (head.status_code, head.content) == (200, b"")
        others = [
            client.get("/v1/maps"),
            client.get("/healthz", headers={"Host": "rebound.example"}),
            client.get("/healthz", headers={"Origin": "http://elsewhere.example"}),
        ]
        waiting = [asyncio.create_task(other) for other in others]
        done, _ = await asyncio.wait(waiting, timeout=0.3)
        assert done == set()
        go.set()
        assert [(await one).status_code for one in waiting] == [200, 421, 403]
        late = await client.get("/healthz")
        assert (late.status_code, late.content) == (200, early.content)
        unlike = {"x-request-id"}
        assert {k: v for k, v in late.headers.items() if k not in unlike} == {
            k: v for k, v in early.headers.items() if k not in unlike
        }
        assert len(early.headers["x-request-id"]) == len(late.headers["x-request-id"])

    asyncio.run(_lived(front, test))


def test_an_application_that_cannot_be_made_ends_the_service(tmp_path):
    ended = threading.Event()

    def load():
        raise UnusableStore("the disk is gone")

    front = Front(Settings(data_dir=tmp_path), load, ended.set)

    async def test(client):
        with pytest.raises(RuntimeError, match="the service could not start"):
            await client.get("/readyz")
        assert ended.is_set()

    asyncio.run(_lived(front, test))
    assert str(front.error) == "the disk is gone"


def test_while_kernels_are_compiled_readyz_says_so_and_who_needs_them_waits(
    open_house, tmp_path, until, monkeypatch
):
    monkeypatch.setattr("service.routes.admin.KERNEL_CHECK_S", 0.05)
    monkeypatch.setattr("sceneprint.engine.signers.KERNELS_S", 0.05)
    with open_house(tmp_path, None, {"robot": {"*": "write"}}) as house:
        house.engine.signers.require_kernels(60)  # those of this machine are there
        ready = house.ask("robot", "GET", "/readyz")
        assert (ready.status_code, ready.json()["status"]) == (200, "ready")
        house.engine.signers.hold()

        def is_ready():
            return bool(house.ask("robot", "GET", "/readyz").status_code == 200)

        until(lambda: not is_ready())  # what it says is up to a second old
        waits = house.ask("robot", "GET", "/readyz")
        assert (waits.status_code, waits.headers["retry-after"]) == (503, "1")
        assert waits.json()["detail"].startswith("The kernels of the service are being compiled")
        assert house.ask("robot", "GET", "/healthz").status_code == 200
        assert house.ask("robot", "GET", "/v1/maps").status_code == 200
        house.engine.signers.release()
        until(is_ready)
