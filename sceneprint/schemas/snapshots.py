"""Snapshots that a service has taken, as JSON."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from sceneprint.schemas.base import Told


class SnapshotFile(Told):
    """One state of the data folder in an archive, which `sceneprint restore` puts back."""

    snapshot_id: str
    created_at: datetime = Field(description="Its state is not older.")
    bytes: int
    sha256: str = Field(description="Of the archive.")
    maps: int
    frames: int
    blobs: int
    damaged: int = Field(description="Blobs that were missing or damaged, and are not in it.")
