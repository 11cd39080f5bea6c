"""Tests of object stores by URL: invalid URLs, unreachable stores and timeouts."""

import io
import os
import socket

import pytest

from benchmarks.s3 import ObjectServer
from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.store.blobs import object_client
from sceneprint.store.blobs.object_client import PART, check_objects, open_objects


@pytest.mark.parametrize(
    "text",
    ["s3://user:pw@bucket/x", "s3://bucket?access_key=pw", "s3://bucket/x#pw", "s3:///pw",
     "https://pw.example/x", "", "s3://[pw", "s3://bucket/../pw", "s3://bucket/%2e%2e/pw",
     "s3://bucket/a\0pw", "file:///", "file://host/pw", "memory://pw"],
)  # fmt: skip
def test_what_names_no_store_is_refused_and_not_repeated(text):
    with pytest.raises(UnusableStore, match="SCENEPRINT_BLOB_URL") as caught:
        open_objects(text)
    assert "pw" not in str(caught.value)


def test_a_store_without_tls_is_asked_only_where_that_is_allowed(bucket, monkeypatch):
    monkeypatch.delenv("AWS_ALLOW_HTTP")
    with pytest.raises(UnusableStore, match="AWS_ALLOW_HTTP=true"):
        open_objects(bucket)


@pytest.mark.parametrize("kind", ["s3", "memory", "file"])
def test_keys_are_put_listed_and_removed(kind, request, tmp_path):
    url = {"memory": "memory:///", "file": f"file://{tmp_path}/some%20where"}.get(kind)
    objects = open_objects(url or f"{request.getfixturevalue('bucket')}/pre/fix")
    assert check_objects(objects) > 0
    assert list(objects.list("")) == []  # nothing of the check is left
    assert objects.put("a/1", b"one", create=True)
    assert not objects.put("a/1", b"two", create=True)
    assert objects.get("a/1") == b"one"
    objects.put("a/1", b"three")
    objects.put("b", b"")
    assert sorted((entry.key, entry.size) for entry in objects.list("")) == [("a/1", 5), ("b", 0)]
    assert [entry.key for entry in objects.list("a/")] == ["a/1"]
    assert (objects.get("b"), objects.open("b").read(), [*objects.chunks("b")]) == (b"", b"", [])
    large = os.urandom(2 * PART + 7)
    file = io.BytesIO(b"skipped" + large)
    file.seek(7)
    objects.put_file("c", file)
    objects.get_file("c", tmp_path / "c")
    assert (tmp_path / "c").read_bytes() == large == objects.get("c")
    objects.delete("none", "a/1", "none too", "b", "c")
    objects.delete("none")
    assert list(objects.list("")) == []
    for call in (objects.get, objects.open, lambda key: [*objects.chunks(key)]):
        with pytest.raises(FileNotFoundError, match="a/1"):
            call("a/1")
    assert objects.head("a/1") is None


def test_a_bucket_that_is_not_there_is_no_missing_blob(bucket):
    objects = open_objects(f"{bucket}-none/x")
    for call in (
        lambda: objects.get("a"),
        lambda: objects.put("a", b"x"),
        objects.list("").__next__,
    ):
        with pytest.raises(UnusableStore, match=r"no such bucket|404 Not Found"):
            call()


@pytest.fixture
def brittle(monkeypatch):
    """A server of this test alone, and little patience with it."""
    monkeypatch.setattr(object_client, "TRIED_S", 1)
    monkeypatch.setattr(object_client, "SMALL_S", 1)
    monkeypatch.setattr(object_client, "AWAY_S", 0.2)
    with ObjectServer() as server:
        for name, value in server.env.items():
            monkeypatch.setenv(name, value)
        yield server


def test_a_server_that_falls_acknowledges_nothing(brittle, monkeypatch):
    monkeypatch.setattr(object_client, "TRIED_S", 0.2)
    objects = open_objects(brittle.bucket("fragile"))

    class Fatal(io.BytesIO):
        def read(self, size=-1, /):
            if self.tell() >= 3 * PART:
                brittle.kill()
            return super().read(size)

    objects.put("before", b"x")
    with pytest.raises(StoreAway, match="large cannot be written"):
        objects.put_file("large", Fatal(bytes(8 * PART)))
    with pytest.raises(StoreAway, match=r"s3://fragile: a cannot be written .*AWS_"):
        objects.put("a", b"x")
    brittle.start()  # it has forgotten all, as it does
    brittle.bucket("fragile")
    until = objects._away[0]
    assert until > 0
    while object_client.time.monotonic() < until:
        with pytest.raises(StoreAway):  # at once
            objects.get("a")
        object_client.time.sleep(0.02)  # leaves the processor to others
    assert objects.put("a", b"x")
    assert [entry.key for entry in objects.list("")] == ["a"]


def test_a_server_that_never_answers_is_given_up(monkeypatch, bucket):
    monkeypatch.setattr(object_client, "SMALL_S", 0.3)
    monkeypatch.setattr(object_client, "TRIED_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        place = f"http://127.0.0.1:{silent.getsockname()[1]}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", place)
        objects = open_objects(bucket)
        with pytest.raises(StoreAway, match="cannot be read"):
            objects.get("a")
