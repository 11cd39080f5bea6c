"""Routes for jobs and events."""

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
from service.auth import (
    Caller,
    Cursor,
    Limit,
    OnlyMap,
    Sender,
    hold_read,
    page_response,
    release_place,
    v1_router,
)
from service.event_stream import BEGIN, MEDIA_TYPE, EventStream, Feed, alive, message
from service.problems import refusals
from service.running_service import Here, Service

router = v1_router("/jobs", "jobs")

#: Maximum number of dead jobs to retry per request; each retry is a commit.
MOST_RETRIED = 200


@router.get("", responses=refusals(404, 422))
def list_jobs(
    here: Here,
    caller: Sender,
    state: JobState | None = None,
    kind: Annotated[
        str | None, Query(max_length=16, description="Only jobs of this kind, such as `associate`.")
    ] = None,
    map_name: OnlyMap = None,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> Page[Job]:
    """List the jobs of all maps that the key may read, newest first.

    `state=dead` lists jobs that failed repeatedly.
    """
    names = caller.named
    if map_name is not None:
        caller.require(map_name, "read")
        get_map(here.context.store, map_name)
        names = (map_name,)
    elif names is None and not caller.may("admin"):
        names = tuple(record.name for record in get_maps(here.context.store))
    return lifecycle.list_jobs(here.context.store, state, cursor, limit, kind, names)


@router.post("/retry", responses=refusals(404, 422))
def retry_dead_jobs(
    here: Here,
    caller: Sender,
    map_name: OnlyMap = None,
    cursor: Cursor = None,
    limit: Annotated[
        int, Query(ge=1, le=MOST_RETRIED, description="Number of jobs in one page.")
    ] = 100,
) -> RetriedJobs:
    """Retry a page of the dead jobs. Jobs that were already retried are skipped.

    Without `map`, this requires `write` for `*`. Jobs that belong to no map are skipped unless the
    key has `admin` for `*`.
    """
    if map_name is not None:
        caller.require(map_name, "write")
        get_map(here.context.store, map_name)
        names: tuple[str, ...] | None = (map_name,)
    else:
        caller.require_every("write")
        every = None if caller.may("admin") else get_maps(here.context.store)
        names = None if every is None else tuple(record.name for record in every)
    return lifecycle.retry_dead(here.context.store, here.context.bell, cursor, limit, names)


@router.get("/{job_id}", responses=refusals(404))
def get_job(job_id: str, here: Here, caller: Sender) -> Job:
    """Return a job and its state."""
    return caller.require_job(lifecycle.get_job(here.context.store, job_id))


@router.post("/{job_id}/cancel", responses=refusals(404, 409))
def cancel_job(job_id: str, here: Here, caller: Sender) -> Job:
    """Cancel an unfinished job; its frame becomes `failed`. A second request changes nothing."""
    caller.require_job(lifecycle.get_job(here.context.store, job_id), "write")
    return lifecycle.cancel(here.context.store, job_id)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    responses={
        200: {"model": Job, "description": "This job is already retrying the frame."},
        **refusals(404, 409),
    },
)
def retry_job(job_id: str, here: Here, caller: Sender, response: Response) -> Job:
    """Retry a dead, cancelled or failed job. For a frame, a new job is created; a long job
    continues from its last progress under its own id.
    """
    caller.require_job(lifecycle.get_job(here.context.store, job_id), "write")
    job, is_new = lifecycle.retry(here.context.store, here.context.bell, job_id)
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    response.status_code = 202 if is_new else 200
    return job


# Events, as a live stream or as pages of stored events.

events_router = v1_router("/events", "operations")

_STREAM = {
    "description": "A page of events; or, if `Accept` contains text/event-stream, an endless "
    "stream whose messages have the `id` of the event and the event as JSON in `data`. The stream "
    "sends a comment every 3 s.",
    "model": EventPage,
    "content": {MEDIA_TYPE: {"schema": {"type": "string"}}},
}


@events_router.get("", response_model=EventPage, responses={200: _STREAM, **refusals(404, 422)})
async def events(
    request: Request,
    here: Here,
    caller: Sender,
    map_name: OnlyMap = None,
    kind: Annotated[
        list[str],
        Query(
            max_length=MOST_KINDS,
            description="Only kinds with this prefix, such as `frame.` or `frame.indexed`. Repeat "
            "the parameter for several prefixes.",
        ),
    ] = [],  # noqa: B006  (FastAPI copies it)
    after: Annotated[
        str | None,
        Query(
            max_length=64,
            description="Only events after the event with this id; `0` returns all stored events. "
            "By default, a stream has only new events.",
        ),
    ] = None,
    order: Annotated[
        Literal["newest", "oldest"] | None,
        Query(description="Order of a page; default: `oldest` with `after`, otherwise `newest`."),
    ] = None,
    cursor: Cursor = None,
    limit: Annotated[int, Query(ge=1, le=1000, description="Number of events in a page.")] = 100,
    last_event_id: Annotated[
        str | None,
        Header(description="Id of the last received event; the stream continues after this event. "
        "The header overrides `after`."),
    ] = None,
) -> Response:  # fmt: skip
    """List events, such as the upload, indexing and deletion of frames and the creation and
    deletion of maps.

    With `Accept: text/event-stream`, events arrive within half a second, each once and in order,
    even if several processes use the store. After a lost connection, send the id of the last event
    as `Last-Event-ID`, as browsers do automatically, to receive all events since that event. If
    some of them have expired, the stream sends an `events.missed` event.

    The list contains events of the maps that the key may read. Events that belong to no map require
    `admin` for `*`.
    """
    seals, place = here.context.store.seals, "after" if last_event_id is None else "Last-Event-ID"
    last = after if last_event_id is None else last_event_id

    def read_filter() -> tuple[EventFilter, int | None]:
        seals.row("event", cursor)  # validate the cursor, although a stream has no pages
        criteria = _filter(here, caller, map_name, kind)
        return criteria, None if last is None else seals.event(last, place)

    criteria, number = await here.run(read_filter)
    if MEDIA_TYPE in request.headers.get("accept", ""):
        here.feed.join(caller.tenant)
        release_place(request)
        has_access = _access_check(request, here, caller)
        messages = _messages(here.feed, seals, criteria, number, has_access)
        return EventStream(messages, partial(here.feed.leave, caller.tenant))
    await hold_read(request, here, caller.tenant)
    newest_first = order == "newest" or (order is None and last is None)

    def page() -> Response:
        return page_response(
            here.events.page(
                criteria, after=last, cursor=cursor, limit=limit, newest_first=newest_first
            )
        )

    return await to_thread.run_sync(page)


def _filter(here: Service, caller: Caller, map_name: str | None, kinds: list[str]) -> EventFilter:
    if map_name is not None:
        caller.require(map_name, "read")
    criteria = here.events.wanted(map_name, kinds)
    if not caller.reads_every:
        criteria = replace(criteria, since=caller.created_at)
    if map_name is not None or caller.may("admin"):
        return criteria
    if caller.named is not None:
        return replace(criteria, maps=frozenset(caller.named))
    return replace(criteria, of_maps=True)


def _access_check(request: Request, here: Service, caller: Caller) -> Callable[[], bool]:
    """Return a function that checks that the key is still valid and has the same grants."""
    secret = request.headers.get("authorization", "").partition(" ")[2].strip()

    def has_access() -> bool:
        if not caller.name:
            return True
        key = here.find_key(secret)
        lasts = key is not None and (key.expires_at is None or key.expires_at > time.time())
        return key is not None and lasts and dict(key.grants) == dict(caller.grants)

    return has_access


async def _messages(
    feed: Feed, seals: OpaqueIds, criteria: EventFilter, after: int | None,
    has_access: Callable[[], bool],
) -> AsyncGenerator[bytes, None]:  # fmt: skip
    yield BEGIN
    async with aclosing(feed.batches(criteria, after, has_access)) as batches:
        async for rows, last in batches:
            messages = [message(event_record(seals, row)) for row in rows]
            yield b"".join(messages) if rows else alive(seals.seal("event", last))
