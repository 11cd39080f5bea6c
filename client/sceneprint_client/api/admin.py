"""Keys, what they may do, and who changed what, as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AwareDatetime, Field, StringConstraints

from sceneprint_client.api.base import MAP_OR_EVERY, ApiRecord, Given, JobState, Label, Page

#: What a key may do with a map; each may what those before it may.
Scope = Literal["read", "write", "admin"]
SCOPES: tuple[Scope, ...] = ("read", "write", "admin")
#: In place of the name of a map: all of them, and what is of no map.
EVERY = "*"


class NewKey(Given):
    """A key to create."""

    name: Label = Field(
        description="Name of its user; unique, and shown in the audit log.", examples=["robot-7"]
    )
    grants: Annotated[
        dict[Annotated[str, StringConstraints(pattern=MAP_OR_EVERY)], Scope],
        Field(min_length=1, max_length=1000),
    ] = Field(
        description="Scope by the name of a map, which need not exist yet; `*` stands for all "
        "maps, and for operations on no map. `write` includes `read`, and `admin` everything.",
        examples=[{"warehouse-2": "write"}],
    )
    expires_at: AwareDatetime | None = Field(
        default=None, description="Time from which it is invalid; null: never."
    )
    tenant: Label | None = Field(
        default=None,
        description="Tenant that owns it, which must exist; null: a tenant of the key's name.",
    )


class Key(ApiRecord):
    """An API key without its secret, which the service does not store."""

    name: str
    grants: dict[str, Scope] = Field(description="Scope for each map; `*` for all maps.")
    created_at: datetime
    expires_at: datetime | None = Field(description="Null if it does not expire.")
    tenant: str = Field(
        description="Tenant that owns it. Limits apply to all keys of a tenant together."
    )
    previous_until: datetime | None = Field(
        default=None,
        description="Time until which the secret before the last rotation works; null if none "
        "does.",
    )
    last_used_at: datetime | None = Field(
        default=None,
        description="Time of the last use, accurate to about an hour; null if never used.",
    )


class MadeKey(Key):
    """A new key, or a key with a new secret."""

    secret: str = Field(
        description="Send it as `Authorization: Bearer SECRET`. It is shown only once: the "
        "service stores its hash alone."
    )


class Me(ApiRecord):
    """The caller as the service sees it."""

    name: str | None = Field(description="Name of the key; null if the service requires none.")
    grants: dict[str, Scope] = Field(description="Scope for each map; `*` for all maps.")
    expires_at: datetime | None = Field(default=None, description="Null if it does not expire.")


class AuditLine(ApiRecord):
    """A change and its author, or a refused request."""

    number: int = Field(description="Increases with each line; there may be gaps.")
    at: datetime
    actor: str | None = Field(
        description="Name of the key; null if the service requires none; `command` for a "
        "command on the data folder."
    )
    address: str | None = Field(description="Address of the caller, or of its proxy.")
    tenant: str = Field(description="Tenant of the key; empty without a key.")
    action: str = Field(
        description="Kind of the change's event, such as `map.deleted`, or an action without an "
        "event, such as `job.cancelled`; `refused` for a refused request (401 or 403), which "
        "changed nothing."
    )
    map: str | None = Field(description="Name of the map that was changed.")
    target: str | None = Field(description="Id or name of the object that was changed.")
    request_id: str | None = Field(description="Id of the request, as in the log.")
    data: dict[str, Any] = Field(description="Further data of the action.")


# How a service does, and what it signs with, as JSON.


class Sizes(ApiRecord):
    """Disk space, bytes."""

    database: int | None = Field(
        description="Size of the database with its log; null if it is not a file. For one map: "
        "of its signatures."
    )
    blobs: int = Field(
        description="Size of uploads and derived files; of many files it is estimated from a "
        "sample. For one map: of its frames, without archives and meshes."
    )
    index: int = Field(description="Size of this machine's search indexes, which are a cache.")
    free: int | None = Field(description="Free space on the data folder's disk; null for one map.")
    disk: int | None = Field(
        default=None,
        description="Size of the data folder's disk; null like `free`.",
    )


class IndexRecall(ApiRecord):
    """Recall of queries without `exact` that use an index, measured at its publication."""

    share: float = Field(
        description="Share of the `near` nearest frames that such a query finds; 1 if it "
        "compares every frame."
    )
    near: int = Field(description="Number of nearest frames that each lookup had to find.")
    sample: int = Field(
        description="Number of the map's frames that were looked up, each excluded from its own "
        "search; 0 if a query compares every frame."
    )
    probes: int = Field(
        description="Minimum number of frames that a query compares in a large map: those whose "
        "sketches (a bit for each byte of a signature) are nearest to its own. 0 if it compares "
        "every frame."
    )
    frames: int = Field(description="Number of frames in the index when it was measured.")


class IndexState(ApiRecord):
    """State of a map's search index; queries compare newer frames themselves."""

    map: str
    version: int | None = Field(
        description="Null: the map has none, and a query compares every frame. Small maps need "
        "none, and models that store psi have none."
    )
    tail: int = Field(
        description="Indexed frames that the version lacks. Above the setting `UNINDEXED_FRAMES`, "
        "and not going down: see that workers run."
    )
    recall: IndexRecall | None = Field(
        default=None,
        description="Null without an index: a query compares every frame.",
    )


class WorkerSeen(ApiRecord):
    """A worker process that is running."""

    name: str = Field(description="Host and process id.")
    job_id: str | None = Field(description="Id of its current job.")


class Latency(ApiRecord):
    """Percentiles of the time to answer, seconds, accurate to a tenth."""

    p50: float
    p95: float
    p99: float


class Counted(ApiRecord):
    """Counts over a period."""

    received: int = Field(description="Number of frames that were stored or queued again.")
    indexed: int
    rejected: int = Field(description="Number of frames in which nothing can be signed.")
    redundant: int
    failed: int
    deleted: int
    queries: dict[str, int] | None = Field(
        description="Number of queries by the status of the answer, of the whole service. Null "
        "for a single map, like the following."
    )
    latency: Latency | None = Field(
        description="Latency of answered queries; null if there were none."
    )
    requests: int | None = Field(description="Number of requests under /v1, answered or refused.")
    refused: int | None = Field(description="Number of these with 4xx.")
    busy: int | None = Field(
        description="Number of these with 503, which ask the caller to retry later."
    )
    broken: int | None = Field(description="Number of these with any other 5xx.")


class Minute(Counted):
    """Counts over one minute. Requests count for the minute in which they were recorded, up to
    ten seconds later.
    """

    at: datetime = Field(description="Start of the minute.")


class MapUse(ApiRecord):
    """A map's use of its quota and retention; see Map."""

    frames: int = Field(description="Number of frames that count towards the quota.")
    bytes: int = Field(description="Size of their uploads as they were sent.")
    quota_frames: int | None = Field(description="Null without a quota.")
    quota_bytes: int | None = Field(description="Null without a quota.")
    retention_days: float | None = Field(description="Null if frames are kept.")


class ScrubSeen(ApiRecord):
    """The progress of verifying stored data."""

    began_at: datetime = Field(description="Start of the current pass, or of the last one.")
    finished_at: datetime | None = Field(
        description="End of the last complete pass; null if there was none."
    )
    blobs: int = Field(description="Number of uploads and artifacts that this pass has read.")
    bytes: int = Field(description="Size of these.")
    damaged: int = Field(
        description="Number of rows, signatures, uploads and artifacts that it found lost or "
        "damaged. Events `frame.damaged` name the frames of lost data, and `sceneprint fsck` "
        "lists everything."
    )


class Stats(ApiRecord):
    """State and recent activity of the service, or of one map."""

    at: datetime
    counted_at: datetime | None = Field(
        default=None,
        description="Time at which frames, ended jobs, indexes and bytes were counted. From "
        "100,000 frames and jobs on, counting takes 1 % of the time at most.",
    )
    map: str | None = Field(description="Name of the map; null for all maps.")
    maps: int
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    jobs: dict[str, int] = Field(description="Number of jobs in each state.")
    waiting: int = Field(description="Number of jobs that wait for a worker.")
    oldest_waiting_s: dict[str, float] = Field(
        description="Age of the oldest waiting job of each kind that waits, seconds."
    )
    indexes: list[IndexState] = Field(
        description="Indexes of the recently changed maps, those with the longest tail first; "
        "at most 200."
    )
    workers: list[WorkerSeen] | None = Field(
        description="Workers on every host of a PostgreSQL database, or on this machine with "
        "SQLite. Null for one map."
    )
    bytes: Sizes = Field(description="Disk space; measured at most twice a minute.")
    use: MapUse | None = Field(
        default=None, description="Use of quota and retention; null for all maps."
    )
    scrub: ScrubSeen | None = Field(
        default=None, description="Null if none has started, and for one map."
    )
    total: Counted = Field(description="Sum of all minutes.")
    minutes: list[Minute] = Field(
        description="The last minutes, the oldest first; the last is not complete."
    )


class ModelInfo(ApiRecord):
    """A model: everything that determines signatures."""

    model_id: str
    label: str = Field(description="Name and first digits of the id, as in maps and answers.")
    name: str
    preset: bool = Field(description="Whether it is part of this version.")
    components: int = Field(description="G, the number of components of the mixture.")
    levels: int = Field(description="Number of levels of the hierarchy of patches.")
    signature_bytes: int = Field(
        description="Length of a stored signature, bytes: d, or 25 G H if psi itself is stored."
    )
    metric: Literal["l1", "l2"] = Field(
        description="Metric of distances: `l2`, squared, or `l1` if psi itself is stored."
    )
    unrelated_distance: float = Field(
        description="d0, the median distance of unrelated frames: similarity = 1 - distance / d0."
    )
    parameters: dict[str, Any] = Field(description="Parameters of every stage.")
    provenance: dict[str, Any] = Field(description="Training data and method.")
    maps: list[str] = Field(
        description="Maps that you may read and that use it, or are switching to it."
    )


class NewModel(Given):
    """The model to which a map is to switch."""

    model: Label = Field(
        description="`depth`, `lidar`, `paper`, or the id or label of a model in GET /v1/models.",
        examples=["depth"],
    )


#: Ends that a frame can come to, by the kind of the event that tells it.
Outcome = Literal["received", "indexed", "rejected", "redundant", "failed", "deleted"]
OUTCOMES: tuple[Outcome, ...] = (
    "received", "indexed", "rejected", "redundant", "failed", "deleted"
)  # fmt: skip


# Jobs as JSON.


#: What the import of a map does, in this order.
ImportPhase = Literal["read", "choose", "render", "sign", "test"]


class Progress(ApiRecord):
    """The progress of a long job."""

    done: int = Field(description="Number of completed steps: frames, or members of an archive.")
    total: int | None = Field(default=None, description="Number of all steps, if known.")
    phase: ImportPhase | None = Field(
        default=None,
        description="Phase of a map's import; null for other jobs, like the following.",
    )
    points: int | None = Field(default=None, description="Number of points that were read.")
    views: int | None = Field(default=None, description="Number of selected viewpoints.")
    rendered: int | None = Field(
        default=None, description="Number of views that were rendered and added."
    )
    signed: int | None = Field(default=None, description="Number of views that were signed.")
    tested: int | None = Field(
        default=None, description="Number of test views that were looked up."
    )


class Product(ApiRecord):
    """What a job computes from a map, or from an answer."""

    #: What it is called, the end of the path that lists it, and the record that asks for it.
    noun: ClassVar[str]
    collection: ClassVar[str]
    request_type: ClassVar[type[Given]]

    job_id: str = Field(description="Id of its job as well: GET /v1/jobs/{job_id}.")
    map: str | None = Field(description="Null if it may have frames of several maps.")
    state: JobState
    progress: Progress | None = Field(description="Null before the job starts.")
    error: str | None
    created_at: datetime
    finished_at: datetime | None


class Job(ApiRecord):
    """A job of the queue."""

    job_id: str
    kind: str = Field(
        description="`sign`, `import`, `import-map`, `associate`, `coverage`, `difference`, "
        "`surface`, `reconstruct`, or `reencode`, which signs an indexed frame again, with the "
        "map's next model or because its signature is damaged."
    )
    state: JobState
    map: str | None = Field(description="Map that it works on.")
    frame_id: str | None = Field(description="Frame that it signs; null for other jobs.")
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
        description="Summary of a long job's result, when it has succeeded.",
    )
    followed_by: str | None = Field(
        default=None,
        description="Latest job that does the same for the same frame, such as a retry; null "
        "for the latest itself.",
    )


class RefusedRetry(ApiRecord):
    """A dead job that cannot be tried again."""

    job_id: str
    reason: str


class RetriedJobs(ApiRecord):
    """The result of retrying a page of dead jobs."""

    retried: list[Job] = Field(description="The new jobs.")
    refused: list[RefusedRetry]
    next_cursor: str | None = Field(
        description="Send it as `cursor` for the next page; null at the end."
    )


# Events as JSON: what happened, in the order in which it happened.

#: Every kind of event with what it means. A test holds the code to it.
KINDS = {
    "map.created": "A map was made.",
    "map.edited": "Its title or what else may change of it was changed.",
    "map.deleted": "A map was removed with all that was in it.",
    "map.reencoding": "A map is being signed with another model, `data.model`.",
    "map.reencoding_cancelled": "It was told to keep its model.",
    "map.reencoded": "It has switched from `data.before` to `data.model`.",
    "frame.received": "A frame is stored durably and waits for a worker, or is tried again.",
    "frame.indexed": "Queries find it from now on.",
    "frame.rejected": "Nothing in it can be signed.",
    "frame.redundant": "It was not kept, as asked: the map already covers its place.",
    "frame.failed": "Signing it broke down in every try, or was given up.",
    "frame.edited": "Its metadata was changed.",
    "frame.damaged": "What was made of it is damaged, and a worker signs it again from its upload; "
    "or `data.upload`: that is lost or damaged, and sending it again heals.",
    "frame.reencoded": "It was signed once more, for the model to come or what was damaged.",
    "frame.deleted": (
        "It was removed; no query finds it. `data.reason` is `retention` where its map keeps none "
        "so old."
    ),
    "frame.restored": "Its deletion was undone; queries find it again at once if it was indexed.",
    "query.answered": (
        "A query was answered, or failed; `data` has `query_id`, `status`, `robot`, `pose` where "
        "it was found, and more about it."
    ),
    "import.done": "An archive or a map was imported, as far as it could be; `data` is its result.",
    "association.found": "A job that looked for associations is over; `data` is its result.",
    "association.undone": "The join of an association was undone: frames have other poses.",
    "surface.updated": "A job that fused the surface of a map is over; `data` has `frames` and "
    "`tiles`.",
    "coverage.measured": "A job that measured a map's coverage is over; `data` is its result.",
    "difference.found": "A job that compared two sessions is over; `data` is its result.",
    "key.created": "A key was made; belongs to no map.",
    "key.rotated": "A key has a new secret; the one before ends soon. Belongs to no map.",
    "key.revoked": "A key was revoked and no longer works; belongs to no map.",
}
#: Stands in a stream where events are not there any more; kept by nobody.
MISSED = "events.missed"


class Event(ApiRecord):
    """An event."""

    id: str = Field(
        description="Opaque id: send it as `Last-Event-ID` to a stream, or as `after` to a "
        "request. Ids have no order; events are returned in theirs."
    )
    at: datetime
    kind: str = Field(
        description="Kind, such as frame.indexed; docs/operations.md lists all. Clients must "
        "accept unknown kinds. `events.missed` replaces requested events that are no longer "
        "kept: read the maps themselves, then continue."
    )
    map: str | None = Field(description="Name of the map.")
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any] = Field(description="Further data of the kind.")


class EventPage(Page[Event]):
    """A page of the kept events."""

    newest: str = Field(
        description="Id of the newest event of your maps, of any kind, at the time of the "
        "request; 0 if there is none. A stream with this id as `after` continues from here."
    )
