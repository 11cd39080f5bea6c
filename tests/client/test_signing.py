"""A robot that signs its frames with a service of its own, and sends them to the fleet's."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from sceneprint.engine import Engine
from sceneprint.engine.jobs.robot_signatures import FIRST
from sceneprint.errors import InvalidRequest, UnknownMap
from sceneprint.formats.dataset import FrameReference
from sceneprint.settings import Settings
from sceneprint.store.keys import find_named_key
from sceneprint.store.sender_rows import add_verified
from sceneprint_client import Client
from sceneprint_client.api import FrameState, NewMap


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Client]:
    """A client of a service that trusts robots, whose key has sent enough that was right."""
    data = tmp_path / "fleet"
    with Engine(Settings(data_dir=data, database_url=None)) as engine:
        secret = engine.create_key("cart", {"hall": "write"}).secret
        engine.create_map(NewMap(name="hall", model="depth"))
        with engine.store.database.write() as connection:
            for _ in range(FIRST):
                add_verified(connection, find_named_key(connection, "cart").id)
    process = subprocess.Popen(
        [sys.executable, "-m", "sceneprint", "serve", "--port", "0", "--data", str(data),
         "--workers", "1"],
        env={
            **os.environ, "SCENEPRINT_TRUST_SIGNATURES": "true", "SCENEPRINT_REQUIRE_KEYS": "true",
            "SCENEPRINT_SIGNED_SAMPLE": "1e-9",
        },
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        line = process.stdout.readline().decode()
        assert line.startswith("sceneprint: serving http://"), line
        with Client(line.split()[-1], secret) as client:
            yield client
    finally:
        process.terminate()
        process.communicate(timeout=30)


def test_a_robot_signs_and_the_fleet_does_not(
    fleet: Client, tmp_path: Path, references: tuple[FrameReference, ...]
) -> None:
    with Client.embedded(tmp_path / "robot") as own:
        own.create_map("copy", model="depth")
        package = own.sign("copy", references[0])
        assert own.map("copy").used_frames == 0
        added = fleet.upload("hall", references[0], signed=package, wait_s=120)
        assert (added.state, added.signed) == (FrameState.INDEXED, "kept")
        frame = fleet.frame("hall", added.frame_id)
        assert frame.signed_by == "robot"
        signed = fleet.put_frame(
            "hall", "second", references[1], signed=own.sign("copy", references[1]), wait_s=120
        )
        assert fleet.frame("hall", "second").signed_by == "robot"
        assert signed.signed == "kept"
        with pytest.raises(InvalidRequest, match="samples, camera or viewpoint differ"):
            fleet.upload("hall", references[2], signed=package)
        # its own service trusts nobody, and has no keys
        assert own.upload("copy", references[0], signed=package).signed == "off"
        with pytest.raises(UnknownMap):
            own.sign("attic", references[0])
