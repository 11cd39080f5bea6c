"""Rates of tenants over all services of a PostgreSQL database."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import delete, insert, select, text

from sceneprint.cli.demo import serving
from sceneprint.engine import Engine
from sceneprint.settings import Settings
from sceneprint.store import Store, open_database
from sceneprint.store.database import Database
from sceneprint.store.tables import samples
from service.limits import RateLimits, TokenBucket
from service.shared_rates import SharedRates

PER_S = 10.0
BURST = 50


class Host:
    """A service: its limits, on a clock that is set by hand."""

    def __init__(self, database: Database, clock: Callable[[], float], name: str) -> None:
        self.limits = RateLimits(PER_S, 60.0)
        self.limits.requests = TokenBucket("requests", PER_S, BURST, clock=clock)
        self.rates = SharedRates(database, self.limits, name)

    def admits(self, tenant: str, cost: float = 1.0) -> bool:
        state = self.limits.requests.take(tenant, cost)
        assert state is not None
        assert state.left >= 0
        return state.allowed


@pytest.fixture
def now() -> list[float]:
    """Seconds, set by hand."""
    return [1000.0]


@pytest.fixture
def hosts(server_store: Store, now: list[float]) -> list[Host]:
    """Four services that have told each other of what was before."""
    found = [Host(server_store.database, lambda: now[0], f"host-{i}") for i in range(4)]
    for one in found:
        one.rates.exchange()
    return found


def exchange(hosts: list[Host]) -> None:
    for _ in range(2):  # what one tells last, the first hears the next time
        for one in hosts:
            one.rates.exchange()


def test_what_is_spent_at_one_service_is_gone_at_the_others(hosts: list[Host]) -> None:
    first, second, *_ = hosts
    assert all(first.admits("fleet", 5.0) for _ in range(10))
    assert second.admits("fleet")  # nobody has told it yet
    exchange(hosts)
    assert [one.admits("fleet") for one in hosts] == [False] * 4
    assert all(one.admits("other", 10.0) for one in hosts)  # who was quiet is refused nothing


def test_over_a_long_time_the_rate_holds_whatever_is_asked_everywhere(
    hosts: list[Host], now: list[float]
) -> None:
    """What exceeded it within an exchange is owed."""
    begun, admitted = now[0], 0
    for _ in range(60):
        now[0] += 1.0
        for one in hosts:
            admitted += sum(one.admits("fleet") for _ in range(100))
        exchange(hosts)
    seconds = now[0] - begun
    most = BURST + PER_S * seconds
    assert admitted <= most + len(hosts) * BURST  # what may be owed at the end
    assert admitted >= PER_S * seconds
    now[0] += 40 * BURST / PER_S  # whatever was owed is paid, and no more than a bucket is there
    for one in hosts:
        assert sum(one.admits("fleet") for _ in range(100)) == BURST


def test_nothing_is_charged_twice_nor_missed_where_it_was_committed_late(
    hosts: list[Host], server_store: Store
) -> None:
    first, second = hosts[:2]
    assert first.admits("fleet", 20.0)
    exchange(hosts)
    exchange(hosts)
    assert second.admits("fleet", 30.0)  # 20 of 50 were spent, once
    assert not second.admits("fleet")
    with server_store.database.write() as connection:
        made = insert(samples).values(at=0.0, process="slow", kind="rates", data={})
        number = connection.execute(made.returning(samples.c.number)).scalar_one()
    exchange(hosts)
    with server_store.database.write() as connection:  # numbered before it, committed after it
        connection.execute(delete(samples).where(samples.c.number == number))
        late = {"number": number, "at": 0.0, "process": "slow", "kind": "rates"}
        connection.execute(insert(samples).values(**late, data={"requests": {"late": 50.0}}))
    second.rates._seen.discard(number)
    exchange([second])
    assert not second.admits("late")


def test_what_could_not_be_told_is_told_later(
    hosts: list[Host], server_store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = hosts[:2]
    assert first.admits("fleet", 50.0)
    with renamed(server_store.database):
        for _ in range(3):
            first.rates.exchange()
        assert second.admits("fleet", 5.0)  # each by itself meanwhile
    assert [one.message for one in caplog.records].count("rates not shared") == 1
    first.rates.exchange()
    second.rates.exchange()
    assert not second.admits("fleet")


def test_the_greatest_spenders_are_told_first_and_the_others_the_next_time(
    hosts: list[Host], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.shared_rates.MOST_TOLD", 2)
    first, second = hosts[:2]
    for caller, cost in {"a": 3.0, "b": 50.0, "c": 40.0}.items():
        assert first.admits(caller, cost)
    first.rates.exchange()
    second.rates.exchange()
    assert [second.admits(one, 48.0) for one in "abc"] == [True, False, False]
    first.rates.exchange()
    second.rates.exchange()
    assert not second.admits("a")  # 48 here and 3 there


def test_samples_of_rates_go_after_a_minute_and_no_others(
    hosts: list[Host], server_store: Store
) -> None:
    old = time.time() - 61
    with server_store.database.write() as connection:
        for kind in ("rates", "service"):
            connection.execute(insert(samples).values(at=old, process="old", kind=kind, data={}))
    assert hosts[0].admits("fleet")
    hosts[0].rates.exchange()
    with server_store.database.read() as connection:
        left = connection.execute(
            select(samples.c.kind, samples.c.process).order_by(samples.c.number)
        )
        assert [tuple(one) for one in left] == [("service", "old"), ("rates", "host-0")]


@contextmanager
def renamed(database: Database) -> Iterator[None]:
    """Without the table that services tell each other by."""
    for before, after in (("samples", "away"), ("away", "samples")):
        with database.write() as connection:
            connection.execute(text(f"ALTER TABLE {before} RENAME TO {after}"))
        if after == "away":
            yield


def test_real_services_share_the_rates_of_keys(
    postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    until: Callable[[Callable[[], Any]], Any],
) -> None:  # fmt: skip
    """Each key may ask once in a thousand seconds; the second service hears of the first."""
    for name, value in {
        "DATABASE_URL": postgres_url, "REQUIRE_KEYS": "1", "REQUESTS_PER_S": "0.001",
        "BLOB_URL": f"file://{tmp_path / 'blobs'}",
    }.items():  # fmt: skip
        monkeypatch.setenv(f"SCENEPRINT_{name}", value)
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
    with Engine(Settings(data_dir=folders[0])) as engine:
        secrets = [engine.create_key(f"robot-{i}").secret for i in range(400)]

    robot = httpx.Client(trust_env=False)  # one for all: each reads the certificates anew

    def ask(url: str, secret: str) -> int:
        headers = {"Authorization": f"Bearer {secret}"}
        return robot.get(f"{url}/v1/maps/none", headers=headers).status_code

    with robot, serving(folders[0], 0) as one, serving(folders[1], 0) as other:
        assert {ask(one, secret) for secret in secrets} == {404}
        left = iter(secrets)  # of each the second service decides once
        assert until(lambda: ask(other, next(left)) == 429)
    with closing(open_database(postgres_url)) as database, database.read() as connection:
        told = connection.execute(text("SELECT DISTINCT kind FROM samples")).scalars().all()
    assert "rates" in told
