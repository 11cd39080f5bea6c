"""`sceneprint events` against a real service."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import Client

Run = Callable[..., tuple[str, str]]


def test_events_are_listed(sceneprint: Run, service_url: str) -> None:
    with Client(service_url) as client:
        client.create_map("events-a", model="depth")
        before = client.event_page(limit=1).newest
        client.create_map("events-b", model="depth")
        client.delete_map("events-b")
        made, gone = [
            client.event_page(kinds=[kind], limit=1).items[0] for kind in ("map.cr", "map.del")
        ]
    (said, _) = sceneprint("events", "--kind", "map.", "--limit", 2)
    assert [line.split() for line in said.splitlines()] == [
        [one.id, f"{one.at:%Y-%m-%d}", f"{one.at:%H:%M:%S}", kind, "events-b"]
        for one, kind in ((made, "map.created"), (gone, "map.deleted"))
    ]
    (said, _) = sceneprint("events", "--map", "events-a", "--json")
    (line,) = said.splitlines()
    assert json.loads(line)["kind"] == "map.created"
    (said, _) = sceneprint("events", "--after", made.id, "--kind", "map.")
    assert [line.split()[0] for line in said.splitlines()] == [gone.id]
    (said, _) = sceneprint("events", "--after", before, "--kind", "map.", "--limit", 1)
    assert [line.split()[0] for line in said.splitlines()] == [made.id]
    (said, told) = sceneprint("events", "--map", "events-b", expect=2)
    assert (said, "There is no map 'events-b'." in told) == ("", True)


def test_events_are_followed_line_by_line(service_url: str) -> None:
    with Client(service_url) as client:
        newest = client.event_page(limit=1).newest
        command = [sys.executable, "-m", "sceneprint", "events", "--follow", "--url", service_url]
        process = subprocess.Popen(
            [*command, "--after", newest, "--kind", "map.", "--json"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            # shells start what they run in the background with the signal ignored
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            for name in ("followed-1", "followed-2"):
                client.create_map(name, model="depth")
                assert json.loads(process.stdout.readline())["map"] == name
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)
        assert (process.returncode, process.stderr.read()) == (130, "sceneprint events: stopped\n")
        process.stdout.close()
        process.stderr.close()
