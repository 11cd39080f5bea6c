"""The shared state of all routes of a running service: parts of the engine, gates and metrics."""

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
from service.limits import BodySpool, Gate, Holdings, SharedChecks, TokenBucket, Turns, take_turn
from service.metrics import Metrics

T = TypeVar("T")

#: Maximum number of uploads in progress, which share commits.
UPLOADS = 12
#: Number of separate threads that look up keys.
LOOKUPS = 4
#: Maximum number of concurrent requests in shared threads, such as lists, of all tenants, and of
#: one tenant while others wait; and pause of a tenant after a turn (see TurnOrder).
READS, READS_BESIDE, READS_REST = 8, 1, 2.0
#: Maximum age of the result of `/readyz`, seconds.
READY_S = 1.0


class Service:
    """Parts of the engine by name, and limits on the work of requests.

    Parameters
    ----------
    context : context that the parts of the engine are built from
    metrics : metrics of this process

    Attributes
    ----------
    gate : limit of concurrent queries and other computations
    upload_gate : limit of concurrent uploads and edits of many frames, which mostly wait for the
        disk and for other writers
    keys : whether requests need a key
    feed : stream of events
    request_rate, wrong_keys : rate limits of requests by tenant, and of wrong keys by address
    places : maximum number of requests in progress, of which a tenant may have three quarters
    wait_s : maximum wait for a turn, seconds
    requests : number of requests in progress by tenant
    reads : turns of requests in shared threads
    spool : spooled bytes by tenant
    lookups : threads that look up keys
    checks : results of state checks that concurrent requests share
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
        self.outputs = FrameFiles(store, context.signers)
        self.tombstones = Tombstones(store, settings.undo_window_s, context.bell.ring)
        self.audit = Audit(store, settings.audit_log_days)
        self.events, self.statistics = Events(store, settings), Statistics(context)
        self.catalogue, self.key_uses = Catalogue(store.database), KeyUses()

        self.wait_s = settings.queue_timeout_s
        self.gate = Gate(
            settings.concurrent_requests, settings.queued_requests, self.wait_s, rest=1.0
        )
        # Uploads mostly wait for the disk; the store limits concurrent decoding.
        self.upload_gate = Gate(
            max(UPLOADS, settings.concurrent_requests), settings.queued_requests, self.wait_s,
            max(settings.concurrent_requests // 2, 1), rest=1.0,
        )  # fmt: skip
        self.keys = settings.asks_for_keys
        self.feed = Feed(store.database, settings.max_event_streams, settings.events_per_map)
        rate, wrong = settings.tenant_requests_per_s, settings.wrong_keys_per_minute
        self.request_rate = TokenBucket("requests", rate, 5 * rate)
        self.wrong_keys = TokenBucket("wrong keys", wrong / 60, wrong)
        self.places = settings.concurrent_requests + settings.queued_requests
        self.requests, self.spool = Holdings(), BodySpool()
        self.reads = Turns(READS, READS_BESIDE, rest=READS_REST)
        self.lookups, self.checks = CapacityLimiter(LOOKUPS), SharedChecks(READY_S)

    def find_key(self, secret: str) -> KeyRow | None:
        """Return the key of a secret, even if it has expired; None for an unknown secret."""
        with self.context.store.database.read() as connection:
            row = find_key(connection, secret)
        if row is not None and (row.expires_at is None or row.expires_at > time.time()):
            self.key_uses.note(row)
        return row

    async def run(self, do: Callable[..., T], *arguments: object, patient: bool = False) -> T:
        """Return the result of a function, run in a shared thread after a wait for a turn. Do not
        call this during another turn.

        Parameters
        ----------
        do, arguments : function and its arguments
        patient : whether to wait without a limit

        Raises
        ------
        Busy : If no turn becomes free in time; the function was not called.
        """
        tenant = current_tenant()
        if tenant == NOBODY:
            return await to_thread.run_sync(do, *arguments)
        held = await take_turn(self.reads, tenant, None if patient else self.wait_s)
        try:
            return await to_thread.run_sync(do, *arguments)
        finally:
            self.reads.release(tenant, held)


async def _service(request: Request) -> Service:
    return cast(Service, request.app.state.service)


Here = Annotated[Service, Depends(_service)]
