"""Tests that damaged or manipulated bundles are detected and rejected."""

import hashlib
import json
import random
import shutil
import zlib
from pathlib import Path

import psycopg
import pytest
from pydantic import SecretStr

from sceneprint.bundle import restoration
from sceneprint.bundle.restoration import restore_to_folder, verify_bundle
from sceneprint.errors import BundleError, DamagedBundle, NewerSchema
from sceneprint.settings import Settings


@pytest.fixture
def copy(place, tmp_path):
    return Path(shutil.copytree(place, tmp_path / "copy"))


@pytest.fixture
def refused(copy, tmp_path):
    def check(text, kind=DamagedBundle):
        for attempt in (
            lambda: verify_bundle(str(copy)),
            lambda: restore_to_folder(str(copy), tmp_path / "new"),
        ):
            with pytest.raises(kind, match=text) as raised:
                attempt()
            assert "\n" not in str(raised.value)
        assert not (tmp_path / "new" / "sceneprint.db").exists()

    return check


def manifest_of(folder):
    (path,) = folder.glob("bundles/*.json")
    return path, json.loads(path.read_bytes())


def rewrite(folder, change):
    """Change a manifest, and let its checksum fit, as somebody who means harm."""
    path, record = manifest_of(folder)
    del record["sha256"]
    change(record)
    text = json.dumps(record, sort_keys=True, separators=(",", ":"))
    record["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(record))


def replace_part(folder, kind, change):
    """Change the lines of a part, which gets the digest of what it then holds."""

    def put(record):
        part = next(part for part in record["parts"] if part["kind"] == kind)
        old = folder / "parts" / part["digest"][:2] / part["digest"]
        lines = [json.loads(line) for line in zlib.decompress(old.read_bytes()).split(b"\n")]
        change(lines)
        data = zlib.compress("\n".join(json.dumps(line) for line in lines).encode())
        digest = hashlib.sha256(data).hexdigest()
        new = folder / "parts" / digest[:2] / digest
        new.parent.mkdir(exist_ok=True)
        new.write_bytes(data)
        part |= {"digest": digest, "bytes": len(data), "rows": len(lines) - 1}

    rewrite(folder, put)


def test_every_part_that_is_flipped_cut_missing_or_swapped_is_named(copy):
    rng, parts = random.Random(8), sorted(copy.glob("parts/??/*"))
    assert len(parts) > 15
    for number, path in enumerate(parts):
        good = path.read_bytes()
        flipped = bytearray(good)
        flipped[rng.randrange(len(good))] ^= rng.randrange(1, 256)
        other = next(part for part in parts if part != path).read_bytes()
        bad = (bytes(flipped), good[:-1], good + b"x", b"", other, None)[number % 6]
        path.unlink() if bad is None else path.write_bytes(bad)
        with pytest.raises(DamagedBundle, match=path.name):
            verify_bundle(str(copy))
        path.write_bytes(good)
    assert verify_bundle(str(copy)).lost == ()


def test_a_manifest_with_one_other_byte(copy, place):
    rng, (path, _) = random.Random(3), manifest_of(copy)
    good, sound = path.read_bytes(), verify_bundle(place)
    for _ in range(60):
        bad = bytearray(good)
        bad[rng.randrange(len(good))] ^= rng.choice([1, 32, 128])
        path.write_bytes(bad)
        try:
            assert verify_bundle(str(copy)) == sound  # a blank that became another
        except BundleError as error:
            assert "bundle" in str(error)  # noqa: PT017
    for length in (0, 1, len(good) // 2, len(good) - 2):
        path.write_bytes(good[:length])
        with pytest.raises(DamagedBundle, match="the manifest of the bundle is damaged"):
            verify_bundle(str(copy))


def test_manifests_that_lie(copy, place, refused):
    path, record = manifest_of(copy)
    good = path.read_bytes()

    def lies(change, text, kind=DamagedBundle):
        rewrite(copy, change)
        refused(text, kind)
        path.write_bytes(good)

    rewrite(copy, lambda one: None)
    assert verify_bundle(str(copy)) == verify_bundle(place)
    lies(lambda one: one.update(version=3), "the bundle has version 3", BundleError)
    lies(lambda one: one.update(schema_revision="9999"), "9999", NewerSchema)
    for other in ({"format": "other"}, {"more": 1}, {"maps": "1"}):
        lies(lambda one, other=other: one.update(other), "the manifest of the bundle is damaged")
    lies(lambda one: one.update(maps=2), "its rows")
    lies(lambda one: one["frames"].update(indexed=3), "its rows")
    lies(lambda one: one.update(blobs=8), "its blobs")
    lies(
        lambda one: one["parts"][0].update(digest="../../../../etc/passwd"),
        "manifest of the bundle",
    )
    lies(lambda one: one["parts"][0].update(rows=99), "its rows of table")
    without = [part for part in record["parts"] if part["kind"] != "rows/maps"]
    lies(lambda one: one.update(parts=without), "refers to a missing row of maps|its rows")


def test_rows_that_are_none_of_ours(copy, place, refused):
    shutil.copytree(copy, again := copy.with_name("again"))

    def lies(kind, change, text):
        replace_part(copy, kind, change)
        refused(text)
        shutil.rmtree(copy)
        shutil.copytree(again, copy)

    replace_part(copy, "rows/frames", lambda lines: None)
    assert verify_bundle(str(copy)).manifest.blobs == 9
    blob = lines_of(copy, "rows/frames")[0].index("blob")
    lies("rows/frames", lambda lines: lines[1].pop(), "a different number of columns")
    lies("rows/frames", lambda lines: lines[0].reverse(), "its columns differ")
    for value in (5, ["x"]):
        lies(
            "rows/frames", lambda lines, value=value: lines[1].__setitem__(blob, value),
            r"A row of table frames .*\(column blob holds a ",
        )  # fmt: skip
    lies("rows/frames", lambda lines: lines.insert(2, lines[1]), "UNIQUE constraint failed")
    lies("rows/frames", lambda lines: lines[1].__setitem__(blob, None), "NOT NULL constraint")
    of = lines_of(copy, "rows/frames")[0].index("map_number")
    lies("rows/frames", lambda lines: lines[1].__setitem__(of, 9), "a missing row of maps")
    for name in ("../evil", "0" * 64):
        lies(
            "rows/frames", lambda lines, name=name: lines[1].__setitem__(blob, name),
            "the blobs that its rows refer to",
        )  # fmt: skip
    lies("blobs", lambda lines: lines.pop(), "its blobs")
    lies("blobs", lambda lines: lines[1].__setitem__(0, "../../evil"), "invalid entry in the list")
    lies("blobs", lambda lines: lines.insert(1, ["0" * 64, 5, None]), "is missing")
    part = next(part for part in manifest_of(copy)[1]["parts"] if part["kind"] == "rows/frames")
    more = [part["digest"], part["bytes"], None]  # a blob that is there, and that no row refers to
    replace_part(copy, "blobs", lambda lines: lines.append(more))
    blobs = {"blobs": 10, "blob_bytes": manifest_of(copy)[1]["blob_bytes"] + part["bytes"]}
    rewrite(copy, lambda one: one.update(blobs))
    refused("the blobs that its rows refer to")


def lines_of(folder, kind):
    _, record = manifest_of(folder)
    digest = next(part["digest"] for part in record["parts"] if part["kind"] == kind)
    data = (folder / "parts" / digest[:2] / digest).read_bytes()
    return [json.loads(line) for line in zlib.decompress(data).split(b"\n")]


@pytest.mark.parametrize("large", [restoration.LARGE, 20])
def test_a_damaged_blob_is_named_as_it_is_restored(copy, tmp_path, monkeypatch, large):
    monkeypatch.setattr(restoration, "LARGE", large)
    digest = lines_of(copy, "blobs")[3][0]
    path = copy / "parts" / digest[:2] / digest
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(DamagedBundle, match=digest):
        restore_to_folder(str(copy), tmp_path / "new")
    assert not (tmp_path / "new" / "sceneprint.db").exists()


@pytest.mark.sqlite_only("has a server of its own")
def test_rows_that_contradict_each_other_are_no_row_of_a_server(copy, postgres, tmp_path):
    url = postgres.create("contradicted")
    of = lines_of(copy, "rows/frames")[0].index("map_number")
    replace_part(copy, "rows/frames", lambda lines: lines[1].__setitem__(of, 9))
    fleet = Settings(data_dir=tmp_path / "fleet", database_url=SecretStr(url), index_dir=None)
    with pytest.raises(DamagedBundle, match=r"rows of table frames .* inconsistent"):
        restoration.restore_to_server(str(copy), fleet)
    with psycopg.connect(url.replace("+psycopg", "")) as connection:
        assert connection.execute("SELECT count(*) FROM maps").fetchone() == (0,)


def test_a_part_of_gigabytes_takes_no_memory(copy, refused):
    data = zlib.compress(bytes(300 << 20), 1)
    digest = hashlib.sha256(data).hexdigest()
    path = copy / "parts" / digest[:2] / digest
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    rewrite(copy, lambda one: one["parts"][0].update(digest=digest, bytes=len(data)))
    refused("too long or truncated")
