"""Decoding of uploads in confined processes, or of trusted data in this process.

untrusted bytes  --Decoders.place-->  decoder  --samples | points-->  arrays, checked again

`DecoderPool` (pool.py) uses confined processes. `LocalDecoders` uses this process.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

from sceneprint.formats.depth_file import Samples, decode_samples
from sceneprint.formats.points.cloud import ReadPoints, read_points
from sceneprint_client.formats import CloudFormat
from sceneprint_client.sidecars import Position, Unsaid

if TYPE_CHECKING:
    from sceneprint.decoders.pool import ConfinedDecoder, DecoderPool


class LocalDecoders:
    """Decoders that run in this process.

    `count`: maximum number of concurrent uploads.
    """

    def __init__(self, count: int) -> None:
        self._places = threading.BoundedSemaphore(count)

    @contextmanager
    def place(self) -> Iterator[LocalDecoders]:
        """Wait until fewer than `count` uploads are in progress; yield this decoder."""
        with self._places:
            yield self

    def samples(self, data: bytes) -> Samples:
        """Return the samples of a depth image; see `decode_samples`."""
        return decode_samples(data)

    def points(
        self, data: bytes, file_format: CloudFormat, viewpoint: Position | Unsaid | None,
        units_per_metre: float,
    ) -> ReadPoints:  # fmt: skip
        """Return the points of a cloud; see `read_points`."""
        return read_points(data, file_format, viewpoint, units_per_metre)

    def start(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


#: A decoder of uploads, for one thread.
Decoder: TypeAlias = "LocalDecoders | ConfinedDecoder"
#: A set of decoders that threads may share.
Decoders: TypeAlias = "LocalDecoders | DecoderPool"
