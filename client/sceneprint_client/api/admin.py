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
    """A key to make."""

    name: Label = Field(
        description="Who it is for; unique, and told in the audit log.", examples=["robot-7"]
    )
    grants: Annotated[
        dict[Annotated[str, StringConstraints(pattern=MAP_OR_EVERY)], Scope],
        Field(min_length=1, max_length=1000),
    ] = Field(
        description="What it may do, by the name of a map, which need not be there yet; `*` stands "
        "for all maps and for what is of none. `write` may what `read` may, `admin` all.",
        examples=[{"warehouse-2": "write"}],
    )
    expires_at: AwareDatetime | None = Field(
        default=None, description="When it opens nothing any more; null: never."
    )
    tenant: Label | None = Field(
        default=None,
        description="Whom it belongs to, which must be there; null: a tenant of the key's name.",
    )


class Key(ApiRecord):
    """A key, without its secret, which is kept nowhere."""

    name: str
    grants: dict[str, Scope] = Field(description="What it may do, by map; `*` for all.")
    created_at: datetime
    expires_at: datetime | None = Field(description="Null: it does not expire.")
    tenant: str = Field(description="Whom it belongs to: what its keys ask is counted together.")
    previous_until: datetime | None = Field(
        default=None,
        description="Until when the secret before the last rotation still works; null: none does.",
    )
    last_used_at: datetime | None = Field(
        default=None, description="To about an hour; null: it was never used."
    )


class MadeKey(Key):
    """A key that was just made, or given a new secret."""

    secret: str = Field(
        description="Send it as `Authorization: Bearer SECRET`. It is shown this once: only its "
        "hash is kept."
    )


class Me(ApiRecord):
    """Who asks, as the service sees it."""

    name: str | None = Field(description="Of the key that was shown; null where none is asked for.")
    grants: dict[str, Scope] = Field(description="What it may do, by map; `*` for all.")
    expires_at: datetime | None = Field(default=None, description="Null: it does not expire.")


class AuditLine(ApiRecord):
    """A change and who made it, or a request that was refused."""

    number: int = Field(description="Grows with each line, and may leave gaps.")
    at: datetime
    actor: str | None = Field(
        description="Name of the key; null where the service requires none; `command` for a "
        "command on the data folder."
    )
    address: str | None = Field(
        description="Where the request came from; behind a proxy, the proxy's."
    )
    tenant: str = Field(description="Of the key; empty where there is none.")
    action: str = Field(
        description="The kind of the change's event, such as `map.deleted`, or an action without "
        "an event, such as `job.cancelled`; `refused` for a request that was refused (401 or 403) "
        "and changed nothing."
    )
    map: str | None = Field(description="Name of the map that was changed.")
    target: str | None = Field(description="What was changed: the id or name.")
    request_id: str | None = Field(description="As in the log.")
    data: dict[str, Any] = Field(description="More, by action.")


# How a service does, and what it signs with, as JSON.


class Sizes(ApiRecord):
    """Disk space, bytes."""

    database: int | None = Field(
        description="With its log; null where it is no file. Of one map: its signatures."
    )
    blobs: int = Field(
        description="Uploads and what was made of them. Of many files some are measured, and the "
        "rest is taken to be like them. Of one map: of its frames, without archives and meshes."
    )
    index: int = Field(description="Search indexes of this machine; a cache.")
    free: int | None = Field(
        description="Left on the disk of the data folder; null where a map was asked for."
    )
    disk: int | None = Field(
        default=None,
        description="Size of the disk of the data folder, whoever uses it; null as `free`.",
    )


class IndexRecall(ApiRecord):
    """What a query without `exact` finds by an index, measured when the index was published."""

    share: float = Field(
        description="Share of the `near` nearest frames that such a query finds. 1 where it "
        "compares every frame."
    )
    near: int = Field(description="How many of the nearest frames were looked for.")
    sample: int = Field(
        description="Frames of the map that were looked up to measure it, each without itself; 0 "
        "where a query compares every frame, so that there is nothing to measure."
    )
    probes: int = Field(
        description="Frames that a query compares at least, of a large map: those whose sketches "
        "(a bit for each byte of a signature) are nearest to its own. 0 where it compares every "
        "frame."
    )
    frames: int = Field(
        description="Frames of the index that were there to be found when this was measured."
    )


class IndexState(ApiRecord):
    """How far the search index of a map is behind the map; queries read the rest themselves."""

    map: str
    generation: int | None = Field(
        description="Null: the map has none, and a query compares every frame. Small maps need "
        "none, and models that store psi have none."
    )
    tail: int = Field(
        description="Indexed frames that the generation lacks. Above the setting `tail_frames`, "
        "and not going down: see that workers run."
    )
    recall: IndexRecall | None = Field(
        default=None,
        description="Null where the map has no index: a query compares every frame.",
    )


class WorkerSeen(ApiRecord):
    """A process that signs frames, or does other jobs, at this moment."""

    name: str = Field(description="Its host and process id.")
    job_id: str | None = Field(description="What it is at.")


class Latency(ApiRecord):
    """Times within which so many of the answers came, seconds; right to a tenth."""

    p50: float
    p95: float
    p99: float


class Counted(ApiRecord):
    """What happened in some time."""

    received: int = Field(description="Frames stored, or queued once more.")
    indexed: int
    rejected: int = Field(description="In which nothing can be signed.")
    redundant: int
    failed: int
    deleted: int
    queries: dict[str, int] | None = Field(
        description="Queries by the status of their answer. Of the whole service alone: null where "
        "a map was asked for, as are the following."
    )
    latency: Latency | None = Field(description="Of queries that were answered; null: none were.")
    requests: int | None = Field(description="Requests under /v1, answered or refused.")
    refused: int | None = Field(description="Of these, with 4xx.")
    busy: int | None = Field(description="Of these, with 503: come back later.")
    broken: int | None = Field(description="Of these, with any other 5xx.")


class Minute(Counted):
    """What happened in one minute; requests count for the minute in which they were written
    down, up to ten seconds later.
    """

    at: datetime = Field(description="When it began.")


class MapUse(ApiRecord):
    """What a map has of what it may have; see Map."""

    frames: int = Field(description="That count for the quota.")
    bytes: int = Field(description="Of their uploads, as they were sent.")
    quota_frames: int | None = Field(description="Null: no quota.")
    quota_bytes: int | None = Field(description="Null: no quota.")
    retention_days: float | None = Field(description="Null: frames are kept.")


class ScrubSeen(ApiRecord):
    """How far stored bytes were read to see that they are sound."""

    began_at: datetime = Field(description="Of the pass that is under way, or else the last one.")
    finished_at: datetime | None = Field(
        description="When the last whole pass ended; null: there was none."
    )
    blobs: int = Field(description="Uploads and artifacts that this pass has read.")
    bytes: int = Field(description="Of these.")
    damaged: int = Field(
        description="Rows, signatures, uploads and artifacts that it found lost or damaged. Events "
        "`frame.damaged` name the frames of lost bytes, and `sceneprint fsck` all of them."
    )


class Stats(ApiRecord):
    """How the service, or one map, does now and did lately."""

    at: datetime
    counted_at: datetime | None = Field(
        default=None,
        description="When frames, ended jobs, indexes and bytes were counted. From 100,000 frames "
        "and jobs on they are counted for 1 % of the time.",
    )
    map: str | None = Field(description="Of which alone this tells; null: of all.")
    maps: int
    frames: dict[str, int] = Field(description="How many frames are in each state.")
    jobs: dict[str, int] = Field(description="How many jobs are in each state.")
    waiting: int = Field(description="Jobs that wait for a worker.")
    oldest_waiting_s: float | None = Field(
        description="Seconds since the job was queued that waits for longest; null: none waits."
    )
    indexes: list[IndexState] = Field(
        description="Of the maps that changed most; 200 at most, those with the longest tail first."
    )
    workers: list[WorkerSeen] | None = Field(
        description="On every host of a PostgreSQL database; of SQLite on this machine. Null where "
        "a map was asked for."
    )
    bytes: Sizes = Field(description="On the disk; measured at most twice a minute.")
    use: MapUse | None = Field(
        default=None, description="Against quota and retention; null where no map was asked for."
    )
    scrub: ScrubSeen | None = Field(
        default=None, description="Null where none has begun, or a map was asked for."
    )
    total: Counted = Field(description="All minutes together.")
    minutes: list[Minute] = Field(description="The oldest first; the last is not over yet.")


class ModelInfo(ApiRecord):
    """A model: all that decides what signatures look like."""

    model_id: str
    label: str = Field(description="Name and first digits of the id, as maps and answers tell it.")
    name: str
    preset: bool = Field(description="Whether it ships with this version.")
    components: int = Field(description="G, of the mixture.")
    levels: int = Field(description="Of the hierarchy of patches, that signatures are made of.")
    signature_bytes: int = Field(
        description="Of a stored signature: its length d, or 25 G H where psi itself is stored."
    )
    metric: Literal["l1", "l2"] = Field(
        description="Of distances: `l2`, squared, or `l1` where psi itself is stored."
    )
    unrelated_distance: float = Field(
        description="d0, median distance of unrelated frames: similarity = 1 - distance / d0."
    )
    parameters: dict[str, Any] = Field(description="The numbers of every stage.")
    provenance: dict[str, Any] = Field(description="What it was trained on and with.")
    maps: list[str] = Field(
        description="Those that you may read and that are signed with it, or are about to be."
    )


class NewModel(Given):
    """Which model a map is to be signed with from now on."""

    model: Label = Field(
        description="`depth`, `lidar`, `paper`, or the id or label of a model that GET "
        "/v1/models lists.",
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
    """How far a long job has come."""

    done: int = Field(description="Steps that are over: frames, members of an archive.")
    total: int | None = Field(default=None, description="Of so many, where that is known.")
    phase: ImportPhase | None = Field(
        default=None, description="What the import of a map does; null of other jobs, as below."
    )
    points: int | None = Field(default=None, description="Points that were read.")
    views: int | None = Field(default=None, description="Viewpoints that were chosen.")
    rendered: int | None = Field(default=None, description="Views that were rendered and added.")
    signed: int | None = Field(default=None, description="Views that were signed.")
    tested: int | None = Field(default=None, description="Other views that were looked up.")


class Product(ApiRecord):
    """What a job computes from a map, or from an answer."""

    #: What it is called, the end of the path that lists it, and the record that asks for it.
    noun: ClassVar[str]
    collection: ClassVar[str]
    request_type: ClassVar[type[Given]]

    job_id: str = Field(description="Also the id of its job: GET /v1/jobs/{job_id}.")
    map: str | None = Field(description="Null where frames of several maps may be in it.")
    state: JobState
    progress: Progress | None = Field(description="Null until it has begun.")
    error: str | None
    created_at: datetime
    finished_at: datetime | None


class Job(ApiRecord):
    """A piece of work in the queue."""

    job_id: str
    kind: str = Field(
        description="`sign`, `import`, `import-map`, `associate`, `coverage`, `difference`, "
        "`surface`, `reconstruct`, or `reencode`: that one signs an indexed frame once more, with "
        "the model to come or as what was made of it is damaged."
    )
    state: JobState
    map: str | None = Field(description="The map that it works on.")
    frame_id: str | None = Field(description="That it signs; null where it is of no single one.")
    priority: int = Field(description="Jobs of a greater one are done first.")
    attempts: int
    created_at: datetime
    started_at: datetime | None = Field(default=None, description="Of the latest try.")
    finished_at: datetime | None
    error: str | None
    traceback: str | None
    progress: Progress | None = Field(
        default=None, description="Of a long job, which is done in parts; null until it has begun."
    )
    result: dict[str, Any] | None = Field(
        default=None,
        description="What a long job came to, in short, when it has succeeded.",
    )
    followed_by: str | None = Field(
        default=None,
        description="The latest job of the same frame that does the same; null: it is this one. "
        "What was tried again is followed by the try.",
    )


class RefusedRetry(ApiRecord):
    """A dead job that cannot be tried again."""

    job_id: str
    reason: str


class RetriedJobs(ApiRecord):
    """What came of a page of dead jobs that were to be tried again."""

    retried: list[Job] = Field(description="The new ones.")
    refused: list[RefusedRetry]
    next_cursor: str | None = Field(description="Of the next page; null: there is none.")


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
    """Something that happened."""

    id: str = Field(
        description="Of no meaning but to be given back: as `Last-Event-ID` to a stream, as "
        "`after` to a request. Ids have no order; events are told in theirs."
    )
    at: datetime
    kind: str = Field(
        description="Such as frame.indexed; docs/operations.md lists all. A client may meet "
        "kinds that it does not know yet. `events.missed` stands where events that were asked for "
        "are no longer kept: look at the maps themselves, then go on."
    )
    map: str | None = Field(description="Name of the map that it is about.")
    frame_id: str | None
    job_id: str | None
    data: dict[str, Any] = Field(description="More, by kind.")


class EventPage(Page[Event]):
    """A part of the events that are kept."""

    newest: str = Field(
        description="Id of the newest event of your maps, of whatever kind, when this was asked; "
        "0 where there was none yet: what follows it is told by a stream with this as `after`."
    )
