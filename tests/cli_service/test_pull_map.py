"""Tests of `sceneprint pull`, which copies maps of a running service to a robot's folder."""

import pytest

from sceneprint_client import Client


@pytest.mark.sqlite_only("a copy of a map is in a folder with SQLite")
def test_a_map_is_pulled_and_renewed(sceneprint, service_url, rooms, tmp_path):
    copy = tmp_path / "copy"
    with Client(service_url) as client:
        client.create_map("pulled", model="depth")
        client.create_map("pulled-too", model="depth")
        sceneprint("upload", "pulled", rooms / "room-0")
        said = sceneprint("pull", "--map", "pulled", "--map", "pulled-too", "--data", copy)
        lines = said.stdout.splitlines()
        assert lines[0].startswith(
            f"{copy} has map pulled of revision 3: 3 frames, 3 new or changed"
        )
        assert lines[1].startswith(f"{copy} has map pulled-too of revision 0: 0 frames, 0 new")
        said = sceneprint("pull", "--map", "pulled", "--data", copy)
        assert ", 0 new or changed, 0 removed; 0 artifacts, 0.0 MB fetched" in said.stdout
        online = sorted(frame.frame_id for frame in client.frames("pulled"))
    with Client.embedded(copy) as robot:
        assert sorted(frame.frame_id for frame in robot.frames("pulled")) == online
    said = sceneprint("pull", "--map", "nowhere", "--data", copy, expect=2)
    assert "nowhere" in said.stderr
    said = sceneprint("pull", "--map", "pulled", "--data", rooms, expect=2)
    assert "contains files, but no pulled maps" in said.stderr
