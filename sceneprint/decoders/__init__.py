"""Decode uploads, in confined processes that can only compute, or in this process.

untrusted bytes  --Decoders.place-->  Decoder  --samples | points-->  arrays, checked again

`DecoderPool` (pool.py) uses processes, and `LocalDecoders` this process, for trusted data.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from sceneprint.formats.depth_file import Samples, decode_samples
from sceneprint.formats.points.cloud import ReadPoints, read_points
from sceneprint_client.formats import CloudFormat
from sceneprint_client.sidecars import Position, Unsaid


class Decoder(Protocol):
    """Turns bytes of an upload into arrays."""

    def samples(self, data: bytes) -> Samples:
        """Return the samples of a depth image; see `decode_samples`."""

    def points(
        self, data: bytes, file_format: CloudFormat, viewpoint: Position | Unsaid | None,
        units_per_metre: float,
    ) -> ReadPoints:  # fmt: skip
        """Return the points of a cloud; see `read_points`."""


class Decoders(Protocol):
    """A number of decoders; safe to share between threads."""

    def place(self) -> AbstractContextManager[Decoder]:
        """Wait for a decoder and hold it. Process the arrays while you hold it, so that the number
        of decoders bounds memory and processors as well.
        """

    def start(self) -> None:
        """Start what the first upload would otherwise wait for."""

    def close(self) -> None:
        """End all decoders."""


class LocalDecoders:
    """Decodes in this process.

    Parameters
    ----------
    count : number of uploads that are decoded at once
    """

    def __init__(self, count: int) -> None:
        self._places = threading.BoundedSemaphore(count)

    @contextmanager
    def place(self) -> Iterator[Decoder]:
        """See Decoders."""
        with self._places:
            yield self

    def samples(self, data: bytes) -> Samples:
        """See Decoder."""
        return decode_samples(data)

    def points(
        self, data: bytes, file_format: CloudFormat, viewpoint: Position | Unsaid | None,
        units_per_metre: float,
    ) -> ReadPoints:  # fmt: skip
        """See Decoder."""
        return read_points(data, file_format, viewpoint, units_per_metre)

    def start(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
