"""A service that searches with Qdrant's engine, over HTTP: asked, killed, and started again."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.bulk_load import fill, walk
from sceneprint.engine import Engine
from sceneprint.models import Model
from sceneprint.settings import Settings

FRAMES = 400


def generation(server: Any) -> int:
    """Number of the newest index of the map, by the service's metrics."""
    text = server.client.get("/metrics").text
    found = re.search(r'^sceneprint_index_generation\{map="hall"\} (\d+)', text, re.MULTILINE)
    return 0 if found is None else int(found[1])


def ask(server: Any, number: int) -> list[tuple[str, int]]:
    body = {"frame_id": f"hall-{number}", "stages": ["retrieve"], "k": 40}
    answer = server.client.post("/v1/maps/hall/queries", json=body).raise_for_status().json()
    assert answer["exact"] is True
    return [(one["frame_id"], one["distance"]) for one in answer["matches"]]


def test_it_serves_is_killed_and_serves_again(
    begin: Any, small_whitened: Model, tmp_path: Path, until: Any
) -> None:
    made, alive = walk(FRAMES, 24, seed=2), set(range(1, FRAMES + 1))
    with Engine(Settings(data_dir=tmp_path)) as engine:
        fill(engine.store.database, "hall", small_whitened, made)

    def wanted(number: int) -> list[tuple[str, int]]:
        apart = ((made.astype(int) - made[number - 1]) ** 2).sum(axis=1)
        ranked = sorted((int(apart[i - 1]), i) for i in alive - {number})
        return [(f"hall-{i}", distance) for distance, i in ranked[:40]]

    given = {"folder": tmp_path, "search": "qdrant", "tail_frames": 10, "undo_s": 0}
    server = begin(**given)
    until(lambda: generation(server) == 1)
    assert list(tmp_path.glob("index/hall-*/*.qdrant"))
    for number in (1, 77, 400):
        assert ask(server, number) == wanted(number)
    for number in range(70, 100, 3):
        assert server.client.delete(f"/v1/maps/hall/frames/hall-{number}").status_code == 204
        alive.discard(number)
    assert ask(server, 77) == wanted(77)
    server.kill()
    again = begin(**given)
    assert ask(again, 77) == wanted(77)
    assert again.client.delete("/v1/maps/hall").status_code == 204
    until(lambda: not list(tmp_path.glob("index/hall-*")))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"search": "qdrant", "index_url": "file:///tmp/shared"}, "SCENEPRINT_INDEX_URL"),
        ({"search": "quadrant"}, "SCENEPRINT_SEARCH"),
    ],
)
def test_a_wrong_setting_ends_the_start(begin: Any, settings: dict[str, str], told: str) -> None:
    server = begin(wait=False, **settings)
    assert server.end() == 2
    (line,) = server.errors.read_text().splitlines()
    assert told in line


def test_without_the_package_the_start_ends(tmp_path: Path) -> None:
    """As in an environment that lacks the extra: the package is there, and is hidden."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as util\n"
        "real = util.find_spec\n"
        "hidden = lambda name, *more: None if name == 'qdrant_edge' else real(name, *more)\n"
        "util.find_spec = hidden\n"
    )
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    ended = subprocess.run(
        [sys.executable, "-m", "sceneprint", "serve", "--port", "0", "--data", str(tmp_path)],
        env=os.environ | {"PYTHONPATH": path, "SCENEPRINT_SEARCH": "qdrant"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "SCENEPRINT_SEARCH" in line
    assert "pip install 'sceneprint[qdrant]'" in line
