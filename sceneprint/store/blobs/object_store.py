"""Blobs in an object store that a fleet shares.

    PREFIX/blobs/ab/abcdef...   a blob under its digest
    PREFIX/sceneprint.json      the database they belong to

A blob is put in one step, or in parts that are not there before the last: what was not
acknowledged leaves nothing behind that could be read. It is put also where one is there, which may
be damaged, or about to be removed.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from sceneprint.atomic_files import make_folder, sync_folder
from sceneprint.errors import DamagedBlob, UnusableStore
from sceneprint.store.blobs.folder import (
    DIGEST,
    MARK,
    REMOVAL_S,
    TURN_S,
    BlobEntry,
    Blobs,
    Condition,
    IncomingBlob,
    Locks,
    require_digest,
)
from sceneprint.store.blobs.object_client import Objects, open_objects
from sceneprint.store.database_errors import unusable

# Whose a prefix of an object store is, or the folder of a fleet: two databases on one would sweep
# each other's blobs.
#
#     PREFIX/sceneprint.json   {"store": its name, "restoring": while one is restored there}
#
# The name goes with the database's secret, so a restored store has that of the one that was backed
# up: a restore therefore takes no prefix that is in use, even one of the same name.


class BucketOwner:
    """The mark of a prefix.

    Every method raises UnusableStore where the prefix is another's, or cannot be used.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    @classmethod
    def of_folder(cls, folder: Path) -> BucketOwner:
        """The mark of a folder of blobs."""
        return cls(open_objects(f"file://{quote(str(folder.absolute()))}"))

    def claim(self, owner: str, *, anew: bool) -> bool:
        """See that the prefix is a store's; whether it is marked so now.

        Parameters
        ----------
        owner : the store
        anew : mark it where it is nobody's yet
        """
        for _ in range(2):  # another process may be the first
            found = self._found()
            if found is None:
                if not anew:
                    return False
                if self._put(owner, create=True):
                    return True
                continue
            if found.get("store") != owner:
                raise self._of_another("another database")
            return True
        return False

    def begin(self, owner: str, before: str) -> None:
        """Take the prefix for a store that is to be restored there.

        Parameters
        ----------
        owner : the store
        before : name of the empty database that it is restored to: what a service has marked so,
            and never used, is free
        """
        found = self._found()
        free = found is not None and before != owner and found.get("store") == before
        if found is None or free:
            if not self._put(owner, create=found is None, restoring=True):
                raise self._of_another("another database")  # at the same time
        elif found.get("store") != owner:
            raise self._of_another("another database")
        elif found.get("restoring") is not True:
            raise self._of_another("the store that the snapshot was taken of, or its copy")

    def end(self, owner: str) -> None:
        """Say that it is restored."""
        self._put(owner)

    def _found(self) -> dict[str, Any] | None:
        """What is there; None where nothing is."""
        try:
            found = json.loads(self._objects.get(MARK))
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _put(self, owner: str, *, create: bool = False, restoring: bool = False) -> bool:
        record = {"kind": "sceneprint blobs", "store": owner}
        more = {"restoring": True} if restoring else {}
        return self._objects.put(MARK, json.dumps(record | more).encode(), create=create)

    def _of_another(self, whose: str) -> UnusableStore:
        return UnusableStore(
            f"{self._objects.url}: the blobs there are of {whose}, which would lose them to this "
            "one. Give each database a prefix of its own in SCENEPRINT_BLOB_URL. If that database "
            f"is gone for good, remove {MARK} there."
        )


#: Under the prefix: the blobs.
FOLDER = "blobs/"
#: Blobs that this process has put last, of which it knows whether any can have been removed since.
_KNOWN = 4_096
#: Seconds for which `check` tells what it found last.
CHECK_S = 2.0


class ObjectBlobs(Blobs):
    """Blobs under the prefix of an object store.

    Parameters
    ----------
    objects : of the prefix
    locks : of all that share it
    owner : tells what the store is called that they belong to
    """

    def __init__(self, objects: Objects, locks: Locks, owner: Callable[[], str]) -> None:
        super().__init__(locks)
        self.objects = objects
        self._owner = owner
        self._claimed = False
        self._put: OrderedDict[str, int] = OrderedDict()  # removals until then, by digest
        self._lock = threading.Lock()
        self._asking = threading.Lock()  # for `check`, and what it found when
        self._wrong: UnusableStore | None = None
        self._answered = -math.inf

    def claim(self, *, anew: bool = True) -> None:
        """See that the prefix is this store's, and mark it where it is nobody's yet.

        Raises
        ------
        UnusableStore : it is another's, or the object store cannot be used.
        """
        if not self._claimed:
            self._claimed = BucketOwner(self.objects).claim(self._owner(), anew=anew)

    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns the store has acknowledged them. See `Blobs.put`."""
        digest = hashlib.sha256(data).hexdigest()
        with self._putting(digest):
            self.objects.put(_key(digest), data)
        return digest

    @contextmanager
    def incoming(self) -> Iterator[IncomingBlob]:
        """Take a blob in parts; see `Blobs.incoming`.

        It waits in the folder of temporary files, without a name, until its digest is known:
        stores do not copy what is larger than 5 GB from one key to another in one step.
        """
        place = tempfile.gettempdir()
        what = f"{place}: a blob cannot be written"
        with ExitStack() as stack:
            try:
                file = stack.enter_context(tempfile.TemporaryFile())
            except OSError as error:
                raise unusable(what, error) from error
            yield IncomingBlob(file, what, lambda digest: self._keep(file, digest))

    def _keep(self, file: BinaryIO, digest: str) -> None:
        file.flush()
        file.seek(0)
        with self._putting(digest):
            self.objects.put_file(_key(digest), file)

    @contextmanager
    def _putting(self, digest: str) -> Iterator[None]:
        self.claim()
        before = self._locks.removals()
        yield
        with self._lock:
            self._put.pop(digest, None)
            if before is not None:
                self._put[digest] = before
            if len(self._put) > _KNOWN:
                self._put.popitem(last=False)

    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it; see `Blobs.get`."""
        require_digest(digest)
        try:
            data = self.objects.get(_key(digest))
        except FileNotFoundError as error:
            raise DamagedBlob(
                f"The blob {digest[:12]} cannot be read (No such object). Restore it from a copy, "
                "or delete the frame and upload it again."
            ) from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(
                f"The blob {digest[:12]} is damaged: its content has another hash. Restore it "
                "from a copy, or delete the frame and upload it again."
            )
        return data

    def open(self, digest: str) -> BinaryIO:
        """A blob as a file that can be sought in, read a part at a time; see `Blobs.open`."""
        require_digest(digest)
        return self.objects.open(_key(digest))

    def holds(self, digest: str) -> bool:
        """Whether there is a blob of that digest; see `Blobs.holds`.

        Asked in writing transactions, for which others wait: where this process has put it, and
        nothing was removed since, the database alone is asked.
        """
        return self._holds(digest, TURN_S)

    def ensure(self, digest: str, data: bytes) -> None:
        """Put a blob once more where a removal took it; see `Blobs.ensure`."""
        if not self._holds(digest, REMOVAL_S):
            self.put(data)

    def _holds(self, digest: str, seconds: float) -> bool:
        require_digest(digest)
        with self._lock:
            before = self._put.get(digest)
        now = self._locks.removals()
        if before is not None and before == now:
            return True
        if now is None:  # it may be there still, and go a moment later
            self._locks.wait(digest, seconds)
        return self.objects.size(_key(digest)) is not None

    def size(self, digest: str) -> int | None:
        """Bytes of a blob, unchecked; None where it is missing."""
        require_digest(digest)
        return self.objects.size(_key(digest))

    def remove(self, *digests: str) -> None:
        """Forget blobs that nothing refers to, by few requests; only within `removing`."""
        for digest in digests:
            require_digest(digest)
        self.claim()
        with self._lock:
            for digest in digests:
                self._put.pop(digest, None)
        try:
            self.objects.delete(*map(_key, digests), seconds=REMOVAL_S, once=True)
        except BaseException:
            self._locks.doubt()
            raise

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Whether a blob is as it was stored; see `Blobs.condition`."""
        if not DIGEST.fullmatch(digest):
            return "missing"
        size, hashed = self.objects.size(_key(digest)), hashlib.sha256()
        if size is None:
            return "missing"
        if quick:
            return "sound"
        try:
            for chunk in self.objects.chunks(_key(digest), size):
                hashed.update(chunk)
        except FileNotFoundError:  # removed meanwhile
            return "missing"
        return "sound" if hashed.hexdigest() == digest else "damaged"

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Fetch what lies under a digest into a folder of this machine, durably, and remove it."""
        require_digest(digest)
        place = folder / f"blob-{digest}"
        make_folder(folder)
        place.unlink(missing_ok=True)
        try:
            self.objects.get_file(_key(digest), place)
        except FileNotFoundError:
            with suppress(FileNotFoundError):
                place.unlink()
            return None
        with place.open("rb") as file:
            os.fsync(file.fileno())
        for each in (folder, folder.parent):
            sync_folder(each)
        self.remove(digest)
        return place

    def place(self, digest: str) -> str:
        """Where a blob lies, for people to look at."""
        return f"{self.objects.url}/{_key(digest)}"

    def digests(self) -> Iterator[str]:
        """All blobs, a page at a time."""
        return (one.digest for one in self.entries() if one.digest is not None)

    def entries(self) -> Iterator[BlobEntry]:
        """All objects where blobs are kept, a page at a time.

        What a writer left that was killed is not among them: stores do not show the parts of an
        object that has no end. Let the bucket's lifecycle abort those after a day.
        """
        for one in self.objects.list(FOLDER):
            name = one.key.rpartition("/")[2]
            own = DIGEST.fullmatch(name) and one.key == _key(name)
            place = f"{self.objects.url}/{one.key}"
            yield BlobEntry(place, name if own else None, one.changed_at)

    def check(self) -> None:
        """See that the store answers; see `Blobs.check`."""
        if self._asking.acquire(blocking=False):  # else somebody asks, and the last answer holds
            try:
                if time.monotonic() - self._answered > CHECK_S:
                    self._wrong = self._look()
                    self._answered = time.monotonic()
            finally:
                self._asking.release()
        if self._wrong is not None:
            raise type(self._wrong)(str(self._wrong))

    def _look(self) -> UnusableStore | None:
        try:
            if self.objects.look(MARK) is None and self._claimed:
                return UnusableStore(
                    f"{self.objects.url}: {MARK} is gone, which was there before: the bucket was "
                    "emptied or replaced. Bring its objects back."
                )
        except UnusableStore as error:
            return error
        return None


def _key(digest: str) -> str:
    return f"{FOLDER}{digest[:2]}/{digest}"
