"""Signature packages: what a robot made of a frame, sent with it so that no worker has to.

    SignaturePackage  --write_package-->  bytes  --read_package-->  SignaturePackage

Little-endian, in this order: magic, format, CRC-32 of all that follows, version of the signing
code, model, content of the frame, sizes; then patches and pairs of each level, the signature, and
the geometry artifact.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NoReturn

from isal.isal_zlib import crc32

from sceneprint.errors import InvalidRequest

MAGIC = b"SPSIG"
#: Of the bytes. Raise it when they change.
FORMAT_VERSION = 1
#: Most bytes of a package. A depth image makes one of 0.2 MB, a scan all around one of 0.3 MB.
MAXIMUM_PACKAGE = 2 << 20
#: magic, format, checksum
_HEAD = struct.Struct("<5sHI")
#: version of the signing code, model, content, bytes of the signature, levels, bytes of geometry
_BODY = struct.Struct("<I32s32sIHI")
#: patches, ordered pairs
_LEVEL = struct.Struct("<IQ")


@dataclass(frozen=True)
class SignaturePackage:
    """What signing made of one frame.

    Parameters
    ----------
    signing_version : of the code that made it; see `sceneprint.signing.SIGNING_VERSION`
    model_id : of the model that made it
    content_id : of the frame: of its samples and camera, or of its points and viewpoint
    vector : the signature's bytes
    n_patches, n_pairs : of each level, finest first
    artifact : bytes of the geometry
    """

    signing_version: int
    model_id: str
    content_id: str
    vector: bytes
    n_patches: tuple[int, ...]
    n_pairs: tuple[int, ...]
    artifact: bytes


def write_package(package: SignaturePackage) -> bytes:
    """A package as bytes, the same ones for the same package."""
    levels = list(zip(package.n_patches, package.n_pairs, strict=True))
    body = b"".join(
        [
            _BODY.pack(
                package.signing_version, bytes.fromhex(package.model_id),
                bytes.fromhex(package.content_id), len(package.vector), len(levels),
                len(package.artifact),
            ),
            *(_LEVEL.pack(*level) for level in levels),
            package.vector,
            package.artifact,
        ]
    )  # fmt: skip
    return _HEAD.pack(MAGIC, FORMAT_VERSION, crc32(body)) + body


def read_package(data: bytes) -> SignaturePackage:
    """A package from its bytes. Signature and artifact are taken as they are.

    Parameters
    ----------
    data : of `write_package`

    Raises
    ------
    InvalidRequest : not a package, cut short, damaged, too large, or of another format.
    """
    if len(data) > MAXIMUM_PACKAGE:
        _refuse(f"has {len(data)} bytes, and the limit is {MAXIMUM_PACKAGE}", "too large")
    if len(data) < _HEAD.size + _BODY.size or data[: len(MAGIC)] != MAGIC:
        _refuse("is no signature package", "not a package")
    _, found, checksum = _HEAD.unpack_from(data)
    if found != FORMAT_VERSION:
        _refuse(f"has format {found}, and this version reads {FORMAT_VERSION}", "another format")
    body = memoryview(data)[_HEAD.size :]
    version, model, content, length, count, size = _BODY.unpack_from(body)
    start = _BODY.size + count * _LEVEL.size
    if len(body) != start + length + size or crc32(body) != checksum:
        _refuse("is damaged: its checksum does not fit", "damaged")
    levels = list(_LEVEL.iter_unpack(body[_BODY.size : start]))
    return SignaturePackage(
        version,
        model.hex(),
        content.hex(),
        bytes(body[start : start + length]),
        tuple(patches for patches, _ in levels),
        tuple(pairs for _, pairs in levels),
        bytes(body[start + length :]),
    )


def _refuse(why: str, reason: str) -> NoReturn:
    raise InvalidRequest(
        f"The part `signed` {why}. Sign the frame again, or send it without that part.",
        (("signed", reason),),
    )
