"""Housekeeping of workers between jobs: indexes, model switches, and removal of old data."""

from __future__ import annotations

from sceneprint.engine.admin.operations import Audit, Events
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.archive_import import Imports
from sceneprint.engine.ingest.uploads import Uploads
from sceneprint.engine.maps.map_lifecycle import Reencodings
from sceneprint.engine.maps.map_surface import SurfaceUpkeep
from sceneprint.engine.products.join_upkeep import JoinUpkeep
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.engine.upkeep.purge import Purging, Retention
from sceneprint.store.events import number_events


class Housekeeping:
    """Housekeeping tasks; several processes may run them at the same time."""

    def __init__(self, context: Context) -> None:
        settings, store, bell = context.settings, context.store, context.bell
        self._context = context
        self.upkeep = Upkeep(context)
        self.reencodings = Reencodings(store, self.upkeep)
        self.retention = Retention(store, settings.deleted_rows_days)
        self.events = Events(store, settings)
        self.audit = Audit(store, settings.audit_log_days)
        self.imports = Imports(context, Uploads(context))
        self.surfaces = SurfaceUpkeep(store, bell, auto=settings.build_surfaces == "auto")
        self.joins = JoinUpkeep(store, bell, auto=settings.join_sessions == "auto")
        self.purging = Purging(context, self.upkeep)

    def run(self) -> int:
        """Run the tasks that are due; return the number of published indexes."""
        store = self._context.store
        number_events(store.database)  # including events that nobody has read
        self.reencodings.run()
        self.retention.run()
        published = self.upkeep.run()
        self.events.tidy()
        self.audit.tidy()
        self._context.query_log.tidy()
        self.imports.tidy()
        self.surfaces.run()
        self.joins.run()
        if self.purging.run() is not None:
            with store.database.read() as connection:
                self._context.readers.purge(connection)
        return published
