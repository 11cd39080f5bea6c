"""What a frame costs on disk: rows of the database, the upload, and the geometry artifact."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from sceneprint.formats.dataset import FrameReference
from sceneprint.models import read_model
from sceneprint_client import Client


@dataclass(frozen=True)
class DiskFigures:
    """Mean bytes a frame.

    Parameters
    ----------
    frames : measured
    signature_bytes : of a signature
    database : rows with the signature, indexes, and what pages leave free
    uploads : what robots sent
    artifacts : geometry of the frames, for validation
    """

    frames: int
    signature_bytes: int
    database: float
    uploads: float
    artifacts: float


def measure(frames: Sequence[FrameReference], model: str, folder: Path) -> DiskFigures:
    """Upload and sign frames; the first quarter pays what an empty database costs.

    Parameters
    ----------
    frames : four or more
    model : of the map
    folder : for the data, empty
    """
    database, first = folder / "sceneprint.db", max(len(frames) // 4, 1)
    sizes = []
    for some in (frames[:first], frames[first:]):
        with Client.embedded(folder) as client:
            client.create_map("disk", model=model)
            added = [client.upload("disk", frame) for frame in some]
            client.wait([one.job_id for one in added])
        blobs = [path.stat().st_size for path in (folder / "blobs").rglob("*") if path.is_file()]
        sizes.append((_used(database), sum(blobs)))
    n = len(frames) - first
    uploads = sum(frame.path.stat().st_size for frame in frames[first:])
    (rows_before, blobs_before), (rows_after, blobs_after) = sizes
    return DiskFigures(
        frames=n,
        signature_bytes=read_model(model).signature_bytes,
        database=(rows_after - rows_before) / n,
        uploads=uploads / n,
        artifacts=(blobs_after - blobs_before - uploads) / n,
    )


def _used(database: Path) -> int:
    """Bytes of the pages that a database uses, whether in its file or in its log."""
    with closing(sqlite3.connect(database)) as connection:
        asked = ("page_count", "freelist_count", "page_size")
        count, free, size = (connection.execute(f"PRAGMA {one}").fetchone()[0] for one in asked)
    return int((count - free) * size)


def measure_new(frames: Sequence[FrameReference], model: str) -> DiskFigures:
    """As `measure`, in a folder that goes afterwards."""
    with TemporaryDirectory() as folder:
        return measure(frames, model, Path(folder))


def table(figures: Sequence[DiskFigures]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        "### Disk a frame, beside the index; bytes",
        "",
        "| signature | rows of the database | upload | geometry artifact |",
        "|--:|--:|--:|--:|",
        *(
            f"| {f.signature_bytes:,} | {f.database:,.0f} | {f.uploads:,.0f} | {f.artifacts:,.0f} |"
            for f in figures
        ),
        "",
    ]
