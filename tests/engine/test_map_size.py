"""Tests of the disk use of a map, and of its trajectories."""

import pytest
from sqlalchemy import func, select

from sceneprint.engine.admin import statistics as measuring
from sceneprint.engine.maps.map_frames import trajectory, trajectory_file
from sceneprint.engine.maps.map_lifecycle import edit_frame
from sceneprint.formats.dataset import read_trajectory
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames, signatures
from sceneprint_client.api import NewMap
from sceneprint_client.api.listing import Run


def test_a_map_is_weighed(full, ids, monkeypatch):
    full.create_map(NewMap(name="shop", model="depth"))
    full.rebuild_index("hall")
    names = ids(full)
    with full.store.database.read() as connection:
        held = connection.execute(
            select(frames.c.bytes, func.length(signatures.c.vector), signatures.c.geometry)
            .join(signatures, signatures.c.frame_number == frames.c.number)
            .order_by(frames.c.number)
        ).all()
    folder = full.settings.data_dir
    on_disk = sum(p.stat().st_size for p in (folder / "blobs").glob("*/*"))
    told = full.statistics.collect(1, "hall").bytes
    assert told.blobs == on_disk
    assert told.database == sum(one[1] for one in held)
    assert told.index == sum(p.stat().st_size for p in _files(folder / "index"))
    assert (told.free, told.disk) == (None, None)
    shop = full.statistics.collect(1, "shop").bytes
    assert (shop.database, shop.blobs, shop.index) == (0, 0, 0)

    monkeypatch.setattr(measuring, "MEASURED_FRAMES", 4)  # the 1st, 4th, 7th and 10th stand for all
    some = [one for i, one in enumerate(held) if i % 3 == 0]
    artifacts = sum(full.store.blobs.path(one[2]).stat().st_size for one in some)
    with full.store.database.read() as connection:
        row = find_map(connection, "hall")
        told = measuring.sizes_of_map(connection, full.store, full.settings.indexes, row)
    assert told.blobs == (sum(one[0] for one in some) + artifacts) * 3
    assert told.database == sum(one[1] for one in some) * 3
    # what is deleted takes nothing
    full.delete_frame("hall", names[0])
    monkeypatch.setattr(measuring, "MEASURED_FRAMES", 1000)
    with full.store.database.read() as connection:
        told = measuring.sizes_of_map(connection, full.store, full.settings.indexes, row)
    assert told.database == sum(one[1] for one in held[1:])


def test_a_long_trajectory_is_thinned(full, ids, tmp_path, monkeypatch):
    from sceneprint.engine.maps import map_frames

    names = ids(full)
    for i, name in enumerate(names[:7]):
        at = None if i == 6 else f"2026-11-16T09:30:0{i}Z"
        pose = {"parent_frame": "hall"}
        edit_frame(full.store, "hall", name, {"session": "s", "captured_at": at, "pose": pose})
    whole = trajectory(full.store, "hall", Run(session="s"))
    monkeypatch.setattr(map_frames, "MOST_POSES", 3)  # a part of a run may be one of any length
    told = trajectory(full.store, "hall", Run(session="s", most=3))
    assert told.frame_ids == [names[i] for i in (0, 3, 5)]
    assert told.poses == [whole.poses[i] for i in (0, 3, 5)]
    assert (told.posed, told.left_out) == (6, 4)
    assert (whole.posed, whole.left_out) == (6, 1)
    text = trajectory_file(told)
    assert "# poses: 3 of 6, evenly spaced; frames left out: 4" in text
    (tmp_path / "a.tum").write_text(text)
    assert len(read_trajectory(tmp_path / "a.tum").stamps) == 3
    monkeypatch.undo()
    came = trajectory(full.store, "hall", Run(session="s", clock="received"))
    assert came.frame_ids == names[:7]  # the one without a time too
    uploaded = [full.get_frame("hall", name).received_at.timestamp() for name in names[:7]]
    assert [row[0] for row in came.poses] == pytest.approx(uploaded, abs=1e-6)
    assert (came.posed, came.left_out) == (7, 0)
    came = trajectory(full.store, "hall", Run(session="s", clock="received", most=2))
    assert came.frame_ids == [names[0], names[6]]
    whole = trajectory(full.store, "hall", Run(session="s", most=6))
    assert (len(whole.poses), whole.posed, whole.left_out) == (6, 6, 1)
    assert "# poses: 6; frames left out: 1" in trajectory_file(whole)


def _files(folder):
    return [path for path in folder.rglob("*") if path.is_file()]
