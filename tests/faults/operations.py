"""The operations whose calls fail one after another, and the checks of a store afterwards."""

import io
import json
import tarfile
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import SecretStr
from sqlalchemy import select, update

from benchmarks.soak.recordings import recordings, walks
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.place import BundlePlace
from sceneprint.bundle.restoration import restore_to_folder, restore_to_server, verify_bundle
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.errors import BundleError, SceneprintError
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint.store.events import number_events
from sceneprint.store.tables import events, frames, jobs, signatures
from sceneprint_client.api import FrameState, JobState, NewMap, Query
from sceneprint_client.api.frames import ImportOptions
from tests.whole_engine import Engine

#: Frames of the map before an operation; others are uploaded or imported by it.
STORED = 4
#: Name of the map, and of the folder of bundles within the data folder.
MAP, BUNDLES = "hall", "bundles"
#: Suffix of the database that a restore fills.
RESTORED = "-restored"
#: Findings of `fsck` that a repair removes without loss: files that nothing refers to.
_LEFTOVERS = {"unreferenced-file"}

#: First words of lines by which an operation acknowledges; an id or a name follows.
ACKNOWLEDGED = ("added", "deleted", "bundle", "restored")


@dataclass(frozen=True)
class Store:
    """A store under test: its data folder, the URL of PostgreSQL if any, and frames to send."""

    folder: Path
    url: str | None
    uploads: Sequence[Upload]

    @property
    def settings(self):
        """The settings of a process that works on the store."""
        return Settings(
            data_dir=self.folder, database_url=None if self.url is None else SecretStr(self.url),
            index_dir=None, undo_window_s=0, unindexed_frames=1, decoders=0,
        )  # fmt: skip

    @property
    def restored(self):
        """The store that a restore of this one fills."""
        url = None if self.url is None else f"{self.url}{RESTORED}"
        return Store(self.folder / "restored", url, self.uploads)


def fill(store):
    with Engine(store.settings) as engine:
        engine.create_map(NewMap(name=MAP, model="depth"))
        for upload in store.uploads[:STORED]:
            engine.add_frame(MAP, upload.data, upload.meta)
        work_off(engine)
        engine.publish_due()


def work_off(engine):
    """Do all jobs, also those that wait for another attempt or for the end of a lease."""
    for _ in range(20):
        with engine.store.database.write() as connection:
            connection.execute(update(jobs).values(run_after=0.0))
            leased = jobs.c.leased_until.is_not(None)
            connection.execute(update(jobs).where(leased).values(leased_until=1.0))
        work = engine.claim("w")
        if work is None:
            return
        engine.run(work)
    raise AssertionError("the queue does not become empty")


def _nothing(engine, store):
    """Leave a store as it is."""


def _upload(engine, store, say):
    one = store.uploads[STORED]
    say(f"added {engine.add_frame(MAP, one.data, one.meta)[0].frame_id}")


def _wait_for_signature(engine, store):
    _upload(engine, store, lambda _: None)


def _sign(engine, store, say):
    work = engine.claim("w")
    engine.run(work)


def _publish(engine, store, say):
    engine.rebuild_index(MAP)


def _delete(engine, store, say):
    name = _first_frame(engine)
    engine.delete_frame(MAP, name)
    say(f"deleted {name}")


def _delete_first(engine, store):
    engine.delete_frame(MAP, _first_frame(engine))


def _first_frame(engine):
    with engine.store.database.read() as connection:
        query = select(frames.c.id).where(frames.c.state == FrameState.INDEXED)
        return str(connection.execute(query.order_by(frames.c.number)).scalars().first())


def _purge(engine, store, say):
    engine.purging.now()


def _back_up(engine, store, say):
    bundle = take_backup(store.settings, str(store.folder / BUNDLES))
    say(f"bundle {bundle.manifest.name}")


def _back_up_once(engine, store):
    _back_up(engine, store, lambda _: None)


def _restore(engine, store, say):
    place, new = str(store.folder / BUNDLES), store.restored
    if new.url is None:
        restored = restore_to_folder(place, new.folder)
    else:
        restored = restore_to_server(place, new.settings)
    say(f"restored {restored.manifest.name}")


def _import(engine, store, say):
    with engine.imports.receive(MAP, ImportOptions()) as receiver:
        receiver.write(_archive(store.uploads[STORED : STORED + 2]))
        archive = receiver.end()
    engine.imports.begin(MAP, archive, ImportOptions())
    while (work := engine.claim("w")) is not None:
        engine.run(work)


def _archive(uploads):
    packed, camera = io.BytesIO(), uploads[0].meta.intrinsics
    members = {
        "run/intrinsics.json": json.dumps(camera.model_dump(exclude={"distortion"})).encode()
    }
    members |= {f"run/{i}.png": upload.data for i, upload in enumerate(uploads)}
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return packed.getvalue()


#: What brings a store to the state before an operation, and what does it and says what it
#: acknowledges, see ACKNOWLEDGED.
OPERATIONS = {
    "upload": (_nothing, _upload),
    "signature": (_wait_for_signature, _sign),
    "publication": (_nothing, _publish),
    "deletion": (_nothing, _delete),
    "purge": (_delete_first, _purge),
    "import": (_nothing, _import),
    "backup": (_nothing, _back_up),
    "restore": (_back_up_once, _restore),
}


def small_uploads():
    with recordings(None, 1) as folder:
        shots = walks(folder, 1, STORED + 2)[0]
    return tuple(Upload(shot.png, shot.meta) for shot in shots)


def contents(store):
    """Return the upload and the signature of each frame by id."""
    with Engine(store.settings) as engine, engine.store.database.read() as connection:
        rows = connection.execute(
            select(frames.c.id, frames.c.blob, signatures.c.vector)
            .join(signatures, signatures.c.frame_number == frames.c.number)
        )  # fmt: skip
        return {row.id: (engine.store.blobs.get(row.blob), bytes(row.vector)) for row in rows}


def violations(store, operation, acknowledged, before):
    """Start again after a fault, finish what was begun, and yield each broken invariant."""
    said = dict(line.split(" ", 1) for line in acknowledged)
    with Engine(store.settings) as engine:
        work_off(engine)
        engine.publish_due()
        engine.purging.now()
        if operation in ("upload", "import"):  # a robot that got no answer sends it again
            OPERATIONS[operation][1](engine, store, lambda _: None)
            work_off(engine)
            engine.publish_due()
        yield from _wrong_frames(engine, operation, said, before)
        yield from _wrong_events(engine)
        gone = before.keys() - _states(engine).keys()
    yield from _remains(store, [part for name in gone for part in before[name]])
    yield from _wrong_bundles(store, operation, said)
    kinds = Counter(finding.kind for finding in fsck(store.settings, repair=True, grace_s=0))
    yield from (f"fsck: {kind}" for kind in kinds.keys() - _LEFTOVERS)
    yield from (f"not repaired: {finding.what}" for finding in fsck(store.settings, grace_s=0))


def _states(engine):
    return {frame.frame_id: frame.state for frame in engine.list_frames(MAP).items}


def _wrong_frames(engine, operation, said, before):
    states = _states(engine)
    most = len(before) + {"upload": 1, "signature": 1, "import": 2, "purge": -1}.get(operation, 0)
    least = most - (operation == "deletion")
    most -= "deleted" in said
    if not least <= len(states) <= most:
        yield f"{len(states)} frames, not {least} to {most}"
    if said.get("added", next(iter(states))) not in states:
        yield "an acknowledged frame is missing"
    if said.get("deleted") in states:
        yield "a deleted frame is there"
    yield from (f"frame {name} is {state}" for name, state in states.items() if state != "indexed")
    wanted = Query(k=50, candidates=50, keep=False, record=False, stages=["retrieve"])
    first = min(states)
    matches = engine.query_frame(MAP, first, wanted).matches
    if {first, *(match.frame_id for match in matches)} != states.keys():
        yield "a search does not find each frame"


def _wrong_events(engine):
    number_events(engine.store.database)
    with engine.store.database.read() as connection:
        counts = Counter(
            tuple(row) for row in connection.execute(select(events.c.kind, events.c.frame_id))
        )
        rows = list(connection.execute(select(frames.c.id, frames.c.state)))
        ended = connection.execute(select(jobs.c.kind, jobs.c.state))
        lost = [row for row in ended if row.state in (JobState.DEAD, JobState.FAILED)]
    yield from (f"a job {row.kind} is {row.state}" for row in lost)
    for name, state in rows:
        for kind in ("received", state):
            if counts["frame." + kind, name] != 1:
                yield f"frame {name} has {counts['frame.' + kind, name]} events {kind}"


def _remains(store, parts):
    for path in store.folder.rglob("*"):
        inside = path.is_file() and BUNDLES not in path.parts and "restored" not in path.parts
        data = path.read_bytes() if inside else b""
        if any(part in data for part in parts):
            yield f"{path.name} holds bytes of a deleted frame"


def _wrong_bundles(store, operation, said):
    if operation not in ("backup", "restore"):
        return
    place = str(store.folder / BUNDLES)
    names = []
    with suppress(SceneprintError):
        names = list(BundlePlace.open(place).names())
    if "bundle" in said and said["bundle"] not in names:
        yield "an acknowledged bundle is missing"
    for name in names:
        if verify_bundle(place, name).lost:
            yield f"bundle {name} lacks blobs"
    take_backup(store.settings, place)
    with suppress(BundleError):  # the store is restored
        _restore(None, store, lambda _: None)
        if "restored" in said:
            yield "an acknowledged restore is missing"
    if len(contents(store.restored)) != STORED:
        yield "the restored store lacks frames"
