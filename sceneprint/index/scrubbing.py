"""Scrubbing: reading the files of a cache folder again, to see that they are what was written.

Opening a generation checks all of it but the signatures themselves, which may be many gigabytes.
This reads those too, a block at a time, for whoever has a moment.
"""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Iterator
from pathlib import Path

from sceneprint.errors import DamagedIndex
from sceneprint.index.files import get, is_name
from sceneprint.index.manifests import manifests, read_manifest
from sceneprint.index.segments import BLOCK_BYTES, open_segment


def scrub(folder: Path) -> Iterator[Path | None]:
    """Verify all files of the newest readable manifest of a folder.

    Yields
    ------
    None after each block that was read, so that the caller may stop in between; the path of a file
    that is damaged or missing, once
    """
    for _, path in manifests(folder):
        try:
            manifest = read_manifest(path)
        except DamagedIndex as error:  # an older one is used in its place meanwhile
            yield path if _is_lasting(error) and path.exists() else None
            continue
        for name, size in manifest.files:
            try:
                if is_name(name, "segment"):
                    yield from _scrub_segment(folder / name)
                else:
                    get(folder, name, size)
            except DamagedIndex as error:
                if not _is_lasting(error):
                    return
                if manifests(folder)[:1] == [] or not path.exists():
                    return  # a builder has replaced the generation meanwhile
                yield folder / name
            yield None
        return


def _scrub_segment(path: Path) -> Iterator[None]:
    segment = open_segment(path, verify=False)
    digest, flat = hashlib.sha256(), segment.signatures.reshape(-1)
    for start in range(0, flat.size, BLOCK_BYTES):
        digest.update(flat[start : start + BLOCK_BYTES].data)
        yield None
    if digest.digest() != segment.digest:
        raise DamagedIndex(f"{path}: its signatures are not those that were written.")


def _is_lasting(error: DamagedIndex) -> bool:
    """Whether a file is damaged or missing, and not merely out of reach for the moment."""
    cause = error.__cause__
    return not isinstance(cause, OSError) or cause.errno in (errno.ENOENT, errno.EIO)
