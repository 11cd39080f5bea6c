"""Tests that pages and names of other hosts cannot reach a local service."""

import pytest

HERE = ["localhost", "LocalHost", "127.0.0.1", "127.8.9.10", "[::1]", "[0:0:0:0:0:0:0:1]"]
ELSEWHERE = [
    "evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "192.168.1.7", "0.0.0.0",
    "[fe80::1]", "[::]", "127.0.0.1@evil.example", "evil.example:80:8008", "::1", "[::1",
    "2130706433", "localhost,evil.example", "", ":8008", "\xe9",
]  # fmt: skip
PATHS = ["/healthz", "/readyz", "/metrics", "/openapi.json", "/docs", "/v1/maps", "/v1/nothing"]


@pytest.mark.parametrize("port", ["", ":8008", ":1"])
@pytest.mark.parametrize("host", HERE)
def test_by_its_own_names_it_answers_on_any_port(served, host, port):
    assert served.client.get("/v1/maps", headers={"Host": host + port}).status_code == 200
    headers = {"Host": host + port, "Origin": f"http://{host}{port}"}
    assert served.client.get("/v1/maps", headers=headers).status_code == 200


@pytest.mark.parametrize("path", PATHS)
def test_by_another_name_nothing_is_told(served, refused, path):
    answer = served.client.get(path, headers={"Host": "evil.example:8008"})
    problem = refused(answer, 421, "misdirected", "for the host 'evil.example:8008'")
    assert (problem["title"], answer.headers["connection"]) == ("Misdirected", "close")
    answer = served.client.get(path, headers={"Origin": "https://evil.example"})
    refused(answer, 403, "foreign-origin", "A page of 'https://evil.example'")


@pytest.mark.parametrize("host", ELSEWHERE)
def test_what_only_looks_like_a_name_of_ours_is_none(served, refused, host):
    headers = {"Host": host.encode("latin-1")}
    refused(served.client.get("/v1/maps", headers=headers), 421, "misdirected")
    for origin in (f"http://{host}", host):
        headers = {"Origin": origin.encode("latin-1")}
        refused(served.client.get("/v1/maps", headers=headers), 403, "foreign-origin")


@pytest.mark.parametrize("origin", ["null", "file://", "//localhost/x"])
def test_a_page_without_a_host_is_a_strangers(served, refused, origin):
    refused(served.client.get("/v1/maps", headers={"Origin": origin}), 403, "foreign-origin")


def test_a_page_makes_nothing_and_its_body_is_not_waited_for(served, refused):
    headers = {"Origin": "http://evil.example", "Content-Type": "application/json"}
    answer = served.client.post("/v1/maps", content=b'{"name": "stolen"}', headers=headers)
    refused(answer, 403, "foreign-origin")
    refused(served.client.get("/v1/maps/stolen"), 404, "unknown-map")
    head = b"POST /v1/maps HTTP/1.1\r\nHost: evil.example\r\nContent-Length: 99\r\n\r\n"
    with served.connect() as wire:
        wire.sendall(head)  # and nothing of the body
        assert wire.recv(65536).startswith(b"HTTP/1.1 421 ")


@pytest.mark.parametrize(
    ("path", "site", "kind"),
    [
        *((path, "cross-site", "image") for path in PATHS),
        *(("/v1/maps", site, "image") for site in ("same-site", "Cross-Site", "new-word")),
        *(("/v1/maps", "cross-site", kind) for kind in ("empty", "iframe")),
    ],
)
def test_a_page_of_others_that_sends_no_origin_is_told_nothing(served, refused, path, site, kind):
    headers = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": kind, "Sec-Fetch-Mode": "no-cors"}
    answer = served.client.get(path, headers=headers)
    refused(answer, 403, "foreign-origin", "A page of another origin loaded this address")


@pytest.mark.parametrize("site", ["same-origin", "none"])
def test_our_own_pages_and_typed_addresses_are_answered(served, site):
    for path in ("/v1/maps", "/docs", "/openapi.json"):
        assert served.client.get(path, headers={"Sec-Fetch-Site": site}).status_code == 200


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/", 307), ("/dashboard", 200), ("/dashboard/", 307), ("/docs", 200),
        ("/v1/maps", 403), ("/openapi.json", 403), ("/docs/start.js", 403),
        ("/dashboard/main.js", 403), ("/v1/maps/dashboard", 403),
    ],
)  # fmt: skip
def test_a_link_of_others_leads_to_pages_and_to_nothing_else(served, path, status):
    headers = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Accept": "text/html"}
    followed = served.client.get(path, headers=headers | {"Sec-Fetch-Dest": "document"})
    assert followed.status_code == status
    framed = served.client.get(path, headers=headers | {"Sec-Fetch-Dest": "iframe"})
    assert framed.status_code == 403


def test_a_page_of_this_machine_that_says_who_it_is_may_ask(served):
    headers = {"Origin": "http://localhost:3000", "Sec-Fetch-Site": "same-site"}
    assert served.client.get("/v1/maps", headers=headers).status_code == 200


def test_where_keys_are_asked_for_any_name_will_do(walled, refused):
    wide = walled.server
    for headers in ({"Host": "map.example"}, {"Origin": "https://map.example"}):
        assert wide.client.get("/healthz", headers=headers).status_code == 200
        refused(wide.client.get("/v1/maps", headers=headers), 401, "key-required")
