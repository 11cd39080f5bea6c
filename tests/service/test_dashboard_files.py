"""Tests of the dashboard's files over HTTP; tests/dashboard tests them in a browser."""

import gzip

import pytest

from service import dashboard

POLICY = "default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
HTML = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}


def names():
    return [p.relative_to(dashboard.PAGES).as_posix() for p in dashboard.PAGES.rglob("*.*")]


def test_every_file_is_served_packed_guarded_and_not_sent_twice(served):
    assert {"main.js", "lib/api.js"} <= set(names())
    for name in names():
        on_disk = (dashboard.PAGES / name).read_bytes()
        with served.client.stream(
            "GET", f"/dashboard/{name}", headers={"Accept-Encoding": "gzip"}
        ) as response:
            packed = b"".join(response.iter_raw())
        assert response.status_code == 200, name
        assert gzip.decompress(packed) == on_disk
        assert response.headers["content-encoding"] == "gzip"
        assert response.headers["content-length"] == str(len(packed))
        assert response.headers["content-security-policy"] == POLICY
        assert response.headers["cache-control"] == "no-cache"
        assert response.headers["x-content-type-options"] == "nosniff"
        if name != "main.js":
            continue
        fields = {"If-None-Match": response.headers["etag"], "Accept-Encoding": "gzip"}
        again = served.client.get(f"/dashboard/{name}", headers=fields)
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["content-security-policy"] == POLICY
        plain = served.client.get(f"/dashboard/{name}", headers={"Accept-Encoding": "identity"})
        assert plain.content == on_disk
        assert "content-encoding" not in plain.headers
        assert plain.headers["etag"] != response.headers["etag"]  # other bytes, another tag


def test_the_page_is_at_the_address_without_a_slash(served):
    index = (dashboard.PAGES / "index.html").read_bytes()
    response = served.client.get("/dashboard")
    assert response.content == index
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    head = served.client.head("/dashboard")
    assert (head.status_code, head.content) == (200, b"")
    slash = served.client.get("/dashboard/")
    assert (slash.status_code, slash.headers["location"]) == (307, "../dashboard")


def test_a_browser_is_led_there_and_others_are_told_as_ever(served):
    led = served.client.get("/", headers=HTML)
    # relative: behind a proxy's prefix, and its TLS, it leads to the same place
    assert (led.status_code, led.headers["location"]) == (307, "dashboard")
    answer = served.client.get("/", headers={"Accept": "application/json"})
    assert answer.status_code == 404
    assert answer.json()["type"] == "/problems/not-found"


@pytest.mark.parametrize(
    "path",
    [
        "/dashboard/nothing.js", "/dashboard/lib", "/dashboard/lib/", "/dashboard//main.js",
        "/dashboard/../../app.py", "/dashboard/..%2f__init__.py", "/dashboard/%2e%2e/__init__.py",
        "/dashboard/lib/..%2fmain.js", "/dashboard/%2fetc%2fpasswd", "/dashboard/main.js%00",
    ],
)  # fmt: skip
def test_no_other_path_leads_to_a_file(served, path):
    response = served.client.get(path, headers=HTML)
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"
    assert response.json()["type"] == "/problems/not-found"
    assert "default-src 'none'" in response.headers["content-security-policy"]


def test_it_is_for_whom_the_service_is_for(served, refused):
    # a page of others that lets its name lead here gets nothing; a proxy's visitor needs no key yet
    answer = served.client.get("/dashboard", headers={**HTML, "Host": "evil.example"})
    refused(answer, 421, "misdirected")
    assert served.client.get("/dashboard", headers={"X-Forwarded-For": "192.0.2.7"}).is_success
