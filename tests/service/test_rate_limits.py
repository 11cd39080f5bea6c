"""Tests of token buckets with a controlled clock."""

from types import SimpleNamespace

import pytest
from starlette.requests import Request

from sceneprint_client.api import Frame, Page
from service.limits import TokenBucket, network_of, request_cost
from tests.service.conftest import Clock


def test_a_rested_caller_may_ask_at_once_and_then_at_the_rate():
    clock = Clock()
    limit = TokenBucket("key", per_s=2.0, burst=3, clock=clock)
    assert [limit.take("a") for _ in range(4)] == [0, 0, 0, 1]
    clock.now += 0.5  # one token more
    assert [limit.take("a") for _ in range(2)] == [0, 1]
    clock.now += 100  # never more than full
    assert [limit.take("a") for _ in range(4)] == [0, 0, 0, 1]


def test_who_is_refused_pays_nothing_for_it():
    """Else a caller that does not wait would never be let in again."""
    clock = Clock()
    limit = TokenBucket("key", per_s=1.0, burst=1, clock=clock)
    assert limit.take("a") == 0
    for _ in range(9):
        clock.now += 0.1
        assert limit.take("a") > 0
    clock.now += 0.11
    assert limit.take("a") == 0


def test_a_crowd_of_addresses_takes_no_more_room_and_frees_none_that_was_just_seen():
    clock = Clock()
    limit = TokenBucket("address", per_s=0.001, burst=1, most=50, clock=clock)
    assert limit.take("busy") == 0
    for number in range(1_000):
        clock.now += 0.001
        limit.take(f"10.0.{number // 256}.{number % 256}")
        assert len(limit._buckets) <= 50
        assert limit.take("busy") > 0  # kept in mind, as it goes on asking


def test_what_costs_more_takes_more_and_is_refused_until_it_is_there():
    clock = Clock()
    limit = TokenBucket("key", per_s=2.0, burst=10, clock=clock)
    assert [limit.take("a", 5.0) for _ in range(3)] == [0, 0, 3]
    clock.now += 2.5
    assert limit.take("a", 5.0) == 0
    clock.now += 5.0
    assert limit.take("a", 99.0) == 0  # never more than a rested caller has


@pytest.mark.parametrize(
    ("method", "path", "query", "model", "cost"),
    [
        ("GET", "/v1/keys/me", b"", None, 1.0),
        ("POST", "/v1/maps/hall/queries", b"", None, 5.0),
        ("POST", "/v1/maps/hall/localize/sequence", b"", None, 5.0),
        ("POST", "/v1/maps/hall/queries/records", b"", None, 5.0),
        ("GET", "/v1/maps/hall/frames", b"", Page[Frame], 3.0),
        ("GET", "/v1/maps/hall/frames", b"limit=200", Page[Frame], 5.0),
        ("GET", "/v1/maps/hall/frames", b"limit=x", Page[Frame], 3.0),
    ],
)
def test_a_request_counts_by_its_work(method, path, query, model, cost):
    route = SimpleNamespace(response_model=model)
    scope = {"type": "http", "method": method, "path": path, "query_string": query,
             "headers": [], "route": route, "server": ("here", 80), "scheme": "http"}  # fmt: skip
    assert request_cost(Request(scope)) == cost


@pytest.mark.parametrize(
    ("address", "place"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", "unknown"),
        ("a robot", "unknown"),
    ],
)
def test_who_has_an_address_of_ipv6_has_its_network(address, place):
    assert network_of(address) == place
