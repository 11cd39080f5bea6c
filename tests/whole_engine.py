"""All parts of the engine over one store, as in a process with service and worker."""

from contextlib import ExitStack

from sqlalchemy import select, update

from sceneprint.engine.admin import operations
from sceneprint.engine.admin.operations import Audit, Events
from sceneprint.engine.admin.statistics import Statistics
from sceneprint.engine.context import open_context
from sceneprint.engine.ingest.archive_import import Imports
from sceneprint.engine.ingest.uploads import Upload, Uploads
from sceneprint.engine.jobs import lifecycle
from sceneprint.engine.jobs.job_runner import JobRunner
from sceneprint.engine.jobs.tasks import queue_task
from sceneprint.engine.maps import map_lifecycle
from sceneprint.engine.maps.map_frames import FrameFiles, get_frame, list_frames
from sceneprint.engine.maps.map_lifecycle import Catalogue
from sceneprint.engine.maps.map_surface import MapSurfaces
from sceneprint.engine.maps.tombstones import Tombstones
from sceneprint.engine.products.associations import Associations
from sceneprint.engine.products.map_coverage import Coverages
from sceneprint.engine.products.reconstruction import Reconstructions
from sceneprint.engine.products.session_differences import Differences
from sceneprint.engine.results.result_views import Inspection, PointClouds
from sceneprint.engine.search.query import Queries
from sceneprint.engine.upkeep.housekeeping import Housekeeping
from sceneprint.engine.upkeep.purge import MemoryPurging
from sceneprint.store import maps as stored_maps
from sceneprint.store.events import number_events
from sceneprint.store.keys import find_key
from sceneprint.store.tables import events, jobs
from sceneprint_client.api import FrameName, Query
from sceneprint_client.api.listing import FrameListing


class Engine:
    """All parts of the engine by name, with short forms of common calls."""

    def __init__(self, settings, context=None):
        self._stack = ExitStack()
        if context is None:
            context = self._stack.enter_context(open_context(settings))
        self.context = context
        self.settings, self.store, self.bell = settings, context.store, context.bell
        self.signers, self.readers, self.indexes = context.signers, context.readers, context.indexes
        self.query_log = context.query_log
        self.uploads, self.queries = Uploads(context), Queries(context)
        self.imports = Imports(context, self.uploads)
        self.inspection = Inspection(context)
        self.points = PointClouds(context, self.inspection.pairs)
        self.outputs = FrameFiles(self.store, self.signers)
        self.surfaces = MapSurfaces(self.store, self.bell)
        self.associations, self.coverage = Associations(context), Coverages(context, self.queries)
        self.differences, self.reconstructions = Differences(context), Reconstructions(context)
        self.tombstones = Tombstones(self.store, settings.undo_window_s, self.bell.ring)
        self.audit = Audit(self.store, settings.audit_log_days)
        self.events, self.statistics = Events(self.store, settings), Statistics(context)
        self.catalogue = Catalogue(self.store.database)
        self.jobs, self.housekeeping = JobRunner(context), Housekeeping(context)
        self.purging, self.upkeep = self.housekeeping.purging, self.housekeeping.upkeep
        self.memory_purging = MemoryPurging(context)

    def close(self):
        self._stack.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def create_map(self, new):
        return map_lifecycle.create_map(self.store, new)

    def list_maps(self):
        return map_lifecycle.get_maps(self.store)

    def get_map(self, name):
        return map_lifecycle.get_map(self.store, name)

    def delete_map(self, name):
        map_lifecycle.delete_map(self.context, name)

    def reencode(self, name, model):
        return map_lifecycle.begin_reencoding(self.store, self.bell, name, model)

    def fetch(self, statement):
        """Return the result of a statement that reads the database."""
        with self.store.database.read() as connection:
            return connection.execute(statement).freeze()()

    def write(self, statement):
        with self.store.database.write() as connection:
            connection.execute(statement)

    def row(self, map_name):
        with self.store.database.read() as connection:
            return stored_maps.find_map(connection, map_name)

    def view(self, map_name):
        """Return a map with its model and its signatures."""
        row = self.row(map_name)
        model = self.signers(row.model_id).model
        with self.store.database.read() as connection:
            row = stored_maps.find_map(connection, map_name)
            return row, model, self.readers.view(connection, row)

    def rebuild_index(self, map_name):
        return self.upkeep.rebuild(self.row(map_name)).number

    def add_frame(self, map_name, data, meta, priority=0, if_novel=None):
        outcome, _ = self.uploads.add(map_name, Upload(data, meta, priority, if_novel))
        return outcome.accepted, outcome.new

    def list_frames(self, map_name, cursor=None, limit=100, state=None, wanted=None):
        wanted = wanted or FrameListing(state=state)
        return list_frames(self.store, map_name, wanted, cursor, limit)

    def get_frame(self, map_name, frame_id):
        return get_frame(self.store, map_name, frame_id)

    def add(self, upload, map_name="hall", **more):
        """Add an upload of the tests; returns what was accepted, and whether it is new."""
        return self.add_frame(map_name, upload.data, upload.meta, **more)

    def ids(self, map_name="hall"):
        """Return the ids of the frames of a map in order of arrival."""
        return [frame.frame_id for frame in self.list_frames(map_name).items]

    def delete_frame(self, map_name, frame_id):
        self.tombstones.delete_frame(map_name, frame_id)

    def ask(self, upload, query=None, maps=("hall",), meta=None):
        """Query maps with an upload of the tests."""
        return self.queries.upload(list(maps), upload.data, meta or upload.meta, query or Query())

    def query_frame(self, map_name, frame_id, query, **more):
        frame = FrameName(map=map_name, frame_id=frame_id)
        return self.queries.stored([map_name], frame, query, **more)

    def create_key(self, name, grants=None, **more):
        return operations.create_key(self.store, name, grants, **more)

    def find_key(self, secret):
        with self.store.database.read() as connection:
            return find_key(connection, secret)

    def revoke_key(self, name):
        operations.revoke_key(self.store, name)

    def get_job(self, job_id):
        return lifecycle.get_job(self.store, job_id)

    def retry_job(self, job_id):
        return lifecycle.retry(self.store, self.bell, job_id)

    def retry_dead_jobs(self, *page, **more):
        return lifecycle.retry_dead(self.store, self.bell, *page, **more)

    def begin_task(self, kind, map_name, data, *more):
        return queue_task(self.store, self.bell, kind, map_name, data, *more)

    def handle(self, kind, handler):
        """Run jobs of a kind in this process."""
        self.jobs.handlers[kind] = handler

    def claim(self, worker):
        return self.jobs.claim(worker)

    def run(self, work, broke=None):
        return self.jobs.run(work, broke)

    def work_off(self):
        """Run all due jobs and return their states."""
        states = []
        while (work := self.claim("w")) is not None:
            states.append(self.run(work))
        return states

    def make_due(self):
        """Make all jobs due, by ending leases and delays."""
        self.write(update(jobs).values(run_after=0.0))
        self.write(update(jobs).where(jobs.c.leased_until.is_not(None)).values(leased_until=1.0))

    def event_kinds(self):
        """Return the kinds of all events in order."""
        number_events(self.store.database)
        return list(self.fetch(select(events.c.kind).order_by(events.c.number)).scalars())

    def put_back(self, work):
        self.jobs.put_back(work)

    def publish_due(self):
        return self.housekeeping.run()
