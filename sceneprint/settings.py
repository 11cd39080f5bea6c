"""Settings of the service, its workers and the command line, read from the environment."""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import unquote, urlsplit

import platformdirs
from pydantic import Field, SecretStr, ValidationInfo, field_validator, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from sceneprint.errors import UnusableStore
from sceneprint.models import default_cache_dir
from sceneprint_client.api.base import is_loopback


def default_data_dir() -> Path:
    """Return the default folder of a user's maps."""
    return Path(platformdirs.user_data_dir("sceneprint", appauthor=False))


#: Schemes of the URLs of object stores.
OBJECT_SCHEMES = ("s3", "gs", "az", "file", "memory")


def _setting(help_text: str, change: str = "", *, shown: str = "", **field: Any) -> Any:
    """Return a pydantic field that has the texts that docs/settings.md shows.

    Parameters
    ----------
    help_text : description of the value, with its unit
    change : advice on when to change the value
    shown : description of a default that is computed
    **field : arguments of `pydantic.Field`
    """
    extra: dict[str, Any] = {"change": change, "shown": shown}
    return Field(description=help_text, json_schema_extra=extra, **field)


class Settings(BaseSettings):
    """The settings, read from environment variables SCENEPRINT_<FIELD>; each has a default."""

    model_config = SettingsConfigDict(
        env_prefix="SCENEPRINT_", frozen=True,
        hide_input_in_errors=True,  # a value may be a URL that contains a password
    )  # fmt: skip

    # Places
    data_dir: Path = _setting(
        "Folder of the SQLite database and the blobs; also `--data`. Back it up.",
        "On a server, to select a disk with enough space.",
        shown="`sceneprint` in the user's data folder",
        default_factory=default_data_dir,
    )
    database_url: SecretStr | None = _setting(
        "SQLAlchemy URL of the database: `postgresql+psycopg://user:password@host/db`.",
        "If several machines share the maps.",
        shown="SQLite in the data folder",
        default=None,
    )
    blob_url: SecretStr | None = _setting(
        "Storage of uploads, artifacts and stored answers: `s3://bucket/prefix`, "
        "`gs://bucket/prefix`, `az://account/container/prefix`, `file:///folder` or `memory:///`, "
        "which is lost with the process. Credentials come from the cloud's environment variables, "
        "not from the URL.",
        "If several machines share the maps.",
        shown="`blobs` in the data folder",
        default=None,
    )
    index_dir: Path | None = _setting(
        "Folder of this machine's search indexes. Workers rebuild it if it is deleted.",
        "To use a faster disk than for blobs.",
        shown="`index` in the data folder",
        default=None,
    )
    index_url: str | None = _setting(
        "Object store in which hosts share search indexes, in the format of `BLOB_URL`. Each index "
        "is built once, and hosts download the indexes that they search.",
        "If several hosts search the same maps.",
        shown="none: each host builds its indexes",
        default=None,
    )
    index_cache_bytes: int = _setting(
        "Maximum size of this machine's copies of shared indexes, bytes. The least recently used "
        "copies are removed, except those used within the last ten minutes.",
        "For smaller disks or larger maps.",
        default=16 << 30, ge=0,
    )  # fmt: skip
    cache_dir: Path = _setting(
        "Folder of the pair tables of models, 28 MB each. Processes compute missing tables again.",
        "If the home folder is not writable.",
        shown="`sceneprint` in the user's cache folder",
        default_factory=default_cache_dir,
    )

    # Service
    host: str = _setting(
        "Address on which the service listens; also `--host`. Any address except a loopback "
        "address requires keys.",
        "To serve other machines.",
        default="127.0.0.1",
    )
    port: int = _setting(
        "Port of the service; also `--port`. 0 selects a free port, which is printed.",
        "If the port is in use.",
        default=8008, ge=0, le=65535,
    )  # fmt: skip
    tls_cert: Path | None = _setting(
        "PEM file of the service's certificate chain. With `TLS_CERT` and `TLS_KEY`, the service "
        "accepts only HTTPS.",
        "To serve other machines without a proxy.",
        default=None,
    )
    tls_key: Path | None = _setting(
        "PEM file of the certificate's unencrypted key.",
        "Together with `TLS_CERT`.",
        default=None, validate_default=True,
    )  # fmt: skip
    require_keys: bool = _setting(
        "Whether a loopback address requires keys too.",
        "Behind a proxy or tunnel on this machine.",
        default=False,
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = _setting(
        "Origins whose web pages may send requests, separated by commas: `https://fleet.example`; "
        "`*` for all.",
        "For a dashboard on another host.",
        default=(),
    )
    concurrent_requests: int = _setting(
        "Maximum number of concurrent uploads, and of concurrent queries.",
        "Rarely, since the number of processors limits the throughput.",
        shown="number of processors, at least 2",
        default_factory=lambda: max(os.cpu_count() or 1, 2), ge=1, le=256,
    )  # fmt: skip
    query_cores: int = _setting(
        "Number of cores that the queries of a service share. If a core is free, a query runs its "
        "two halves in parallel; the answer is the same.",
        "Fewer if workers on the same machine need the cores.",
        shown="number of processors",
        default_factory=lambda: os.cpu_count() or 1, ge=1, le=256,
    )  # fmt: skip
    geometry_cache_bytes: int = _setting(
        "Size of each process's cache of the geometry of recently compared frames, bytes (0.8 MB "
        "per frame); 0 disables it. It accelerates further queries in the same place.",
        "Lower if many services share a machine; higher for large maps.",
        default=256 << 20, ge=0,
    )  # fmt: skip

    # Limits of requests
    queued_requests: int = _setting(
        "Maximum number of waiting uploads, and of waiting queries; further requests get 503.",
        "Higher if many robots send requests at once.",
        default=64, ge=0, le=10_000,
    )  # fmt: skip
    queue_timeout_s: float = _setting(
        "Maximum waiting time of an upload or query, seconds; after that it gets 503.",
        "Lower if late answers are useless.",
        default=5.0, gt=0, le=3600,
    )  # fmt: skip
    max_upload_bytes: int = _setting(
        "Maximum size of a request body, bytes. The default suffices for 6 million points of "
        "three float32 each.",
        "Higher for larger clouds; lower if all sensors are small.",
        default=72 << 20, ge=1024, le=512 << 20,
    )  # fmt: skip
    max_import_bytes: int = _setting(
        "Maximum size of an imported archive, bytes. It may unpack to four times its size.",
        "According to your recordings.",
        default=4 << 30, ge=1024,
    )  # fmt: skip
    tenant_requests_per_s: float = _setting(
        "Maximum rate of a tenant's requests per service process, averaged over five seconds; 0 "
        "sets no limit. A query counts as 5 requests, a page as 1 plus 1 per 50 rows.",
        "According to the size of the fleet.",
        default=200.0, ge=0, le=1e6,
    )  # fmt: skip
    wrong_keys_per_minute: float = _setting(
        "Maximum rate of wrong keys per address; 0 sets no limit.",
        "Rarely.",
        default=60.0, ge=0, le=1e6,
    )  # fmt: skip
    max_event_streams: int = _setting(
        "Maximum number of open event streams per service process; further streams get 503. A "
        "tenant may have three quarters of them, and gets 429 for further streams.",
        "According to the number of dashboards.",
        default=64, ge=0, le=10_000,
    )  # fmt: skip

    # Workers and decoders
    workers: int = _setting(
        "Number of worker processes; also `--workers`. They sign frames and run long jobs at a "
        "lower priority than requests.",
        "Fewer if memory is short (220 MB each); 0 if `sceneprint work` starts them.",
        shown="number of processors",
        default_factory=lambda: os.cpu_count() or 1, ge=0, le=256,
    )  # fmt: skip
    worker_memory_bytes: int = _setting(
        "Maximum memory that a worker may allocate after its start, bytes; 0 sets no limit. A job "
        "that needs more fails; other processes are not affected.",
        "Lower on small machines; higher for very large maps.",
        default=2 << 30, ge=0,
    )  # fmt: skip
    job_lease_s: float = _setting(
        "Time without a heartbeat after which a worker loses its job, seconds.",
        "Longer on machines that may be suspended.",
        default=60.0, ge=0.1, le=3600,
    )  # fmt: skip
    job_timeout_s: float = _setting(
        "Maximum time of a job, or of one slice of a long job, seconds. A worker that exceeds it "
        "is terminated.",
        "Longer on very slow machines.",
        default=120.0, ge=1, le=3600,
    )  # fmt: skip
    decoders: int = _setting(
        "Number of confined processes in which a service decodes uploads. Each uses 100 MB, or "
        "240 MB after it has read PLY or PCD. Each worker has an additional decoder. 0 decodes "
        "uploads in the service and its workers.",
        "0 if all senders are trusted and memory is short.",
        shown="number of processors, from 2 to 8",
        default_factory=lambda: min(max(os.cpu_count() or 1, 2), 8), ge=0, le=256,
    )  # fmt: skip
    decoder_memory_bytes: int = _setting(
        "Maximum memory that a decoder may allocate for an upload, bytes; 0 sets no limit.",
        "Lower on small machines.",
        default=2 << 30, ge=0,
    )  # fmt: skip
    decoder_timeout_s: float = _setting(
        "Maximum time for decoding an upload, seconds.",
        "Longer on very slow machines.",
        default=30.0, ge=0.1, le=3600,
    )  # fmt: skip

    # Upkeep
    unindexed_frames: int = _setting(
        "Number of new frames and deletions after which a worker publishes a new index.",
        "Rarely, since queries read these frames from memory.",
        default=1000, ge=1, le=100_000,
    )  # fmt: skip
    index_check_interval_s: float = _setting(
        "Interval at which workers verify all index files, seconds.",
        "Longer for indexes of many gigabytes.",
        default=3600.0, ge=1, le=31_536_000,
    )  # fmt: skip
    blob_check_mb_per_s: float = _setting(
        "Rate at which workers verify stored blobs, MB per second; 0 disables verification.",
        "Higher for more than 86 GB, which take a day; 0 if an object store charges for reads "
        "and verifies its objects itself.",
        default=1.0, ge=0, le=10_000,
    )  # fmt: skip
    build_surfaces: Literal["auto", "on_request"] = _setting(
        "Whether workers build the surface of each map automatically (`auto`), or only on request "
        "(`on_request`). Deleted frames are always removed from existing surfaces.",
        "If surfaces are not used, to reduce the load of workers and disk.",
        default="auto",
    )
    join_sessions: Literal["auto", "on_request"] = _setting(
        "Whether workers join sessions of different parent frames automatically (`auto`), or only "
        "on request (`on_request`). Only strong joins change poses.",
        "If parent frames must remain separate, or to reduce the load of workers.",
        default="auto",
    )

    # Retention
    undo_window_s: float = _setting(
        "Time for which a deletion can be undone, seconds; 0 makes it final at once.",
        "Longer if mistakes are noticed late.",
        default=600.0, ge=0, le=31_536_000,
    )  # fmt: skip
    purge_deadline_s: float = _setting(
        "Maximum time until all bytes of a deleted frame are erased on this host, seconds, from "
        "the end of `UNDO_WINDOW_S`.",
        "According to your commitments to the people in the frames.",
        default=3600.0, ge=1, le=31_536_000,
    )  # fmt: skip
    deleted_rows_days: float = _setting(
        "Time for which rows of deleted and redundant frames and of their jobs are stored, days.",
        "Longer than the longest downtime of a host, after which its index would be rebuilt.",
        default=7.0, ge=1, le=36_500,
    )  # fmt: skip
    query_log_days: float = _setting(
        "Time for which queries and their answers are stored, days. 0 stores no queries, and "
        "events do not report them.",
        "According to your commitments to the operators of the robots.",
        default=30.0, ge=0, le=36_500,
    )  # fmt: skip
    query_log_bytes: int = _setting(
        "Maximum total size of stored answers (about 200 kB each), bytes. The oldest are removed "
        "first; 0 stores no answers.",
        "According to the rate of queries.",
        default=256 << 20, ge=0,
    )  # fmt: skip
    events_per_map: int = _setting(
        "Maximum number of stored events (about 200 bytes each) per map.",
        "According to the longest time for which a robot may be offline.",
        default=1_000_000, ge=1000,
    )  # fmt: skip
    audit_log_days: float = _setting(
        "Time for which entries of the audit log are stored, days. At most the newest "
        "million entries of each tenant are stored.",
        "According to the requirements of your auditors.",
        default=365.0, gt=0, le=36_500,
    )  # fmt: skip

    @field_validator("tls_key")
    @classmethod
    def _has_certificate(cls, value: Path | None, info: ValidationInfo) -> Path | None:
        if (value is None) != (info.data.get("tls_cert") is None):
            raise ValueError("HTTPS requires both SCENEPRINT_TLS_CERT and SCENEPRINT_TLS_KEY")
        return value

    @field_validator("index_url")
    @classmethod
    def _is_shared(cls, value: str | None) -> str | None:
        if value is not None and value.startswith("memory:"):
            raise ValueError("memory:/// exists only in one process; use file:///folder")
        return value

    @field_validator("blob_url", "index_url")
    @classmethod
    def _holds_objects(cls, value: SecretStr | str | None) -> SecretStr | str | None:
        if value is not None:
            _require_object_store(value if isinstance(value, str) else value.get_secret_value())
        return value

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _origins(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        return tuple(origin.strip() for origin in value.split(",") if origin.strip())

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for origin in value:
            if origin != "*" and not re.fullmatch(r"https?://[^/?#@\s*]+", origin):
                raise ValueError(f"{origin!r:.80} is not an origin such as https://fleet.example")
        return value

    @model_validator(mode="after")
    def _names_are_known(self) -> Self:
        """Refuse misspelt names of settings, since pydantic would ignore them."""
        settings = [name.upper() for name in type(self).model_fields]
        for variable in os.environ:
            prefix, _, name = variable.partition("_")
            if prefix != "SCENEPRINT" or name.upper() in settings:
                continue
            similar = get_close_matches(name, settings, 1, cutoff=0.85)
            if similar:
                raise ValueError(
                    f"{variable} is not a setting. Did you mean SCENEPRINT_{similar[0]}?"
                )
        return self

    @property
    def asks_for_keys(self) -> bool:
        """Return whether requests require a key."""
        return self.require_keys or not is_loopback(self.host)

    @property
    def database(self) -> str:
        """Return the URL of the database."""
        from sqlalchemy import URL

        if self.database_url is not None:
            return self.database_url.get_secret_value()
        # SQLAlchemy escapes special characters in the folder's name
        url = URL.create("sqlite", database=str((self.data_dir / "sceneprint.db").absolute()))
        return url.render_as_string(hide_password=False)

    @property
    def blobs(self) -> Path | str:
        """Return the folder or URL that contains uploads and geometry artifacts."""
        value = "" if self.blob_url is None else self.blob_url.get_secret_value()
        return value if value and not value.startswith("file:") else self.blob_dir

    @property
    def served_blobs(self) -> Path | str:
        """Return `blobs` for a service whose workers are separate processes.

        Raises
        ------
        UnusableStore : If BLOB_URL stores blobs in the memory of one process
        """
        if str(self.blobs).startswith("memory:"):
            raise UnusableStore(
                "SCENEPRINT_BLOB_URL=memory:/// stores blobs in the memory of one process, so the "
                "workers of a service cannot read them. Use file:///folder, or `Client.embedded`."
            )
        return self.blobs

    @property
    def blob_dir(self) -> Path:
        """Return the folder of uploads and geometry artifacts; None if BLOB_URL is not a folder."""
        return self._blob_root / "blobs"

    @property
    def quarantine_dir(self) -> Path:
        """Return the folder to which `sceneprint fsck --repair` moves damaged blobs."""
        return self.data_dir / "quarantine"

    @property
    def query_dir(self) -> Path:
        """Return the folder of stored answers; deleting it does not affect anything else."""
        return self._blob_root / "queries"

    @property
    def _blob_root(self) -> Path:
        value = "" if self.blob_url is None else self.blob_url.get_secret_value()
        if value.startswith("file:"):
            return Path(unquote(urlsplit(value).path))
        return self.data_dir

    @property
    def bell_dir(self) -> Path:
        """Return the folder of the FIFOs that wake idle workers."""
        return self.data_dir / "bells"

    @property
    def indexes(self) -> Path:
        """Return the folder of search indexes."""
        return self.index_dir or self.data_dir / "index"


def _require_object_store(url: str) -> None:
    """Raise ValueError if a URL does not name an object store or if it contains credentials.

    The message does not contain the URL.
    """
    scheme, _, rest = url.partition("://")
    if scheme not in OBJECT_SCHEMES or "://" not in url:
        known = ", ".join(f"{name}://" for name in OBJECT_SCHEMES)
        raise ValueError(f"the URL must start with one of {known}")
    try:
        holds = "@" in urlsplit(url).netloc or "?" in rest or "#" in rest
    except ValueError:
        holds = True
    if holds:
        raise ValueError(
            "the URL must contain only a bucket and a prefix; set credentials in the environment "
            "(AWS_..., GOOGLE_..., AZURE_...)"
        )
    if scheme in ("s3", "gs", "az") and not urlsplit(url).netloc:
        raise ValueError("the URL contains no bucket")
