"""Jobs."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

from anyio import to_thread
from fastapi import Header, Query, Request, Response

from sceneprint.engine.admin.operations import MOST_KINDS, event_record
from sceneprint.engine.jobs import lifecycle
from sceneprint.engine.maps.map_lifecycle import get_map, get_maps
from sceneprint.store.events import EventFilter
from sceneprint.store.opaque_ids import OpaqueIds
from sceneprint_client.api import Job, JobState, Page
from sceneprint_client.api.admin import EventPage, RetriedJobs
from service.auth import Asking, Caller, hold_read, page_response, release_place, v1_router
from service.event_stream import BEGIN, MEDIA_TYPE, EventStream, Feed, alive, message
from service.problems import declared
from service.running_service import Here, Service

router = v1_router("/jobs", "jobs")

#: Dead jobs that one request looks at: each that is tried again is a commit.
MOST_RETRIED = 200


@router.get("", responses=declared(404, 422))
def list_jobs(
    here: Here,
    asking: Asking,
    state: JobState | None = None,
    kind: Annotated[str | None, Query(max_length=16, description="Such as `associate`.")] = None,
    map_name: Annotated[str | None, Query(alias="map", description="Of this map alone.")] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Job]:
    """Jobs of all maps, the newest first; `state=dead` lists what broke down again and again.

    With a key, those of the maps that it may read.
    """
    names = asking.named
    if map_name is not None:
        asking.require(map_name, "read")
        get_map(here.context.store, map_name)
        names = (map_name,)
    elif names is None and not asking.may("admin"):
        names = tuple(one.name for one in get_maps(here.context.store))
    return lifecycle.list_jobs(here.context.store, state, cursor, limit, kind, names)


@router.post("/retry", responses=declared(404, 422))
def retry_dead_jobs(
    here: Here,
    asking: Asking,
    map_name: Annotated[str | None, Query(alias="map", description="Of this map alone.")] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=MOST_RETRIED, description="Jobs looked at.")] = 100,
) -> RetriedJobs:
    """Try again all dead jobs, a page of them at a time; those that were tried since stay.

    Without `map` the key must write to all maps; jobs of no map are for admins.
    """
    if map_name is not None:
        asking.require(map_name, "write")
        get_map(here.context.store, map_name)
        names: tuple[str, ...] | None = (map_name,)
    else:
        asking.require_every("write")
        every = None if asking.may("admin") else get_maps(here.context.store)
        names = None if every is None else tuple(one.name for one in every)
    return lifecycle.retry_dead(here.context.store, here.context.bell, cursor, limit, names)


@router.get("/{job_id}", responses=declared(404))
def get_job(job_id: str, here: Here, asking: Asking) -> Job:
    """What has become of a job."""
    return asking.require_job(lifecycle.get_job(here.context.store, job_id))


@router.post("/{job_id}/cancel", responses=declared(404, 409))
def cancel_job(job_id: str, here: Here, asking: Asking) -> Job:
    """Give up a job that is not over; its frame is `failed` then. Asked twice, it stays so."""
    asking.require_job(lifecycle.get_job(here.context.store, job_id), "write")
    return lifecycle.cancel(here.context.store, job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    responses={
        200: {"model": Job, "description": "Its frame is being tried again already, by this job."},
        **declared(404, 409),
    },
)
def retry_job(job_id: str, here: Here, asking: Asking, response: Response) -> Job:
    """Try again what was given up (dead, cancelled or failed): a frame in a new job, a long job
    as itself, from where it stood.
    """
    asking.require_job(lifecycle.get_job(here.context.store, job_id), "write")
    job, is_new = lifecycle.retry(here.context.store, here.context.bell, job_id)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    response.status_code = 202 if is_new else 200
    return job


# Events: as a stream while they happen, or as pages of those that are kept.

events_router = v1_router("/events", "operations")

_STREAM = {
    "description": "A page of events; or, where `Accept` names text/event-stream, a stream that "
    "goes on: each message has the event's `id` and the event as JSON in `data`. "
    "A comment comes every 3 s.",
    "model": EventPage,
    "content": {MEDIA_TYPE: {"schema": {"type": "string"}}},
}


@events_router.get("", response_model=EventPage, responses={200: _STREAM, **declared(404, 422)})
async def events(
    request: Request,
    here: Here,
    asking: Asking,
    map_name: Annotated[str | None, Query(alias="map", description="Of this map alone.")] = None,
    kind: Annotated[
        list[str],
        Query(
            max_length=MOST_KINDS,
            description="Beginning of the kinds that are wanted, such as `frame.` or "
            "`frame.indexed`; more than once for several.",
        ),
    ] = [],  # noqa: B006  (FastAPI copies it)
    after: Annotated[
        str | None,
        Query(
            max_length=64,
            description="Only events that followed the one of this id; `0`: all that are kept. "
            "Without it a stream begins with what happens from now on.",
        ),
    ] = None,
    order: Annotated[
        Literal["newest", "oldest"] | None,
        Query(description="Of a page: which come first; the oldest where `after` is given."),
    ] = None,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000, description="Of a page.")] = 100,
    last_event_id: Annotated[
        str | None,
        Header(description="Of the last event that came: a stream goes on there. Goes before "
               "`after`."),
    ] = None,
) -> Response:  # fmt: skip
    """What happened: frames that came, were indexed or deleted, maps made and removed.

    With `Accept: text/event-stream` the events come as they happen, half a second late at most,
    each once and in order, also where several processes work on the store. Who lost the stream
    sends the id of the last event as `Last-Event-ID`, as browsers do by themselves, and
    misses nothing. Where what is asked for is no longer kept, an event `events.missed` says so.

    With a key, events of the maps that it may read; those of no map are for admins of all.
    """
    seals, place = here.context.store.seals, "after" if last_event_id is None else "Last-Event-ID"
    last = after if last_event_id is None else last_event_id

    def asked() -> tuple[EventFilter, int | None]:
        seals.row("event", cursor)  # a stream has no pages; what is wrong is told all the same
        wanted = _wanted(here, asking, map_name, kind)
        return wanted, None if last is None else seals.event(last, place)

    wanted, number = await here.run(asked)
    if MEDIA_TYPE in request.headers.get("accept", ""):
        here.feed.join(asking.tenant)
        release_place(request)
        told = _told(here.feed, seals, wanted, number, _still(request, here, asking))
        return EventStream(told, partial(here.feed.leave, asking.tenant))
    await hold_read(request, here, asking.tenant)
    newest_first = order == "newest" or (order is None and last is None)

    def page() -> Response:
        return page_response(
            here.events.page(
                wanted, after=last, cursor=cursor, limit=limit, newest_first=newest_first
            )
        )

    return await to_thread.run_sync(page)


def _wanted(here: Service, asking: Caller, map_name: str | None, kinds: list[str]) -> EventFilter:
    if map_name is not None:
        asking.require(map_name, "read")
    wanted = here.events.wanted(map_name, kinds)
    if not asking.reads_every:
        wanted = replace(wanted, since=asking.created_at)
    if map_name is not None or asking.may("admin"):
        return wanted
    if asking.named is not None:
        return replace(wanted, maps=frozenset(asking.named))
    return replace(wanted, of_maps=True)


def _still(request: Request, here: Service, asking: Caller) -> Callable[[], bool]:
    """Asks whether the key that was shown still opens what it did."""
    secret = request.headers.get("authorization", "").partition(" ")[2].strip()

    def ask() -> bool:
        if not asking.name:
            return True  # none was asked for
        key = here.find_key(secret)
        lasts = key is not None and (key.expires_at is None or key.expires_at > time.time())
        return key is not None and lasts and dict(key.grants) == dict(asking.grants)

    return ask


async def _told(
    feed: Feed, seals: OpaqueIds, wanted: EventFilter, after: int | None, still: Callable[[], bool]
) -> AsyncGenerator[bytes, None]:
    yield BEGIN
    async with aclosing(feed.batches(wanted, after, still)) as batches:
        async for found, seen in batches:
            messages = [message(event_record(seals, one)) for one in found]
            yield b"".join(messages) if found else alive(seals.seal("event", seen))
