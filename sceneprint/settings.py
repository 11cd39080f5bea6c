"""All that an operator can set, in one place; built once, then handed down."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path

import platformdirs
from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict

from sceneprint.models import default_cache_dir


def default_data_dir() -> Path:
    """Where a user's maps are kept unless told otherwise."""
    return Path(platformdirs.user_data_dir("sceneprint", appauthor=False))


def is_loopback(host: str) -> bool:
    """Whether a name or address, without port or brackets, is only ever this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Settings(BaseSettings):
    """Read from the environment: SCENEPRINT_<FIELD>. Nothing has to be set."""

    model_config = SettingsConfigDict(env_prefix="SCENEPRINT_", frozen=True)

    #: Folder of derived files (pair tables). Deleting it loses nothing but seconds.
    cache_dir: Path = Field(default_factory=default_cache_dir)
    #: Folder of what must not be lost: the SQLite database and the blobs.
    data_dir: Path = Field(default_factory=default_data_dir)
    #: SQLAlchemy URL of the database; default: SQLite in the data folder.
    database_url: SecretStr | None = None
    #: Folder of search indexes, of this machine alone. Deleting it loses nothing but minutes;
    #: default: `index` in the data folder.
    index_dir: Path | None = None
    #: Address the service listens on. Any but a loopback address asks callers for a key.
    host: str = "127.0.0.1"
    #: Port of the service; 0 for a free one.
    port: int = Field(default=8008, ge=0, le=65535)
    #: Worker processes that sign frames.
    workers: int = Field(default_factory=lambda: max((os.cpu_count() or 1) - 1, 1), ge=0, le=256)
    #: Uploads and queries that are worked on at once; more wait.
    concurrency: int = Field(default_factory=lambda: max(os.cpu_count() or 1, 2), ge=1, le=256)
    #: Uploads and queries that may wait; more are asked to come back (503).
    waiting: int = Field(default=64, ge=0, le=10_000)
    #: Largest body of a request, bytes.
    upload_bytes: int = Field(default=72 << 20, ge=1024)
    #: Seconds after which a silent worker loses its job.
    lease_s: float = Field(default=60.0, ge=0.1, le=3600)
    #: Longest time for one job, seconds; a worker that takes longer hangs, and is ended.
    job_s: float = Field(default=120.0, ge=1, le=3600)
    #: Memory that a worker may take for its work, bytes, beyond what it has when it is ready;
    #: 0 for no limit. What needs more fails, and no other process is killed for it.
    worker_bytes: int = Field(default=2 << 30, ge=0)
    #: Frames newer than the index above which a worker publishes a new one.
    tail_frames: int = Field(default=1000, ge=1, le=100_000)
    #: Seconds after which a worker reads all index files again, to see that they are sound.
    scrub_s: float = Field(default=3600.0, ge=1, le=31_536_000)

    @property
    def database(self) -> str:
        """URL of the database."""
        from sqlalchemy import URL

        if self.database_url is not None:
            return self.database_url.get_secret_value()
        # put together by SQLAlchemy: a folder's name may hold what means something in a URL
        url = URL.create("sqlite", database=str((self.data_dir / "sceneprint.db").absolute()))
        return url.render_as_string(hide_password=False)

    @property
    def blob_dir(self) -> Path:
        """Folder of uploads and geometry artifacts."""
        return self.data_dir / "blobs"

    @property
    def bell_dir(self) -> Path:
        """Folder of what wakes waiting workers."""
        return self.data_dir / "bells"

    @property
    def indexes(self) -> Path:
        """Folder of search indexes."""
        return self.index_dir or self.data_dir / "index"
