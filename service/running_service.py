"""What the routes of one running service share: the concerns that they call, gates and figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Annotated, TypeVar, cast

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Request

from sceneprint.engine.admin.operations import Audit, Events
from sceneprint.engine.admin.statistics import Statistics
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.archive_import import Imports
from sceneprint.engine.ingest.uploads import Uploads
from sceneprint.engine.maps.map_copy import MapCopies
from sceneprint.engine.maps.map_frames import FrameFiles
from sceneprint.engine.maps.map_lifecycle import Catalogue
from sceneprint.engine.maps.map_surface import MapSurfaces
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.associations import Associations
from sceneprint.engine.products.map_coverage import Coverages
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.results.result_views import Inspection, PointClouds
from sceneprint.engine.search.query import Queries
from sceneprint.process import NOBODY, current_tenant
from sceneprint.store.keys import KeyRow, KeyUses, find_key
from service.event_stream import Feed
from service.limits import BodySpool, Gate, Holdings, RateLimits, SharedLooks, Turns, take_turn
from service.metrics import Metrics

T = TypeVar("T")

#: Uploads in progress at most, so that one wait for the disk is enough for all of them.
UPLOADS = 12
#: Threads that look keys up, beside those that all other work shares.
LOOKUPS = 4
#: Turns of requests that work in shared threads, such as lists: they compete for one interpreter,
#: so that one beside another tenant has one.
READS, READS_BESIDE = 8, 1
#: Maximum age of what `/readyz` says, seconds.
READY_S = 1.0


class Service:
    """The concerns of the engine by their names, and what bounds the work of requests.

    Parameters
    ----------
    context : that the concerns are built from
    metrics : of this process

    Attributes
    ----------
    gate : turns of queries and other computations
    upload_gate : turns of uploads and of edits of many frames, which wait for the disk and for
        other writers, so that no query waits behind them
    keys : whether callers must show a key
    feed : the stream of events
    limits : how often callers may send requests
    places : number of requests in progress, of which a tenant may have three quarters
    wait_s : seconds to wait for a turn
    requests : that tenants have in progress
    reads : turns of requests that work in shared threads
    spool : bodies that are kept on disk until they are read
    lookups : threads that look keys up
    looks : at the state of the service, shared by those who ask for it
    """

    def __init__(self, context: Context, metrics: Metrics) -> None:
        settings, store = context.settings, context.store
        self.context, self.metrics = context, metrics
        self.uploads, self.queries = Uploads(context), Queries(context)
        self.imports = Imports(context, self.uploads)
        self.inspection = Inspection(context)
        self.points = PointClouds(context, self.inspection.pairs)
        self.associations, self.differences = Associations(context), Differences(context)
        self.coverage = Coverages(context, self.queries)
        self.reconstructions = Reconstructions(context)
        self.surfaces = MapSurfaces(store, context.bell)
        self.outputs, self.copies = FrameFiles(store, context.signers), MapCopies(store)
        self.tombstones = Tombstones(store, settings.undo_window_s, context.bell.ring)
        self.audit = Audit(store, settings.audit_log_days)
        self.events, self.statistics = Events(store, settings), Statistics(context)
        self.catalogue, self.key_uses = Catalogue(store.database), KeyUses()

        self.wait_s = settings.queue_timeout_s
        self.gate = Gate(settings.concurrent_requests, settings.queued_requests, self.wait_s)
        # they mostly wait for the disk: the store bounds how many are decoded at once
        self.upload_gate = Gate(
            max(UPLOADS, settings.concurrent_requests), settings.queued_requests, self.wait_s,
            max(settings.concurrent_requests // 2, 1), rests=True,
        )  # fmt: skip
        self.keys = settings.asks_for_keys
        self.feed = Feed(store.database, settings.max_event_streams, settings.events_per_map)
        self.limits = RateLimits(settings.tenant_requests_per_s, settings.wrong_keys_per_minute)
        self.places = settings.concurrent_requests + settings.queued_requests
        self.requests, self.spool = Holdings(), BodySpool()
        self.reads = Turns(READS, READS_BESIDE, rests=True)
        self.lookups, self.looks = CapacityLimiter(LOOKUPS), SharedLooks(READY_S)

    def find_key(self, secret: str) -> KeyRow | None:
        """Return the key with a secret, also an expired one; None if there is none."""
        with self.context.store.database.read() as connection:
            found = find_key(connection, secret)
        if found is not None and (found.expires_at is None or found.expires_at > time.time()):
            self.key_uses.note(found)
        return found

    async def run(self, do: Callable[..., T], *given: object, patient: bool = False) -> T:
        """Do it in a shared thread, when it is the tenant's turn; not while a turn is held.

        Parameters
        ----------
        do, given : the work, and its arguments
        patient : wait for as long as it takes

        Raises
        ------
        Busy : its turn did not come in time; nothing was begun.
        """
        tenant = current_tenant()
        if tenant == NOBODY:  # nobody to share with
            return await to_thread.run_sync(do, *given)
        held = await take_turn(self.reads, tenant, None if patient else self.wait_s)
        try:
            return await to_thread.run_sync(do, *given)
        finally:
            self.reads.release(tenant, held)


async def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


Here = Annotated[Service, Depends(_service)]
