"""`sceneprint index` on a data folder of twelve frames."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import update

from sceneprint.cli import main
from sceneprint.engine import Engine
from sceneprint.index import Generation, Tail, newest, publish, search, sketches
from sceneprint.index.generation_files import draw
from sceneprint.maintenance.fsck import indexes
from sceneprint.settings import Settings
from sceneprint.store.maps import add_frame, find_map, frame_of
from sceneprint.store.signatures import StoredSignature, index_frame
from sceneprint.store.tables import signatures
from sceneprint_client.api import NewMap

N, LENGTH = 60, 448


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A map of sixty frames like nothing else, and an empty one."""
    vectors = np.random.default_rng(5).integers(0, 256, (N, LENGTH), np.uint8)
    with Engine(Settings(data_dir=tmp_path / "data")) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        engine.create_map(NewMap(name="empty", model="depth"))
        artifact = engine.store.blobs.put(b"artifact" * 10)
        upload = engine.store.blobs.put(b"upload" * 50)
        with engine.store.database.write() as connection:
            row = find_map(connection, "hall")
            for i in range(N):
                values = {
                    "content_id": f"{i:064x}", "blob": upload, "bytes": 300, "intrinsics": {},
                    "depth_scale": 1000.0, "depth_along_ray": False, "robot": None,
                    "session": None, "captured_at": None, "tags": [], "pose_parent": None,
                    "pose": None,
                }  # fmt: skip
                frame = add_frame(connection, row.number, values)
                vector = vectors[i].tobytes()
                made = StoredSignature(row.model_id, vector, artifact, (1, 1), (1, 1))
                index_frame(connection, frame, made)
    return tmp_path / "data"


def told(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = main(["index", *map(str, arguments)])
    return code, capsys.readouterr().out


def generation_of(data: Path) -> Generation:
    (folder,) = data.glob("index/hall-*")
    with Engine(Settings(data_dir=data)) as engine:
        found = newest(folder, engine.get_map("hall").model_id, LENGTH)
    assert found is not None
    return found


def test_rebuild_stats_and_verify(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out = told(capsys, "stats", "hall", "--data", data, "--json")
    before = json.loads(out)
    assert (code, before["generation"], before["lag_frames"]) == (0, 0, N)
    assert (before["index_bytes"], before["recall"]) == (0, None)
    assert told(capsys, "rebuild", "hall", "--data", data) == (0, "map hall: generation 1\n")
    code, out = told(capsys, "stats", "hall", "--data", data, "--json")
    after = json.loads(out)
    assert (code, after["generation"], after["lag_frames"], after["probes"]) == (0, 1, 0, 0)
    assert after["recall"] is None  # every frame is compared
    assert (after["upload_bytes"], after["artifact_bytes"]) == (300, 80)
    on_disk = sum(path.stat().st_size for path in data.glob("index/hall-*/*"))
    assert after["index_bytes"] == round(on_disk / N)
    assert after["bytes_beyond_upload"] == LENGTH + 80 + round(on_disk / N)
    assert told(capsys, "verify", "hall", "--data", data) == (0, "map hall: ok\n")
    code, out = told(capsys, "stats", "--data", data)  # for people, and of all maps
    assert code == 0
    assert out.startswith("map empty, depth")
    assert "generation 1" in out


def test_recall_counts_what_sketches_miss(
    data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(publish, "__kwdefaults__",
                        publish.__kwdefaults__ | {"flat_bytes": 0})  # fmt: skip
    for name, value in (("ENOUGH", 0.1), ("LEAST_SELECTED", 4), ("TIMES_WANTED", 1)):
        monkeypatch.setattr(sketches, name, value)  # so that it does miss some
    told(capsys, "rebuild", "hall", "--data", data)
    with Engine(Settings(data_dir=data)) as engine:
        stats = indexes.describe_index(engine, "hall", 20, seed=3)
    generation, none, hits = generation_of(data), Tail.empty(LENGTH), 0
    vectors = generation.vectors_of(generation.keys)
    for i in draw(N, 20, 3):
        row, own = vectors[i], frozenset([int(generation.keys[i])])
        near = search(row, generation, none, 10, metric="l2", dead=own)
        exact = ((vectors.astype(int) - row) ** 2).sum(1)
        limit = np.sort(np.delete(exact, i))[9]
        hits += int((near.distances <= limit).sum())
    assert stats.recall == hits / 200
    assert 0 < stats.recall < 1
    assert stats.probes == generation.manifest.recall.probes > 0
    _, out = told(capsys, "stats", "hall", "--data", data)
    assert f", {stats.probes} frames compared (60 frames)" in out


@pytest.mark.parametrize("what", ["signature", "database"])
def test_verify_names_what_is_wrong_and_rebuild_mends_it(
    data: Path, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    told(capsys, "rebuild", "hall", "--data", data)
    if what == "signature":
        (path,) = data.glob("index/hall-*/*.faiss")
        content = bytearray(path.read_bytes())
        content[7 * LENGTH + 3] ^= 1
        path.write_bytes(content)
        expected = f"map hall: {path}: a file of the index of map hall, changed"
    else:  # sound files, that are not those of this database
        with Engine(Settings(data_dir=data)) as engine:
            changed = bytes(LENGTH)
            with engine.store.database.write() as connection:
                frame = frame_of(connection, 8).id
                connection.execute(
                    update(signatures)
                    .where(signatures.c.frame_number == 8)
                    .values(vector=changed, checksum=zlib.crc32(changed))
                )
        expected = f"has other signatures than the database, or lacks some: frames {frame}"
    code, out = told(capsys, "verify", "hall", "--data", data)
    assert code == 1
    assert expected in out.splitlines()[0]
    assert "sceneprint index rebuild hall" in out.splitlines()[-1]
    assert told(capsys, "rebuild", "hall", "--data", data)[0] == 0
    assert told(capsys, "verify", "hall", "--data", data) == (0, "map hall: ok\n")


def test_what_cannot_be_done_is_said_in_one_line(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["index", "rebuild", "empty", "--data", str(data)]) == 2
    assert "has no indexed frame" in capsys.readouterr().err
    assert main(["index", "stats", "nowhere", "--data", str(data)]) == 2
    assert "There is no map 'nowhere'" in capsys.readouterr().err
    with Engine(Settings(data_dir=data)) as engine:
        engine.create_map(NewMap(name="research", model="paper"))
    assert main(["index", "rebuild", "research", "--data", str(data)]) == 2
    assert "'research' has no index to rebuild" in capsys.readouterr().err
    assert main(["index", "stats", "research", "--data", str(data)]) == 0
    assert main(["index", "verify", "research", "--data", str(data)]) == 0
