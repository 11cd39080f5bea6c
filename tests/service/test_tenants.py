"""Tests that keys of one tenant share its limits, and other tenants are not affected."""

import asyncio
import re
from contextlib import ExitStack

import pytest
from prometheus_client import generate_latest
from sqlalchemy import select
from starlette.applications import Starlette

from sceneprint.engine.admin.operations import create_tenant
from sceneprint.errors import RateLimited
from sceneprint.process import NOBODY, work_of
from sceneprint.settings import Settings
from sceneprint.store.queue import enqueue, waiting_by_tenant
from sceneprint.store.tables import jobs
from service.auth import ALL_AT_ONCE, RefusalFilter
from service.browser_security import origins_of
from service.limits import (
    IN_MEMORY,
    REFUSALS,
    BodySpool,
    Broken,
    Holdings,
    RequestBody,
    Turns,
    share,
)  # fmt: skip
from service.metrics import MOST_TENANTS, Metrics
from service.middleware import RequestMiddleware
from tests.service.conftest import Clock
from tests.whole_engine import Engine


@pytest.fixture(scope="module")
def shared(wall):
    """A service with two keys of one tenant, and one of another."""
    held = wall(
        {"victim": {"*": "admin"}}, "--workers", "0", max_event_streams=8, tenant_requests_per_s=0
    )
    with Engine(Settings(data_dir=held.server.folder, database_url=None)) as engine:
        create_tenant(engine.store, "noisy")
        for name in ("one", "two"):
            key = engine.create_key(name, {"*": "admin"}, tenant="noisy")
            held.secrets[name] = key.secret
    return held


def test_two_authorization_headers_are_refused_whoever_sends_them(shared, refused):
    for path in ("/v1/maps", "/healthz"):
        headers = [("Authorization", f"Bearer {shared.secrets['one']}"),
                   ("Authorization", "Bearer made-up")]  # fmt: skip
        answer = shared.server.client.get(path, headers=headers)
        refused(answer, 400, "ambiguous-key")


def test_keys_of_a_tenant_share_its_streams_and_leave_some_to_others(shared, until):
    def listen(key, stack):
        wire = stack.enter_context(shared.server.connect())
        wire.sendall(
            "GET /v1/events HTTP/1.1\r\nHost: localhost\r\nAccept: text/event-stream\r\n"
            f"Authorization: Bearer {shared.secrets[key]}\r\n\r\n".encode()
        )
        return wire.recv(12)

    with ExitStack() as stack:
        said = [listen("one" if i % 2 else "two", stack) for i in range(8)]
        assert said == [b"HTTP/1.1 200"] * 6 + [b"HTTP/1.1 429"] * 2
        assert [listen("victim", stack) for _ in range(2)] == [b"HTTP/1.1 200"] * 2
        assert shared.ask("one", "GET", "/v1/keys/me").status_code == 200


def test_keys_tell_their_tenant(shared, refused):
    listed = shared.ask("victim", "GET", "/v1/keys").json()["items"]
    assert {row["name"]: row["tenant"] for row in listed} == {
        "victim": "victim", "one": "noisy", "two": "noisy",
    }  # fmt: skip
    new = {"name": "three", "grants": {"*": "read"}, "tenant": "nobody"}
    answer = shared.ask("victim", "POST", "/v1/keys", json=new)
    refused(answer, 404, "unknown-tenant", "no tenant named 'nobody'")
    response = shared.ask("victim", "POST", "/v1/keys", json=new | {"tenant": "noisy"})
    assert (response.status_code, response.json()["tenant"]) == (201, "noisy")
    assert shared.ask("victim", "DELETE", "/v1/keys/three").status_code == 204


def test_audit_lines_name_the_tenant_of_the_key(shared):
    """A change and a refusal: by the tenant, not by the key's name."""
    new = {"name": "four", "grants": {"*": "read"}, "tenant": "noisy"}
    shared.secrets["four"] = shared.ask("two", "POST", "/v1/keys", json=new).json()["secret"]
    assert shared.ask("four", "POST", "/v1/keys", json=new).status_code == 403
    lines = [
        (item["action"], item["tenant"])
        for name in ("two", "four")
        for item in shared.ask("victim", "GET", f"/v1/audit?actor={name}&limit=1").json()["items"]
    ]
    assert lines == [("key.created", "noisy"), ("refused", "noisy")]


def test_a_job_is_of_the_tenant_that_asked(shared, small_shots):
    assert shared.ask("two", "POST", "/v1/maps", json={"name": "asked"}).status_code == 201
    path = "/v1/maps/asked/frames"
    job = shared.ask("two", "POST", path, **small_shots[0].form()).json()
    with (
        Engine(Settings(data_dir=shared.server.folder, database_url=None)) as engine,
        engine.store.database.read() as connection,
    ):
        query = select(jobs.c.tenant).where(jobs.c.id == job["job_id"])
        assert connection.execute(query).scalar_one() == "noisy"


def test_a_tenant_holds_three_quarters_at_most_and_gives_it_back():
    held = Holdings()
    assert [held.take("a", 1, 4) for _ in range(4)] == [True, True, True, False]
    assert held.take("b", 1, 4)
    assert [held.take("", 1, 4) for _ in range(9)] == [True] * 9  # where no key is asked for
    held.give("a", 1)
    assert (held.take("a", 1, 4), held.total) == (True, 13)
    assert [share(room) for room in (1, 4, 66, 100)] == [1, 3, 49, 75]


def test_turns_alternate_between_tenants_and_leave_half_to_others():
    async def test():
        clock = Clock()
        turns, order = Turns(4, clock=clock), []

        async def ask(tenant, weight=1):
            await turns.acquire(tenant, weight)
            order.append(tenant)

        await asyncio.gather(*(ask("a") for _ in range(4)))  # alone it has all
        waiting = [asyncio.create_task(ask(name)) for name in "aaabb"]
        await asyncio.sleep(0)
        assert order == ["a"] * 4
        turns.release("a")
        turns.release("a")
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert order[4:] == ["b", "b"]  # the others of a wait: it has half
        turns.release("b")
        turns.release("a")
        for _ in range(3):
            await asyncio.sleep(0)
        assert order[6:] == ["a"]
        clock.now += 61.0  # b was gone for long, and holds one still: it counts
        late = asyncio.create_task(ask("a"))
        await asyncio.sleep(0)
        for task in (*waiting, late):
            task.cancel()
        await asyncio.gather(*waiting, late, return_exceptions=True)
        return order

    assert asyncio.run(test()) == ["a"] * 4 + ["b", "b", "a"]


@pytest.mark.parametrize("status", [401, 403, 429])
def test_refusals_come_late_to_who_does_not_stop(status):
    """Of one address; another is answered at once."""

    async def refuse(scope, receive, send):
        del scope, receive
        await send({"type": "http.response.start", "status": status, "headers": []})
        await send({"type": "http.response.body", "body": b"no"})

    settings = Settings(host="0.0.0.0")
    assert settings.asks_for_keys
    whole, full = Starlette(), RefusalFilter(Clock())
    for _ in range(ALL_AT_ONCE):  # as many as the audit log notes at once, so none is noted here
        full.count("", "192.0.2.9")
        full.count("", "192.0.2.10")
    whole.state.refusals = full
    app = RequestMiddleware(refuse, settings, origins_of(settings), Metrics())
    answered = []

    async def receive():
        return {"type": "http.request"}

    async def ask(address):
        async def send(message):
            if message["type"] == "http.response.start":
                answered.append(address)

        scope = {
            "type": "http", "method": "GET", "path": "/v1/maps", "headers": [],
            "query_string": b"", "client": (address, 1), "app": whole,
        }  # fmt: skip
        await app(scope, receive, send)

    async def test():
        asking = [asyncio.create_task(ask("192.0.2.1")) for _ in range(REFUSALS + 5)]
        other = asyncio.create_task(ask("192.0.2.2"))
        await other
        assert sorted(answered) == ["192.0.2.1"] * REFUSALS + ["192.0.2.2"]
        done, late = await asyncio.wait(asking, return_when=asyncio.FIRST_COMPLETED)
        assert (len(done), len(late)) == (REFUSALS, 5)
        for one in late:
            one.cancel()
        await asyncio.gather(*late, return_exceptions=True)

    asyncio.run(test())


class SmallSpool(BodySpool):
    """With room for eight MiB."""

    def _room(self):
        return 8 << 20


def test_a_body_is_charged_before_it_is_written_and_given_back():
    spool, half = SmallSpool(), IN_MEMORY // 2

    async def receive():
        return {"type": "http.request", "body": bytes(half), "more_body": True}

    async def read(body, count):
        for _ in range(count):
            await body.next()

    first = RequestBody(receive, 1 << 30)
    first.charge(spool, "a")
    asyncio.run(read(first, 2))  # one MiB is kept in memory
    spool.require_room("a", 7 << 20)
    with pytest.raises(RateLimited, match="more than 6 MiB of the service's temporary folder"):
        spool.require_room("a", (7 << 20) + 1)
    asyncio.run(read(first, 12))  # six more on disk
    assert spool.by_tenant() == {"a": 6 << 20}
    with pytest.raises(Broken):
        asyncio.run(read(first, 1))
    assert isinstance(first.fault, RateLimited)
    with pytest.raises(RateLimited):
        spool.require_room("a", 2 << 20)
    spool.require_room("b", 7 << 20)
    first.close()
    spool.require_room("a", 7 << 20)


def test_metrics_tell_tenants_apart(shared, until):
    assert shared.ask("one", "GET", "/v1/keys/me").status_code == 200
    assert shared.ask("two", "GET", "/v1/maps/nowhere").status_code == 404
    noisy = 'tenant="noisy"'
    with (
        Engine(Settings(data_dir=shared.server.folder, database_url=None)) as engine,
        engine.store.database.write() as connection, work_of("noisy"),
    ):  # fmt: skip
        waiting = waiting_by_tenant(connection).get("noisy", 0)
        for _ in range(3):
            enqueue(connection, "purge", None)

    def series(name):
        result = shared.ask("victim", "GET", "/metrics").text
        pattern = rf"^sceneprint_tenant_{name}{{(.*)}} (.*)$"
        return {text[0]: float(text[1]) for text in re.findall(pattern, result, re.MULTILINE)}

    seen = series("requests_total")
    assert seen['status="404",tenant="noisy"'] >= 1
    assert {re.search('tenant="(.*)"', name)[1] for name in seen} <= {"noisy", "victim"}
    until(lambda: series("waiting_jobs").get(noisy, 0.0) == waiting + 3)  # seen each second


def test_series_of_tenants_stay_few():
    metrics = Metrics()
    counters = metrics.tenants
    for number in range(MOST_TENANTS + 5):
        counters.request(f"t{number}", 200, 0.5)
    counters.update(requests_in_progress={"t0": 2, "t51": 3, "t52": 4, NOBODY: 9})
    text = generate_latest(metrics.registry).decode()
    assert text.count("sceneprint_tenant_requests_total{") == MOST_TENANTS + 1
    assert 'sceneprint_tenant_requests_total{status="200",tenant="(others)"} 5.0' in text
    assert 'sceneprint_tenant_requests_in_progress{tenant="t0"} 2.0' in text
    assert 'sceneprint_tenant_requests_in_progress{tenant="(others)"} 7.0' in text
