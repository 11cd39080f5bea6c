"""`sceneprint keys`: made, listed and revoked in a data folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sceneprint.engine import Engine
from sceneprint.settings import Settings

Run = Callable[..., Any]


def test_keys_are_made_listed_and_revoked(sceneprint: Run, tmp_path: Path) -> None:
    def keys(*arguments: str, expect: int = 0) -> Any:
        return sceneprint("keys", *arguments, "--data", tmp_path, expect=expect)

    assert keys("--list").stdout == ""
    before = datetime.now(UTC).replace(microsecond=0)
    secrets = [keys("--create", name).stdout.strip() for name in ("robot 1", "robot 2")]
    lines = keys("--list").stdout.splitlines()
    assert [line[20:] for line in lines] == ["  robot 1", "  robot 2"]
    for line in lines:
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", line[:20])
        assert before <= datetime.fromisoformat(line[:20]) <= datetime.now(UTC)
    assert keys("--revoke", "robot 1").stdout == "key robot 1 is revoked\n"
    assert [line[22:] for line in keys("--list").stdout.splitlines()] == ["robot 2"]
    again = keys("--revoke", "robot 1", expect=2)
    assert again.stderr.startswith("sceneprint keys: There is no key named 'robot 1'")
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        assert [engine.key_name(secret) for secret in secrets] == [None, "robot 2"]


@pytest.mark.parametrize(
    "arguments", [(), ("--list", "--revoke", "x"), ("--create", "x", "--list")]
)
def test_one_thing_at_a_time(sceneprint: Run, arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit):
        sceneprint("keys", *arguments)
