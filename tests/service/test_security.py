"""Tests of headers, origins, proxies, rate limits and keys."""

import re
from datetime import UTC, datetime, timedelta

import pytest

from sceneprint.errors import InvalidRequest
from sceneprint.settings import Settings
from service.auth import AGAIN_S, ALL_AT_ONCE, AT_ONCE, RefusalFilter
from service.browser_security import origins_of

FLEET = "https://fleet.example"
NOTHING = "default-src 'none'; frame-ancestors 'none'"


@pytest.fixture(scope="module")
def held(wall):
    """A server that soon has enough of a caller, and lets the pages of one origin ask."""
    return wall(
        {"robot": {"hall": "write"}}, "--workers", "0", "--host", "127.0.0.1", require_keys=True,
        tenant_requests_per_s=0.02, wrong_keys_per_minute=2, cors_origins=FLEET,
    )  # fmt: skip


def guarded(answer):
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["x-frame-options"] == "DENY"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cache-control"] == "no-store"
    assert answer.headers["content-security-policy"] == NOTHING


def test_every_answer_is_guarded(served):
    for answer in (
        served.client.get("/healthz"),
        served.client.get("/v1/maps"),
        served.client.get("/v1/maps/nowhere"),
        served.client.get("/nothing"),
        served.client.put("/v1/maps"),
        served.client.get("/v1/maps", headers={"Host": "evil.example"}),
        served.client.post("/v1/maps", content=b"{", headers={"Content-Type": "application/json"}),
    ):
        guarded(answer)


def test_a_key_that_is_sent_counts_where_none_is_required(served, make_map, refused):
    hall = make_map(served, "keyed-unasked")
    wrong = {"Authorization": "Bearer sp_wrong"}
    refused(served.client.get(hall, headers=wrong), 401, "key-required", "unknown, revoked")
    key = served.client.post("/v1/keys", json={"name": "reader", "grants": {hall[9:]: "read"}})
    try:
        shown = {"Authorization": f"Bearer {key.json()['secret']}"}
        assert served.client.get(hall, headers=shown).status_code == 200
        assert served.client.delete(hall, headers=shown).status_code == 403
    finally:
        assert served.client.delete("/v1/keys/reader").status_code == 204
    refused(served.client.get(hall, headers=shown), 401, "key-required")
    assert served.client.get(hall).status_code == 200


def test_the_page_of_the_api_loads_its_own_files_alone(served):
    page = served.client.get("/docs")
    assert page.status_code == 200
    policy = page.headers["content-security-policy"].split("; ")
    assert {"default-src 'self'", "frame-ancestors 'none'", "base-uri 'none'"} <= set(policy)
    names = re.findall(r'(?:src|href)="([^"]*)"', page.text)
    assert len(names) == 4
    for name in names:  # all are relative
        assert served.client.get(f"/{name}").status_code == 200


# origins


@pytest.mark.parametrize("path", ["/v1/maps", "/v1/maps/nowhere", "/healthz"])
def test_a_page_of_an_allowed_origin_may_ask_and_read(served, path):
    answer = served.client.get(path, headers={"Origin": FLEET})
    assert answer.status_code == (404 if "nowhere" in path else 200)
    assert answer.headers["access-control-allow-origin"] == FLEET
    assert answer.headers["vary"] == "Origin"
    exposed = {part.strip() for part in answer.headers["access-control-expose-headers"].split(",")}
    assert {"ETag", "Idempotent-Replayed", "Location", "Retry-After", "X-Request-Id"} <= exposed
    assert "access-control-allow-credentials" not in answer.headers


@pytest.mark.parametrize("origin", ["https://evil.example", "null", f"{FLEET}.evil.example",
                                    "http://fleet.example", f"{FLEET}:444"])  # fmt: skip
def test_a_page_of_another_origin_may_not(served, held, refused, origin):
    answer = served.client.get("/v1/maps", headers={"Origin": origin})
    refused(answer, 403, "foreign-origin", "SCENEPRINT_CORS_ORIGINS")
    assert "access-control-allow-origin" not in answer.headers
    answer = held.server.client.get("/healthz", headers={"Origin": origin})
    assert (answer.status_code, "access-control-allow-origin" in answer.headers) == (200, False)


def asked_before(origin):
    return {
        "Origin": origin, "Access-Control-Request-Method": "PUT",
        "Access-Control-Request-Headers": "authorization",
    }  # fmt: skip


def test_a_browser_asks_beforehand_and_needs_no_key_for_it(held, served):
    for server in (held.server, served):
        answer = server.client.options("/v1/maps/hall/frames/f", headers=asked_before(FLEET))
        assert (answer.status_code, answer.content) == (204, b"")
        assert answer.headers["access-control-allow-origin"] == FLEET
        methods = answer.headers["access-control-allow-methods"].split(", ")
        assert {"GET", "POST", "PUT", "PATCH", "DELETE"} == set(methods)
        headers = answer.headers["access-control-allow-headers"].lower().split(", ")
        assert {"authorization", "content-type", "if-match", "idempotency-key"} <= set(headers)


def test_a_browser_that_asks_for_another_page_hears_nothing_of_it(held):
    answer = held.server.client.options("/v1/maps", headers=asked_before("https://evil.example"))
    assert answer.status_code == 405
    assert not [name for name in answer.headers if name.startswith("access-control")]


def test_all_pages_are_not_let_in_where_no_key_is_asked_for(tmp_path):
    with pytest.raises(InvalidRequest, match="every web page"):
        origins_of(Settings(data_dir=tmp_path, cors_origins="*"))
    for asking in ({"host": "0.0.0.0"}, {"require_keys": True}):
        wide = origins_of(Settings(data_dir=tmp_path, cors_origins="*", **asking))
        assert (b"access-control-allow-origin", b"https://a.b") in wide.headers(b"https://a.b")


@pytest.mark.parametrize("text", ["fleet.example", "https://fleet.example/", "ftp://a", "a b"])
def test_an_origin_is_written_as_browsers_write_it(text):
    with pytest.raises(ValueError, match="is not an origin"):
        Settings(cors_origins=text)


# proxies


@pytest.mark.parametrize("header", ["X-Forwarded-For", "Forwarded", "X-Real-IP", "Via",
                                    "X-Forwarded-Proto"])  # fmt: skip
def test_what_comes_through_a_proxy_needs_a_key(served, refused, header):
    headers = {header: "127.0.0.1"}
    for path in ("/v1/maps", "/v1/jobs", "/metrics"):
        answer = served.client.get(path, headers=headers)
        refused(answer, 401, "key-required", f"it has the header {header.title()}")
    ready = served.client.get("/readyz", headers=headers)
    assert (ready.status_code, ready.json()["frames"]) == (200, None)


def test_with_its_key_a_caller_behind_a_proxy_has_what_the_key_may(served, refused):
    client = served.client
    key = client.post("/v1/keys", json={"name": "far", "grants": {"hall": "read"}})
    headers = {"X-Forwarded-For": "1.2.3.4", "Authorization": f"Bearer {key.json()['secret']}"}
    assert client.get("/v1/maps", headers=headers).status_code == 200
    me = client.get("/v1/keys/me", headers=headers).json()
    assert (me["name"], me["grants"]) == ("far", {"hall": "read"})
    refused(client.get("/v1/keys", headers=headers), 403, "forbidden", "'admin' for all maps")
    assert client.get("/v1/keys/me").json()["name"] is None  # here, without the proxy


# rates: one request, and then one each 50 s; two wrong keys, and then one each 30 s


def test_who_asks_too_often_is_asked_to_wait(held, refused):
    answers = [held.ask("robot", "GET", "/v1/keys/me") for _ in range(3)]
    assert [answer.status_code for answer in answers] == [200, 429, 429]
    refused(answers[2], 429, "rate-limited", "Too many requests. Retry in")
    assert 1 <= int(answers[2].headers["retry-after"]) <= 50


def test_wrong_keys_are_counted_and_right_ones_are_not_kept_out_by_them(held, refused):
    def try_key(secret):
        return held.server.client.get("/v1/maps", headers={"Authorization": f"Bearer {secret}"})

    answers = [try_key(f"sp_wrong{number}") for number in range(4)]
    assert [answer.status_code for answer in answers] == [401, 401, 429, 429]
    refused(answers[3], 429, "rate-limited", "Too many wrong keys. Retry in")
    assert try_key(held.secrets["robot"]).status_code in (200, 429)


# keys over HTTP, and the audit log


def test_a_key_is_made_shown_once_used_and_revoked(walled, refused):
    until = datetime.now(UTC) + timedelta(days=1)
    new = {"name": "robot/7 é", "grants": {"hall": "write"}, "expires_at": until.isoformat()}
    answer = walled.ask("boss", "POST", "/v1/keys", json=new)
    assert answer.status_code == 201
    assert answer.headers["location"] == "/v1/keys/robot%2F7%20%C3%A9"
    key = answer.json()
    assert key["secret"].startswith("sp_")
    assert datetime.fromisoformat(key["expires_at"]) == until
    walled.secrets["new"] = key["secret"]
    me = walled.ask("new", "GET", "/v1/keys/me").json()
    assert (me["name"], me["grants"]) == ("robot/7 é", {"hall": "write"})
    listed = walled.ask("boss", "GET", "/v1/keys?limit=3").json()
    assert [key["name"] for key in listed["items"]] == ["admin", "boss", "keeper"]
    rest = walled.ask("boss", "GET", f"/v1/keys?cursor={listed['next_cursor']}").json()
    assert [key["name"] for key in rest["items"]] == ["reader", "robot/7 é", "watcher", "writer"]
    assert key["secret"] not in str(listed) + str(rest)
    again = walled.ask("boss", "POST", "/v1/keys", json=new)
    refused(again, 409, "conflict")
    gone = walled.ask("boss", "DELETE", answer.headers["location"])
    assert gone.status_code == 204
    refused(walled.ask("new", "GET", "/v1/keys/me"), 401, "key-required")
    refused(walled.ask("boss", "DELETE", answer.headers["location"]), 404, "unknown-key")


def test_unknown_revoked_and_expired_keys_are_answered_alike(walled, refused):
    """Nothing tells whether there was such a key."""
    past = (datetime.now(UTC) - timedelta(seconds=1)).isoformat()
    new = {"name": "late", "grants": {"*": "admin"}, "expires_at": past}
    walled.secrets["late"] = walled.ask("boss", "POST", "/v1/keys", json=new).json()["secret"]
    del new["expires_at"]
    gone = {**new, "name": "gone"}
    walled.secrets["gone"] = walled.ask("boss", "POST", "/v1/keys", json=gone).json()["secret"]
    assert walled.ask("gone", "GET", "/v1/maps").status_code == 200
    assert walled.ask("boss", "DELETE", "/v1/keys/gone").status_code == 204
    walled.secrets["guess"] = "sp_" + "A" * (len(walled.secrets["late"]) - 3)
    answers = []
    for name in ("late", "gone", "guess"):
        answer = walled.ask(name, "GET", "/v1/maps", headers={"X-Request-Id": "alike"})
        refused(answer, 401, "key-required")
        alike = {key: value for key, value in answer.headers.items() if key != "date"}
        answers.append((alike, answer.content))
    assert answers[0] == answers[1] == answers[2]
    assert answer.json()["detail"].startswith(
        "The key that was sent is unknown, revoked or expired. Check that it is complete, or ask "
    )


@pytest.mark.parametrize(
    ("new", "field"),
    [
        ({}, "name"),
        ({"name": "a"}, "grants"),
        ({"name": "a", "grants": {"hall": "own"}}, "grants.hall"),
        ({"name": "a", "grants": {"No Map": "read"}}, "grants.No Map.[key]"),
        ({"name": "command", "grants": {"*": "read"}}, "name"),
        ({"name": "a", "grants": {"*": "read"}, "expires_at": "2030-01-01T00:00:00"}, "expires_at"),
        # as a date of UTC it would be of the year 10000, and no list of keys could tell it
        (
            {"name": "a", "grants": {"*": "read"}, "expires_at": "9999-12-31T23:59:59.999999Z"},
            "expires_at",
        ),
        ({"name": "a", "grants": {"*": "read"}, "secret": "sp_mine"}, "secret"),
    ],
)
def test_a_key_that_cannot_be_made_names_the_field(walled, refused, new, field):
    problem = refused(walled.ask("boss", "POST", "/v1/keys", json=new), 422, "invalid-request")
    assert [e["field"] for e in problem["errors"]] == [field] or field in str(problem["errors"])
    assert "a" not in [key["name"] for key in walled.ask("boss", "GET", "/v1/keys").json()["items"]]


def test_only_admins_of_all_have_to_do_with_keys(walled, refused):
    what = (("GET", "keys"), ("POST", "keys"), ("DELETE", "keys/boss"), ("GET", "audit"))
    for method, path in what:
        refused(walled.ask("watcher", method, f"/v1/{path}"), 403, "forbidden", "'watcher'")
    assert walled.ask("boss", "GET", "/v1/keys/me").status_code == 200


def test_figures_are_for_who_may_read_all(walled, refused):
    client = walled.server.client
    refused(client.get("/metrics"), 401, "key-required")
    assert walled.ask("watcher", "GET", "/metrics").status_code == 200
    of_one_map = walled.ask("reader", "GET", "/readyz").json()
    for bare in (client.get("/readyz").json(), of_one_map):
        assert (bare["status"], bare["frames"], bare["jobs"]) == ("ready", None, None)
    assert walled.ask("watcher", "GET", "/readyz").json()["frames"] is not None
    wrong = client.get("/readyz", headers={"Authorization": "Bearer sp_wrong"})
    refused(wrong, 401, "key-required")


def test_the_address_is_that_of_the_connection(walled):
    headers = {"X-Forwarded-For": "203.0.113.9", "Content-Type": "application/json"}
    created = walled.ask("boss", "POST", "/v1/maps", json={"name": "seen"}, headers=headers)
    assert created.status_code == 201
    (line,) = walled.ask("boss", "GET", "/v1/audit?map=seen").json()["items"]
    assert (line["address"], line["actor"]) == ("127.0.0.1", "boss")


def test_refusals_are_counted_for_each_caller_and_address():
    now = 0.0
    filtered = RefusalFilter(lambda: now)
    assert [filtered.count("robot", "10.0.0.1") for _ in range(AT_ONCE + 3)] \
        == [0] * AT_ONCE + [None] * 3  # fmt: skip
    assert filtered.count("robot", "10.0.0.2") == filtered.count("", "10.0.0.1") == 0
    now = AGAIN_S
    assert [filtered.count("robot", "10.0.0.1") for _ in range(2)] == [3, None]
    now += AGAIN_S
    # of one network of IPv6 all are one, and all callers together have a limit too
    one_by_one = [filtered.count("", f"2001:db8::{i:x}") for i in range(AT_ONCE + 1)]
    assert one_by_one == [0] * AT_ONCE + [None]
    many = [filtered.count("", f"10.1.{i}.1") for i in range(ALL_AT_ONCE)]
    assert many.count(0) == ALL_AT_ONCE - AT_ONCE
