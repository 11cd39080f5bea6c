"""Tests of `sceneprint reencode`: start, progress, cancellation, and answers after the switch."""

import re

from sceneprint_client import Client


def test_a_map_is_signed_anew_while_its_service_runs(sceneprint, service_url, data_folder, rooms):
    def reencode(*arguments, expect=0):
        return sceneprint("reencode", "anew", *arguments, "--data", data_folder, expect=expect)

    sceneprint("upload", "anew", rooms / "room-0", "--model", "depth")
    assert re.fullmatch(r"map anew, model depth-[0-9a-f]{12}\n", reencode("--status").stdout)
    said = reencode("--model", "paper", "--wait").stdout
    assert re.fullmatch(r"map anew, model paper-[0-9a-f]{12}\n", said)
    assert reencode("--status").stdout == said
    with Client(service_url) as client:
        record = client.map("anew")
        assert (f"map anew, model {record.model}\n", record.reencoding) == (said, None)
        assert record.frames == {"indexed": 3}
    frame = next(iter(sorted(rooms.rglob("*.depth.png"))))
    answer = sceneprint("query", "anew", frame, "--json").stdout
    assert f'"model":"{record.model}"' in answer.replace(": ", ":")
    again = reencode("--model", "paper", expect=2).stderr
    assert again.startswith("sceneprint reencode: Map 'anew' already uses the model paper-")


def test_what_is_given_up_is_said(sceneprint, tmp_path):
    """In a folder on which no worker runs."""

    def reencode(*arguments, expect=0):
        return sceneprint("reencode", "hall", *arguments, "--data", tmp_path, expect=expect)

    with Client.embedded(tmp_path) as client:
        first = f"map hall, model {client.create_map('hall', model='depth').model}\n"
    begun = reencode("--model", "paper").stdout
    coming = r"next model: paper-[0-9a-f]{12}; 0 frames signed, 0 waiting\n"
    assert re.fullmatch(first + coming, begun)
    assert reencode("--status").stdout == begun
    assert reencode("--cancel").stdout == first
    assert len(reencode("--cancel", expect=2).stderr.splitlines()) == 1
