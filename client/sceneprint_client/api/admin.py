"""Records of keys, the audit log, statistics, models, jobs and events."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AwareDatetime, Field, StringConstraints

from sceneprint_client.api.base import MAP_OR_EVERY, ApiRecord, Given, JobState, Label, Page
from sceneprint_client.api.frames import RecordingOutline

#: Scopes of a key for a map. Each scope includes the previous ones.
Scope = Literal["read", "write", "admin"]
SCOPES: tuple[Scope, ...] = ("read", "write", "admin")
#: Map name in a grant for all maps and for operations that belong to no map.
EVERY = "*"


class NewKey(Given):
    """A key to create."""

    name: Label = Field(
        description="Unique name of the key, such as its user's name. The audit log contains it.",
        examples=["robot-7"],
    )
    grants: Annotated[
        dict[Annotated[str, StringConstraints(pattern=MAP_OR_EVERY)], Scope],
        Field(min_length=1, max_length=1000),
    ] = Field(
        description="Scope by map name. The map need not exist yet. `*` stands for all maps and "
        "for operations that belong to no map. `write` includes `read`, and `admin` includes both.",
        examples=[{"warehouse-2": "write"}],
    )
    expires_at: AwareDatetime | None = Field(
        default=None, description="Expiry time; null if the key does not expire."
    )
    tenant: Label | None = Field(
        default=None,
        description="Tenant that owns the key; the tenant must exist. If null, the tenant has the "
        "same name as the key.",
    )


class Key(ApiRecord):
    """An API key without its secret, which the service does not store."""

    name: str
    grants: dict[str, Scope] = Field(description="Scope for each map; `*` stands for all maps.")
    created_at: datetime
    expires_at: datetime | None = Field(description="Expiry time; null if the key does not expire.")
    tenant: str = Field(
        description="Tenant that owns the key. Limits apply to all keys of a tenant together."
    )
    previous_until: datetime | None = Field(
        default=None,
        description="Expiry time of the previous secret after a rotation; null if there is no "
        "previous secret.",
    )
    last_used_at: datetime | None = Field(
        default=None,
        description="Time of the last use, accurate to the hour; null if the key was never used.",
    )


class MadeKey(Key):
    """A new key, or a key with a new secret."""

    secret: str = Field(
        description="Secret for the header `Authorization: Bearer SECRET`. It is shown only once, "
        "because the service stores only its hash."
    )


class Me(ApiRecord):
    """Name and permissions of the key that authenticated the request."""

    name: str | None = Field(description="Name of the key; null if no key is required.")
    grants: dict[str, Scope] = Field(description="Scope for each map; `*` stands for all maps.")
    expires_at: datetime | None = Field(
        default=None, description="Expiry time; null if the key does not expire."
    )


class AuditLine(ApiRecord):
    """An entry of the audit log: a change and its author, or a refused request."""

    number: int = Field(description="Line number. Line numbers increase, possibly with gaps.")
    at: datetime
    actor: str | None = Field(
        description="Name of the key; null if the service requires no keys. `command`: a command "
        "changed the data folder directly."
    )
    address: str | None = Field(description="IP address of the caller or its proxy.")
    tenant: str = Field(description="Tenant of the key; empty if there is no key.")
    action: str = Field(
        description="Kind of the event, such as `map.deleted`, or name of an action that sends no "
        "event, such as `job.cancelled`. `refused`: a request that was refused with 401 or 403 and "
        "changed nothing."
    )
    map: str | None = Field(description="Name of the changed map.")
    target: str | None = Field(description="Id or name of the changed object.")
    request_id: str | None = Field(description="Id of the request, as in the log.")
    data: dict[str, Any] = Field(description="Additional data, depending on the action.")


# Statistics and models.


class Sizes(ApiRecord):
    """Disk space of a store and its parts, bytes."""

    database: int | None = Field(
        description="Size of the database, including its log; null if the database is not a file. "
        "For a single map, the size of its signatures."
    )
    blobs: int = Field(
        description="Size of uploads and derived files, estimated from a sample if there are many "
        "files. For a single map, the size of its frames, excluding archives and meshes."
    )
    index: int = Field(description="Size of the search indexes that are cached on this machine.")
    free: int | None = Field(
        description="Free space on the disk of the data folder; null for a single map."
    )
    disk: int | None = Field(
        default=None,
        description="Size of the disk of the data folder; null for a single map.",
    )


class IndexRecall(ApiRecord):
    """Recall of queries with an index (without `exact`), measured when the index was published."""

    share: float = Field(
        description="Share of the `near` nearest frames that a query finds; 1 if a query compares "
        "every frame."
    )
    near: int = Field(description="Number of nearest frames that each test query should find.")
    sample: int = Field(
        description="Number of test queries; 0 if a query compares every frame. Each test query "
        "uses a frame of the map and excludes this frame from the search."
    )
    probes: int = Field(
        description="Minimum number of frames that a query compares in a large map; 0 if a query "
        "compares every frame. The query compares the frames with the nearest sketches (one bit "
        "for each byte of a signature)."
    )
    frames: int = Field(description="Number of frames in the index at the time of the measurement.")


class IndexState(ApiRecord):
    """State of a map's search index. Frames that are not in the index are compared one by one."""

    map: str
    version: int | None = Field(
        description="Version of the index; null if there is no index, for example because the map "
        "is small or its model stores psi. Without an index, queries compare every frame."
    )
    tail: int = Field(
        description="Number of searchable frames that are not in this version of the index. If the "
        "number stays above the setting `UNINDEXED_FRAMES`, check that workers are running."
    )
    recall: IndexRecall | None = Field(
        default=None,
        description="Recall with the index; null if there is no index.",
    )


class WorkerSeen(ApiRecord):
    """A running worker process."""

    name: str = Field(description="Host name and process id.")
    job_id: str | None = Field(description="Id of the current job; null if the worker is idle.")


class Latency(ApiRecord):
    """Percentiles of the response time in seconds, accurate to within 10 %."""

    p50: float
    p95: float
    p99: float


class Counted(ApiRecord):
    """Counts over a period."""

    received: int = Field(description="Number of frames that were stored or queued again.")
    indexed: int
    rejected: int = Field(description="Number of frames that cannot be signed.")
    redundant: int
    failed: int
    deleted: int
    queries: dict[str, int] | None = Field(
        description="Number of queries for each status of the answer, for the whole service. This "
        "and the following fields are null for a single map."
    )
    latency: Latency | None = Field(
        description="Latency of answered queries; null if there were no queries."
    )
    requests: int | None = Field(description="Number of requests under /v1, answered or refused.")
    refused: int | None = Field(description="Number of requests under /v1 with a 4xx response.")
    busy: int | None = Field(
        description="Number of requests under /v1 with a 503 response. Clients should retry them."
    )
    broken: int | None = Field(
        description="Number of requests under /v1 with another 5xx response."
    )


class Minute(Counted):
    """Counts over one minute. A request may be counted up to ten seconds after its response."""

    at: datetime = Field(description="Start of the minute.")


class MapUse(ApiRecord):
    """A map's usage, quota and retention; see Map."""

    frames: int = Field(description="Number of frames that count towards the quota.")
    bytes: int = Field(description="Size of the uploads that count towards the quota, as received.")
    quota_frames: int | None = Field(
        description="Maximum number of frames; null if there is no quota."
    )
    quota_bytes: int | None = Field(
        description="Maximum size of the uploads, bytes; null if there is no quota."
    )
    retention_days: float | None = Field(
        description="Retention time, days; null if frames do not expire."
    )


class ScrubSeen(ApiRecord):
    """Progress of the check of all stored data."""

    began_at: datetime = Field(
        description="Start of the current pass, or of the last pass if none is running."
    )
    finished_at: datetime | None = Field(
        description="End of the last complete pass; null if no pass has been completed."
    )
    blobs: int = Field(description="Number of uploads and artifacts that this pass has read.")
    bytes: int = Field(description="Size of the uploads and artifacts that this pass has read.")
    damaged: int = Field(
        description="Number of lost or damaged rows, signatures, uploads and artifacts that this "
        "pass has found. `frame.damaged` events name the frames with lost data, and `sceneprint "
        "fsck` lists everything."
    )


class Stats(ApiRecord):
    """State and recent activity of the service, or of one map."""

    at: datetime
    counted_at: datetime | None = Field(
        default=None,
        description="Time at which frames, ended jobs, indexes and bytes were counted. Above "
        "100,000 frames and jobs, the service counts less often, to spend at most 1 % of its time.",
    )
    map: str | None = Field(description="Name of the map; null for all maps.")
    maps: int
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    jobs: dict[str, int] = Field(description="Number of jobs in each state.")
    waiting: int = Field(description="Number of jobs that are waiting for a worker.")
    oldest_waiting_s: dict[str, float] = Field(
        description="Age of the oldest waiting job of each kind, seconds."
    )
    indexes: list[IndexState] = Field(
        description="Indexes of at most 200 recently changed maps, by decreasing `tail`."
    )
    workers: list[WorkerSeen] | None = Field(
        description="Workers on all hosts that share a PostgreSQL database, or on this machine if "
        "the database is SQLite; null for a single map."
    )
    bytes: Sizes = Field(description="Disk space, measured at most twice per minute.")
    use: MapUse | None = Field(
        default=None, description="Usage, quota and retention of the map; null for all maps."
    )
    scrub: ScrubSeen | None = Field(
        default=None,
        description="Progress of the check of all stored data; null before the first pass and for "
        "a single map.",
    )
    total: Counted = Field(description="Sum of the counts of all minutes.")
    minutes: list[Minute] = Field(
        description="Counts of the most recent minutes, oldest first; the last minute is "
        "incomplete."
    )


class ModelInfo(ApiRecord):
    """A model: all parameters and trained data that determine the signatures of frames."""

    model_id: str
    label: str = Field(description="Name and first digits of the id; used in maps and answers.")
    name: str
    preset: bool = Field(description="Whether the model is part of this version of the service.")
    components: int = Field(description="G, the number of components of the mixture.")
    levels: int = Field(description="H, the number of levels of the patch hierarchy.")
    signature_bytes: int = Field(
        description="Length of a stored signature, bytes: d, or 25 G H if psi itself is stored."
    )
    metric: Literal["l1", "l2"] = Field(
        description="Distance metric. `l2`: squared L2. `l1`: L1, if psi itself is stored."
    )
    unrelated_distance: float = Field(
        description="d0, the median distance between unrelated frames; similarity = 1 - distance / "
        "d0."
    )
    parameters: dict[str, Any] = Field(description="Parameters of all stages of signing.")
    provenance: dict[str, Any] = Field(description="Training data and training method.")
    maps: list[str] = Field(
        description="Maps that you may read and that use the model or are switching to it."
    )


class NewModel(Given):
    """The model with which to sign the frames of a map again."""

    model: Label = Field(
        description="`depth`, `lidar`, `paper`, or the id or label of a model in GET /v1/models.",
        examples=["depth"],
    )


#: Kinds of frame events that statistics count.
Outcome = Literal["received", "indexed", "rejected", "redundant", "failed", "deleted"]
OUTCOMES: tuple[Outcome, ...] = (
    "received", "indexed", "rejected", "redundant", "failed", "deleted"
)  # fmt: skip


# Jobs.


#: Phases of the import of a map, in order.
ImportPhase = Literal["read", "choose", "render", "sign", "test", "add"]


class Progress(ApiRecord):
    """Progress of a job with several steps."""

    done: int = Field(description="Number of completed steps (frames, or files of an archive).")
    total: int | None = Field(default=None, description="Total number of steps; null if unknown.")
    phase: ImportPhase | None = Field(
        default=None,
        description="Phase of the import of a map or a recording. This and the following fields "
        "are null for other jobs.",
    )
    recording: RecordingOutline | None = Field(
        default=None, description="Content of the recording; null before it is read."
    )
    points: int | None = Field(default=None, description="Number of points that were read.")
    views: int | None = Field(default=None, description="Number of selected viewpoints.")
    rendered: int | None = Field(
        default=None, description="Number of views that were rendered and added."
    )
    signed: int | None = Field(default=None, description="Number of views that were signed.")
    tested: int | None = Field(default=None, description="Number of test views that were queried.")


class Product(ApiRecord):
    """A job that computes a result from a map or an answer."""

    #: Name of the product, last path segment of the product list, and class of the request.
    noun: ClassVar[str]
    collection: ClassVar[str]
    request_type: ClassVar[type[Given]]

    job_id: str = Field(description="Id of this result and of its job; see GET /v1/jobs/{job_id}.")
    map: str | None = Field(
        description="Name of the map; null if the result may belong to several maps."
    )
    state: JobState
    progress: Progress | None = Field(description="Progress of the job; null before it starts.")
    error: str | None
    created_at: datetime
    finished_at: datetime | None


class Job(ApiRecord):
    """A job in the queue."""

    job_id: str
    kind: str = Field(
        description="`sign`, `import`, `import-map`, `import-bag`, `associate`, `coverage`, "
        "`difference`, `surface`, `reconstruct`, or `reencode`, which signs an indexed frame "
        "again, for the map's next model or to replace a damaged signature."
    )
    state: JobState
    map: str | None = Field(description="Name of the map.")
    frame_id: str | None = Field(description="Frame that the job signs; null for other jobs.")
    priority: int = Field(description="Jobs of higher priority run first.")
    attempts: int
    created_at: datetime
    started_at: datetime | None = Field(default=None, description="Start of the latest attempt.")
    finished_at: datetime | None
    error: str | None
    traceback: str | None
    progress: Progress | None = Field(
        default=None,
        description="Progress of a long job, which runs in slices; null before it starts.",
    )
    result: dict[str, Any] | None = Field(
        default=None,
        description="Summary of the result of a long job that has succeeded.",
    )
    followed_by: str | None = Field(
        default=None,
        description="Latest job with the same task for the same frame, such as a retry; null if "
        "this is the latest job.",
    )


class RefusedRetry(ApiRecord):
    """A dead job that cannot be retried."""

    job_id: str
    reason: str


class RetriedJobs(ApiRecord):
    """The result of retrying a page of dead jobs."""

    retried: list[Job] = Field(description="New jobs that retry the dead jobs.")
    refused: list[RefusedRetry]
    next_cursor: str | None = Field(
        description="Cursor of the next page, to send as `cursor`; null on the last page."
    )


# Events.

#: Meaning of every kind of event. A test compares this table with the code and the documentation.
KINDS = {
    "map.created": "A map was created.",
    "map.edited": "The title or another property of a map was changed.",
    "map.deleted": "A map and its contents were deleted.",
    "map.reencoding": "A map is being signed with another model, `data.model`.",
    "map.reencoding_cancelled": "The change of a map's model was cancelled.",
    "map.reencoded": "A map has switched from `data.before` to `data.model`.",
    "frame.received": "A frame is stored durably and waits for a worker, or is being retried.",
    "frame.indexed": "A frame was signed, and queries find it.",
    "frame.rejected": "A frame cannot be signed because it contains too little surface.",
    "frame.redundant": "A frame with `if_novel` was dropped: the map already covers its place.",
    "frame.failed": "Signing a frame failed in every attempt, or was cancelled.",
    "frame.edited": "The metadata of a frame was changed.",
    "frame.damaged": "Data derived from a frame is damaged; a worker derives it again from the "
    "upload. With `data.upload`, the upload itself is lost or damaged; upload the frame again.",
    "frame.reencoded": "A frame was signed again, for a new model or to repair a signature.",
    "frame.deleted": (
        "A frame was deleted, and no query finds it. `data.reason` is `retention` if it exceeded "
        "the retention time of its map."
    ),
    "frame.restored": "The deletion of a frame was undone; queries find it if it was indexed.",
    "query.answered": (
        "A query was answered, or failed; `data` has `query_id`, `status`, `robot`, `pose` if it "
        "was found, and more."
    ),
    "import.done": "The import of an archive or a map has ended; `data` is its result.",
    "association.found": "A search for associations has ended; `data` is its result.",
    "association.undone": "The join of an association was undone, which changed poses of frames.",
    "surface.updated": "An update of a map's surface has ended; `data` has `frames` and `tiles`.",
    "coverage.measured": "A measurement of a map's coverage has ended; `data` is its result.",
    "difference.found": "A comparison of two sessions has ended; `data` is its result.",
    "key.created": "A key was created. The event belongs to no map.",
    "key.rotated": "A key got a new secret; the old one expires soon. The event belongs to no map.",
    "key.revoked": "A key was revoked and no longer works. The event belongs to no map.",
}
#: Kind of the event that replaces expired events in a stream. It is not stored.
MISSED = "events.missed"


class Event(ApiRecord):
    """An event of the service."""

    id: str = Field(
        description="Opaque id. To continue after this event, send its id as `Last-Event-ID` to a "
        "stream or as `after` in a request. Ids cannot be used to sort events; lists of events are "
        "already in order."
    )
    at: datetime
    kind: str = Field(
        description="Kind, such as frame.indexed; docs/operations.md lists all kinds. Clients must "
        "accept unknown kinds. `events.missed` replaces requested events that have expired; reload "
        "the state of your maps, then continue."
    )
    map: str | None = Field(description="Name of the map.")
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any] = Field(description="Additional data, depending on the kind.")


class EventPage(Page[Event]):
    """A page of stored events."""

    newest: str = Field(
        description="Id of the newest event of your maps, of any kind, at the time of the request; "
        "0 if there are no events. To continue from here, open a stream with this id as `after`."
    )
