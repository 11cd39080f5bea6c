"""Tests that client and service derive the same problem names from one function."""

from __future__ import annotations

import pytest

from sceneprint import errors as our_errors
from sceneprint_client import Client, errors, http
from sceneprint_client.api.base import is_loopback
from service.problems import type_of

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type)
    and issubclass(kind, errors.SceneprintError)
    and not issubclass(kind, errors.ServiceError)
]


def test_every_error_keeps_its_name_over_http() -> None:
    assert errors.kebab_case("UnknownMap") == "unknown-map"
    assert errors.kebab_case("Busy") == "busy"
    assert len(KINDS) > 25
    told = {type_of(kind.__name__).removeprefix("/problems/"): kind for kind in KINDS}
    assert http.problem_kinds() == told
    assert our_errors.kebab_case is errors.kebab_case  # both ask the same place


@pytest.mark.parametrize(
    ("host", "proxied"),
    [("127.0.0.1", False), ("127.9.9.9", False), ("[::1]", False), ("LOCALHOST", False),
     ("192.0.2.1", True), ("localhost.example", True)],
)  # fmt: skip
def test_no_proxy_stands_before_this_machine(
    monkeypatch: pytest.MonkeyPatch, host: str, proxied: bool
) -> None:
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.setenv("http_proxy", "http://192.0.2.7:3128")
    asked: list[str] = []

    def noted(given: str) -> bool:
        asked.append(given)
        return is_loopback(given)

    monkeypatch.setattr("sceneprint_client.http.is_loopback", noted)
    with Client(f"http://{host}:8008") as client:
        mounts = client._http._mounts
    assert (len(mounts) > 0, asked) == (proxied, [host.strip("[]").lower()])
