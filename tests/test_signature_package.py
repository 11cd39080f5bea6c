"""Signature packages as bytes, and that what our writer wrote is written so again."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest

from sceneprint.errors import InvalidRequest
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.signature_package import (
    MAXIMUM_PACKAGE,
    SignaturePackage,
    read_package,
    write_package,
)
from sceneprint.pipeline import open_signer, prepare
from sceneprint.signing import SIGNING_VERSION
from sceneprint.types import Cloud

PACKAGE = SignaturePackage(
    7, "ab" * 32, "0f" * 32, b"\x00\xff" * 40, (30, 4), (99, 12), b"artifact"
)
GOLDEN = Path(__file__).parent / "golden"
#: SHA-256 of the signatures of tests/golden, by version of the signing code: where they change, so
#: that a worker would find those of a robot with the code before wrong, the version must too.
SIGNED = {1: "26d24809f1d9ac641f98c6e6f4f57594dfbd4044e6058430588694f90b52e511"}


def test_a_package_is_read_as_it_was_written() -> None:
    data = write_package(PACKAGE)
    assert read_package(data) == PACKAGE
    assert write_package(read_package(data)) == data


@pytest.mark.parametrize("size", range(len(write_package(PACKAGE))))
def test_a_package_that_is_cut_short_is_refused(size: int) -> None:
    with pytest.raises(InvalidRequest, match="The part `signed`"):
        read_package(write_package(PACKAGE)[:size])


def test_a_changed_byte_is_found() -> None:
    sound = write_package(PACKAGE)
    for i in range(len(sound)):
        with pytest.raises(InvalidRequest):
            read_package(sound[:i] + bytes([sound[i] ^ 0x10]) + sound[i + 1 :])


def test_lengths_that_lie_are_refused() -> None:
    sound = write_package(PACKAGE)
    for place in (11 + 4 + 64, 11 + 4 + 64 + 4, 11 + 4 + 64 + 6):  # vector, levels, artifact
        body = bytearray(sound[11:])
        body[place - 11] ^= 1
        with pytest.raises(InvalidRequest) as refused:  # with a checksum that fits
            read_package(sound[:7] + struct.pack("<I", crc32(body)) + bytes(body))
        assert refused.value.fields == (("signed", "damaged"),)


def test_a_package_that_is_too_large_is_refused() -> None:
    with pytest.raises(InvalidRequest, match=str(MAXIMUM_PACKAGE)):
        read_package(write_package(PACKAGE) + bytes(MAXIMUM_PACKAGE))


@pytest.mark.parametrize("kind", ["depth", "scan", "points"])
def test_geometry_is_written_as_it_was_read(kind: str, room_frames: Any) -> None:
    frame, signer = room_frames[0], open_signer("depth" if kind == "depth" else "lidar")
    if kind != "depth":
        k = frame.intrinsics
        v, u = np.nonzero(frame.depth)
        z = frame.depth[v, u]
        points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1)
        frame = Cloud(points[::7].astype(np.float32), has_viewpoint=kind == "scan")
    _, seen = prepare(frame, signer)
    artifact = write_geometry(seen)
    assert write_geometry(read_geometry(artifact)) == artifact
    assert len(artifact) < MAXIMUM_PACKAGE // 2


def test_the_version_changes_with_the_signatures() -> None:
    digest = hashlib.sha256()
    for path in sorted((GOLDEN / "signatures").iterdir()):
        digest.update(path.read_bytes())
    assert digest.hexdigest() == SIGNED[SIGNING_VERSION]
