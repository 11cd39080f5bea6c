"""`sceneprint query --overlay`: the query aligned with its best match, as a file."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sceneprint_client import Client


def test_a_query_is_laid_on_its_match(
    sceneprint: Callable[..., Any], service_url: str, rooms: Path, tmp_path: Path
) -> None:
    path = tmp_path / "overlay.ply"
    sceneprint("upload", "overlaid", rooms / "room-0", "--create")
    one = ("query", "overlaid", rooms / "room-0", "--frame", "1", "--json")
    said = sceneprint(*one, "--overlay", path, "--color", "normal")
    answer = json.loads(said.stdout)
    best = answer["matches"][0]["frame_id"]
    assert said.stderr == f"{path}: the query aligned with {best} (frame-000001.depth.png)\n"
    with Client(service_url) as client:
        assert path.read_bytes() == client.overlay(answer["query_id"], best, color="normal")
        client.delete_map("overlaid")
    for arguments, why in (
        (("--overlay", tmp_path / "no" / "x.ply", "--frame", "1"), "No such file"),
        (("--overlay", path), "has 3 frames, but --overlay writes a single file"),
    ):
        refused = sceneprint("query", "overlaid", rooms / "room-0", *arguments, expect=2)
        assert why in refused.stderr
