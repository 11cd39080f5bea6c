"""All that an operator can set, in one place; built once, then handed down."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import unquote, urlsplit

import platformdirs
from pydantic import Field, SecretStr, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from sceneprint.errors import UnusableStore
from sceneprint.models import default_cache_dir
from sceneprint_client.api.base import is_loopback


def default_data_dir() -> Path:
    """Where a user's maps are kept unless told otherwise."""
    return Path(platformdirs.user_data_dir("sceneprint", appauthor=False))


#: Where blobs and indexes may be, by what their URL begins with.
OBJECT_SCHEMES = ("s3", "gs", "az", "file", "memory")


class Settings(BaseSettings):
    """Read from the environment: SCENEPRINT_<FIELD>. Nothing has to be set."""

    model_config = SettingsConfigDict(
        env_prefix="SCENEPRINT_", frozen=True,
        hide_input_in_errors=True,  # it may be a URL with a password
    )  # fmt: skip

    #: Folder of derived files (pair tables). Deleting it loses nothing but seconds.
    cache_dir: Path = Field(default_factory=default_cache_dir)
    #: Folder of what must not be lost: the SQLite database and the blobs.
    data_dir: Path = Field(default_factory=default_data_dir)
    #: SQLAlchemy URL of the database; default: SQLite in the data folder.
    database_url: SecretStr | None = None
    #: Where blobs are kept: s3://bucket/prefix, gs://, az://, file:/// or memory:///; default:
    #: `blobs` in the data folder. Credentials come from the environment of the cloud, never here.
    blob_url: SecretStr | None = None
    #: Folder of search indexes, of this machine alone. Deleting it loses nothing but minutes;
    #: default: `index` in the data folder.
    index_dir: Path | None = None
    #: Where a fleet shares search indexes: s3://bucket/prefix, gs://, az:// or file:///; each is
    #: then built once, and fetched by nodes that serve its map. Default: each host builds its own.
    index_url: str | None = None
    #: Room for search indexes on this machine where they are shared, bytes; those of maps that were
    #: not asked for longest are removed.
    index_bytes: int = Field(default=16 << 30, ge=0)
    #: Address the service listens on. Any but a loopback address asks callers for a key.
    host: str = "127.0.0.1"
    #: Port of the service; 0 for a free one.
    port: int = Field(default=8008, ge=0, le=65535)
    #: Certificate of the service and its chain, PEM. With its key the service speaks HTTPS alone.
    tls_cert: Path | None = None
    #: Key of the certificate, PEM, not encrypted.
    tls_key: Path | None = Field(default=None, validate_default=True)
    #: Worker processes that sign frames; they give way to requests.
    workers: int = Field(default_factory=lambda: os.cpu_count() or 1, ge=0, le=256)
    #: Uploads and queries that are worked on at once; more wait.
    concurrency: int = Field(default_factory=lambda: max(os.cpu_count() or 1, 2), ge=1, le=256)
    #: Cores that the queries of a service process share; one that finds a core free is faster.
    query_cores: int = Field(default_factory=lambda: os.cpu_count() or 1, ge=1, le=256)
    #: Memory of a process for geometry of frames that it compared lately, bytes; 0 for none.
    geometry_bytes: int = Field(default=256 << 20, ge=0)
    #: Uploads and queries that may wait; more are asked to come back (503).
    waiting: int = Field(default=64, ge=0, le=10_000)
    #: Seconds that an upload or a query may wait for its turn; then it is asked to come back (503).
    wait_s: float = Field(default=5.0, gt=0, le=3600)
    #: Largest body of a request, bytes.
    upload_bytes: int = Field(default=72 << 20, ge=1024, le=512 << 20)
    #: Largest archive that is imported, bytes; inflated it may have four times as many.
    import_bytes: int = Field(default=4 << 30, ge=1024)
    #: Seconds for a body of hardly any bytes; each MiB of it may take 4 s more.
    body_s: float = Field(default=30.0, ge=1, le=3600)
    #: Ask callers for a key on a loopback address as well, as behind a proxy.
    require_keys: bool = False
    #: Requests a second of each tenant, weighted by work, over five seconds; 0 for no limit.
    requests_per_s: float = Field(default=200.0, ge=0, le=1e6)
    #: Wrong keys a minute from each address; 0 for no limit.
    failed_keys_per_minute: float = Field(default=60.0, ge=0, le=1e6)
    #: Origins whose web pages may ask, with commas between: https://fleet.example; * for all.
    cors_origins: Annotated[tuple[str, ...], NoDecode] = ()
    #: Seconds after which a silent worker loses its job.
    lease_s: float = Field(default=60.0, ge=0.1, le=3600)
    #: Longest time for one job, seconds; a worker that takes longer hangs, and is ended.
    job_s: float = Field(default=120.0, ge=1, le=3600)
    #: Memory that a worker may take for its work, bytes, beyond what it has when it is ready;
    #: 0 for no limit. What needs more fails, and no other process is killed for it.
    worker_bytes: int = Field(default=2 << 30, ge=0)
    #: Processes that uploads are decoded in, of the service at most; a worker has one of its own.
    #: They may do nothing but compute. 0: uploads are decoded in the service and the workers.
    decoders: int = Field(default_factory=lambda: min(max(os.cpu_count() or 1, 2), 8), ge=0, le=256)
    #: Memory that a decoder may take for an upload, bytes; 0 for no limit.
    decoder_bytes: int = Field(default=2 << 30, ge=0)
    #: Processor time that a decoder may take for an upload, seconds.
    decoder_s: float = Field(default=30.0, ge=0.1, le=3600)
    #: Frames newer than the index above which a worker publishes a new one.
    tail_frames: int = Field(default=1000, ge=1, le=100_000)
    #: Seconds after which a worker reads all index files again, to see that they are sound.
    scrub_s: float = Field(default=3600.0, ge=1, le=31_536_000)
    #: Stored bytes that workers read each second, to see that they are sound, MB; 0: none are read.
    scrub_mb_per_s: float = Field(default=1.0, ge=0, le=10_000)
    #: Days for which queries are listed, and their answers can be looked at; 0: none is stored.
    answer_days: float = Field(default=30.0, ge=0, le=36_500)
    #: Room for answers, bytes; the oldest are removed first. 0: none is stored.
    answer_bytes: int = Field(default=256 << 20, ge=0)
    #: Seconds for which deleted frames can be restored; 0: a deletion is for good at once.
    undo_s: float = Field(default=600.0, ge=0, le=31_536_000)
    #: Days for which rows of deleted and of redundant frames, and of their jobs, stay.
    deleted_rows_days: float = Field(default=7.0, ge=1, le=36_500)
    #: Streams of events that one service process keeps open at once; more are refused (503).
    event_streams: int = Field(default=64, ge=0, le=10_000)
    #: Newest events of each map that are kept; older ones are removed, 200 bytes each.
    events_kept: int = Field(default=1_000_000, ge=1000)
    #: Days for which lines of the audit log are kept; of each tenant at most 200,000 changes and as
    #: many refusals.
    audit_kept_days: float = Field(default=365.0, gt=0, le=36_500)
    #: Who begins the fused surface of a map: workers, as frames come, or whoever asks for it.
    #: Deleted frames are always taken out of one that there is.
    surfaces: Literal["auto", "asked"] = "auto"
    #: Who starts the associations that join the parent frames of a map: workers, as sessions come,
    #: or whoever asks for one. Only a strong join moves poses.
    joins: Literal["auto", "asked"] = "auto"
    #: Seconds after which no byte of a deleted frame is left in the caches of this node.
    purge_s: float = Field(default=3600.0, ge=1, le=31_536_000)

    @field_validator("tls_key")
    @classmethod
    def _has_certificate(cls, given: Path | None, info: ValidationInfo) -> Path | None:
        if (given is None) != (info.data.get("tls_cert") is None):
            raise ValueError("HTTPS needs SCENEPRINT_TLS_CERT and SCENEPRINT_TLS_KEY; set both")
        return given

    @field_validator("index_url")
    @classmethod
    def _is_shared(cls, given: str | None) -> str | None:
        if given is not None and given.startswith("memory:"):
            raise ValueError("memory:/// is inside one process; use file:///folder")
        return given

    @field_validator("blob_url", "index_url")
    @classmethod
    def _holds_objects(cls, given: SecretStr | str | None) -> SecretStr | str | None:
        if given is not None:
            _require_objects(given if isinstance(given, str) else given.get_secret_value())
        return given

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _origins(cls, given: object) -> object:
        if not isinstance(given, str):
            return given
        return tuple(one.strip() for one in given.split(",") if one.strip())

    @field_validator("cors_origins")
    @classmethod
    def _are_origins(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        for one in given:
            if one != "*" and not re.fullmatch(r"https?://[^/?#@\s*]+", one):
                raise ValueError(f"{one!r:.80} is not an origin such as https://fleet.example")
        return given

    @property
    def asks_for_keys(self) -> bool:
        """Whether callers must show a key."""
        return self.require_keys or not is_loopback(self.host)

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
    def blobs(self) -> Path | str:
        """Where uploads and geometry artifacts are kept: a folder, or a URL."""
        given = "" if self.blob_url is None else self.blob_url.get_secret_value()
        return given if given and not given.startswith("file:") else self.blob_dir

    @property
    def served_blobs(self) -> Path | str:
        """As `blobs`, for a service whose workers are other processes.

        Raises
        ------
        UnusableStore : they would be kept inside one process.
        """
        if str(self.blobs).startswith("memory:"):
            raise UnusableStore(
                "SCENEPRINT_BLOB_URL=memory:/// keeps blobs inside one process, so the workers of "
                "a service cannot read them. Use file:///folder, or `Client.embedded`."
            )
        return self.blobs

    @property
    def blob_dir(self) -> Path:
        """Folder of uploads and geometry artifacts, where they are in one."""
        return self._blob_root / "blobs"

    @property
    def quarantine_dir(self) -> Path:
        """Folder of damaged bytes that `sceneprint fsck --repair` has set aside."""
        return self.data_dir / "quarantine"

    @property
    def query_dir(self) -> Path:
        """Folder of answers that can be looked at afterwards. Deleting it loses only those."""
        return self._blob_root / "queries"

    @property
    def _blob_root(self) -> Path:
        given = "" if self.blob_url is None else self.blob_url.get_secret_value()
        if given.startswith("file:"):
            return Path(unquote(urlsplit(given).path))
        return self.data_dir

    @property
    def bell_dir(self) -> Path:
        """Folder of what wakes waiting workers."""
        return self.data_dir / "bells"

    @property
    def indexes(self) -> Path:
        """Folder of search indexes."""
        return self.index_dir or self.data_dir / "index"


def _require_objects(url: str) -> None:
    """See that a URL names a place for objects, and holds no credentials. It is never repeated."""
    scheme, _, rest = url.partition("://")
    if scheme not in OBJECT_SCHEMES or "://" not in url:
        known = ", ".join(f"{one}://" for one in OBJECT_SCHEMES)
        raise ValueError(f"it does not start with any of {known}")
    try:
        holds = "@" in urlsplit(url).netloc or "?" in rest or "#" in rest
    except ValueError:
        holds = True
    if holds:
        raise ValueError(
            "it contains more than a bucket and a prefix; credentials come from the environment "
            "(AWS_..., GOOGLE_..., AZURE_...), never from a URL"
        )
    if scheme in ("s3", "gs", "az") and not urlsplit(url).netloc:
        raise ValueError("it names no bucket")
