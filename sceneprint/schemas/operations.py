"""How a service does, and what it signs with, as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import Field

from sceneprint.geometry.retrieval import Metric
from sceneprint.schemas.base import Given, Label, Told


class Sizes(Told):
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


class IndexRecall(Told):
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
        description="Inverted lists that a query compares, of a very large map; 0 where it "
        "compares every frame."
    )
    frames: int = Field(
        description="Frames that the index had when this was measured: it is measured anew when "
        "they have changed by a tenth."
    )


class IndexState(Told):
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


class WorkerSeen(Told):
    """A process that signs frames, or does other jobs, at this moment."""

    name: str = Field(description="Its host and process id.")
    job_id: str | None = Field(description="What it is at.")


class ReplicaSeen(Told):
    """The read replica, as the process that answers sees it."""

    used: bool = Field(description="Whether queries are answered from it; its log says why not.")
    behind_s: float | None = Field(
        description="What was stored or deleted so many seconds ago, or earlier, is in it; null: "
        "not known."
    )


class Latency(Told):
    """Times within which so many of the answers came, seconds; right to a tenth."""

    p50: float
    p95: float
    p99: float


class Counted(Told):
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


class MapUse(Told):
    """What a map has of what it may have; see Map."""

    frames: int = Field(description="That count for the quota.")
    bytes: int = Field(description="Of their uploads, as they were sent.")
    quota_frames: int | None = Field(description="Null: no quota.")
    quota_bytes: int | None = Field(description="Null: no quota.")
    retention_days: float | None = Field(description="Null: frames are kept.")


class Stats(Told):
    """How the service, or one map, does now and did lately."""

    at: datetime
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
    replica: ReplicaSeen | None = Field(
        default=None,
        description="Null where there is none, or a map was asked for.",
    )
    total: Counted = Field(description="All minutes together.")
    minutes: list[Minute] = Field(description="The oldest first; the last is not over yet.")


class ModelInfo(Told):
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
    metric: Metric = Field(
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
