"""Tests of `sceneprint audit`: the newest entries, and all entries as JSON lines or syslog
messages.
"""

import json
import re

import pytest

MESSAGE = re.compile(r"<109>1 \d{4}-\d\d-\d\dT[\d:.]{12}Z \S+ sceneprint - audit - (\{.*\})")


@pytest.fixture
def data(sceneprint, tmp_path):
    for arguments in (("--create", "robot"), ("--create", "screen"), ("--revoke", "robot")):
        sceneprint("keys", *arguments, "--data", tmp_path)
    sceneprint("keys", "--create-tenant", "fleet", "--data", tmp_path)
    return tmp_path


def test_the_newest_entries_are_printed(sceneprint, data):
    lines = sceneprint("audit", "--data", data).stdout.splitlines()
    assert [line[22:] for line in lines] == [
        "command  tenant.created fleet", "command  key.revoked robot",
        "command  key.created screen", "command  key.created robot",
    ]  # fmt: skip
    for options, wanted in (
        (("--limit", "1"), lines[:1]), (("--action", "key.c"), lines[2:]),
        (("--actor", "robot"), []), (("--map", "yard"), []), (("--since", "1h"), lines),
    ):  # fmt: skip
        assert sceneprint("audit", *options, "--data", data).stdout.splitlines() == wanted


def test_all_entries_are_exported(sceneprint, data):
    export = ("audit", "--data", data, "--format")
    lines = sceneprint(*export, "jsonl").stdout.splitlines()
    body = [json.loads(line) for line in lines]
    assert [(item["number"], item["action"]) for item in body] == [
        (1, "key.created"), (2, "key.created"), (3, "key.revoked"), (4, "tenant.created"),
    ]  # fmt: skip
    assert body[0]["data"] == {
        "name": "robot", "grants": {"*": "admin"}, "tenant": "robot", "expires_at": None
    }  # fmt: skip
    file = data / "audit.log"
    assert sceneprint(*export, "syslog", "--output", file).stdout == ""
    messages = [MESSAGE.fullmatch(line) for line in file.read_text().splitlines()]
    assert [message and message[1] for message in messages] == lines
    sceneprint(*export, "jsonl", "--output", file, "--actor", "command")
    assert file.read_text().splitlines()[4:] == lines  # behind what was there
