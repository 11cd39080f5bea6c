"""Storage of blobs in an object store that a fleet shares.

    PREFIX/blobs/ab/abcdef...   blob under its digest
    PREFIX/sceneprint.json      name of the store that owns the blobs

A blob appears completely or not at all, even if it is sent in parts. An existing blob is sent
again, because it may be damaged or about to be removed.
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
from sceneprint.errors import UnusableStore
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

# Owner of a prefix or of a shared folder. Two databases with the same prefix would remove each
# other's blobs.
#
#     PREFIX/sceneprint.json   {"store": its name, "restoring": true during a restore}
#
# The name is derived from the secret of the database, so a restored store has the same name as the
# original. A restore therefore refuses a prefix in use even if its name is the same.


class BucketOwner:
    """File that names the owner of a prefix.

    All methods raise UnusableStore if the prefix belongs to another database or is not accessible.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    @classmethod
    def of_folder(cls, folder: Path) -> BucketOwner:
        """Return the mark of a folder of blobs."""
        return cls(open_objects(f"file://{quote(str(folder.absolute()))}"))

    def claim(self, owner: str, *, anew: bool) -> bool:
        """Check that no other store owns the prefix; return whether the prefix is marked.

        Parameters
        ----------
        anew : whether to mark an unclaimed prefix
        """
        for _ in range(2):  # repeat if another process claims the prefix at the same time
            mark = self._read()
            if mark is None:
                if not anew:
                    return False
                if self._put(owner, create=True):
                    return True
                continue
            if mark.get("store") != owner:
                raise self._conflict("another database")
            return True
        return False

    def begin(self, owner: str, before: str) -> None:
        """Claim the prefix for a store before its restore, or continue an interrupted restore.

        Parameters
        ----------
        before : name of the empty database that receives the store. If a service has claimed the
            prefix for this database, the claim is replaced
        """
        mark = self._read()
        free = mark is not None and before != owner and mark.get("store") == before
        if mark is None or free:
            if not self._put(owner, create=mark is None, restoring=True):
                raise self._conflict("another database")
        elif mark.get("store") != owner:
            raise self._conflict("another database")
        elif mark.get("restoring") is not True:
            raise self._conflict("the store of the snapshot, or to a copy of it")

    def end(self, owner: str) -> None:
        """Record the end of the restore."""
        self._put(owner)

    def _read(self) -> dict[str, Any] | None:
        """Return the content of the mark; None without a mark."""
        try:
            mark = json.loads(self._objects.get(MARK))
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError):
            return {}
        return mark if isinstance(mark, dict) else {}

    def _put(self, owner: str, *, create: bool = False, restoring: bool = False) -> bool:
        record = {"kind": "sceneprint blobs", "store": owner}
        more = {"restoring": True} if restoring else {}
        return self._objects.put(MARK, json.dumps(record | more).encode(), create=create)

    def _conflict(self, other: str) -> UnusableStore:
        return UnusableStore(
            f"{self._objects.url}: The blobs belong to {other}, and this database would remove "
            "them. Set SCENEPRINT_BLOB_URL to a different prefix for each database. If the other "
            f"database no longer exists, remove {MARK} from the prefix."
        )


#: Key prefix of the blobs.
FOLDER = "blobs/"
#: Maximum number of stored blobs for which the counter of removals is cached.
_REMEMBERED = 4_096
#: Seconds for which `check` repeats its last result.
CHECK_S = 2.0


class ObjectBlobs(Blobs):
    """Blobs below the prefix of an object store.

    Parameters
    ----------
    locks : lock of all processes that share the prefix
    owner : function that returns the name of the store that owns the blobs
    """

    def __init__(self, objects: Objects, locks: Locks, owner: Callable[[], str]) -> None:
        super().__init__(locks)
        self.objects = objects
        self._owner = owner
        self._claimed = False
        self._put: OrderedDict[str, int] = OrderedDict()  # counter of removals, by digest
        self._lock = threading.Lock()
        self._checking = threading.Lock()
        self._wrong: UnusableStore | None = None
        self._answered = -math.inf

    def claim(self, *, anew: bool = True) -> None:
        """Check that the prefix belongs to this store, and mark it if it is unclaimed.

        Raises
        ------
        UnusableStore : If the prefix belongs to another database or is not accessible.
        """
        if not self._claimed:
            self._claimed = BucketOwner(self.objects).claim(self._owner(), anew=anew)

    def put(self, data: bytes) -> str:
        """Store bytes durably, and return their digest; see `Blobs.put`."""
        digest = hashlib.sha256(data).hexdigest()
        with self._putting(digest):
            self.objects.put(_key(digest), data)
        return digest

    @contextmanager
    def incoming(self) -> Iterator[IncomingBlob]:
        """Yield a blob to write in chunks; see `Blobs.incoming`.

        The blob is a nameless temporary file until its digest is known, because stores cannot
        rename objects larger than 5 GB.
        """
        place = tempfile.gettempdir()
        what = f"{place}: A blob cannot be written"
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
        before = self.locks.removals()
        yield
        with self._lock:
            self._put.pop(digest, None)
            if before is not None:
                self._put[digest] = before
            if len(self._put) > _REMEMBERED:
                self._put.popitem(last=False)

    def read(self, digest: str) -> bytes:
        """Return the unverified bytes of a blob; see `Blobs.read`."""
        require_digest(digest)
        return self.objects.get(_key(digest))

    def open(self, digest: str) -> BinaryIO:
        """Return an unverified blob as a seekable file; see `Blobs.open`."""
        require_digest(digest)
        return self.objects.open(_key(digest))

    def holds(self, digest: str, seconds: float = TURN_S) -> bool:
        """Return whether a blob exists; see `Blobs.holds`.

        If this process stored the blob, and no blob has been removed since, this does not contact
        the object store, because other writers are waiting.
        """
        require_digest(digest)
        with self._lock:
            before = self._put.get(digest)
        now = self.locks.removals()
        if before is not None and before == now:
            return True
        if now is None:  # a removal is running, and may remove the blob
            self.locks.wait(digest, seconds)
        return self.objects.size(_key(digest)) is not None

    def size(self, digest: str) -> int | None:
        """Return the size of a blob in bytes, unverified; None if it is missing."""
        require_digest(digest)
        return self.objects.size(_key(digest))

    def remove(self, *digests: str) -> None:
        """Remove blobs without references; see `Blobs.remove`."""
        for digest in digests:
            require_digest(digest)
        self.claim()
        with self._lock:
            for digest in digests:
                self._put.pop(digest, None)
        try:
            self.objects.delete(*map(_key, digests), seconds=REMOVAL_S, once=True)
        except BaseException:
            self.locks.mark_uncertain()
            raise

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Check a blob, and return its condition; see `Blobs.condition`."""
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
        except FileNotFoundError:
            return "missing"
        return "sound" if hashed.hexdigest() == digest else "damaged"

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move a damaged blob to a folder of this machine durably; see `Blobs.quarantine`."""
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
        """Return the path or URL of a blob for messages."""
        return f"{self.objects.url}/{_key(digest)}"

    def entries(self) -> Iterator[BlobEntry]:
        """Yield all objects of the blob storage, page by page.

        Stores do not list incomplete uploads of killed writers. Configure the lifecycle rules of
        the bucket to abort them after a day.
        """
        for entry in self.objects.list(FOLDER):
            name = entry.key.rpartition("/")[2]
            own = DIGEST.fullmatch(name) and entry.key == _key(name)
            place = f"{self.objects.url}/{entry.key}"
            yield BlobEntry(place, name if own else None, entry.changed_at)

    def check(self) -> None:
        """Raise UnusableStore if the store is unreachable; see `Blobs.check`."""
        if self._checking.acquire(blocking=False):
            try:
                if time.monotonic() - self._answered > CHECK_S:
                    self._wrong = self._look()
                    self._answered = time.monotonic()
            finally:
                self._checking.release()
        if self._wrong is not None:
            raise type(self._wrong)(str(self._wrong))

    def _look(self) -> UnusableStore | None:
        try:
            if self.objects.head(MARK) is None and self._claimed:
                return UnusableStore(
                    f"{self.objects.url}: {MARK} is missing, so the bucket was probably emptied or "
                    "replaced. Restore its objects."
                )
        except UnusableStore as error:
            return error
        return None


def _key(digest: str) -> str:
    return f"{FOLDER}{digest[:2]}/{digest}"
