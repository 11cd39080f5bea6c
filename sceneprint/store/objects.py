"""Object storage by URL: bytes under keys, in a store that others operate.

URL  --open_objects (object_urls.py)-->  Objects  --put | get | list | delete-->  a store

Every call ends: a request has a time limit, all tries of one together have another, and after a
store was found away the next callers are told at once for a moment. What is large goes in parts,
so that memory is bounded. Messages name the store and what it said, never a key or a token: the
library's own hold whole URLs.
"""

from __future__ import annotations

import io
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from sceneprint.errors import StoreAway, StoreFull, UnusableStore
from sceneprint.store.ranges import RangeFile
from sceneprint.writing import sync_folder

if TYPE_CHECKING:
    from obstore.store import ObjectStore

#: Bytes that one request carries at most; what has more goes in parts, so many at once.
PART, AT_ONCE = 8 << 20, 3
#: Most parts that a store takes of one object.
MOST_PARTS = 9_000
#: Seconds for which nobody tries again a store that was just found away.
AWAY_S = 1.0
_REFUSED = ("PermissionDeniedError", "UnauthenticatedError")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist")
_FULL = re.compile(r"\b507\b|StorageFull|QuotaExceeded|InsufficientStorage", re.IGNORECASE)
_SAID = re.compile(
    r"<Code>(\w{1,60})</Code>|(?:HTTP error: )([a-z ]{3,60})|\b([45]\d\d [A-Z][\w ]{2,40})"
)


@dataclass(frozen=True)
class Found:
    """An object as a store lists it.

    Parameters
    ----------
    key : within the store's prefix
    size : bytes
    changed_at : seconds since 1970, by the store's clock
    """

    key: str
    size: int
    changed_at: float


class Objects:
    """Bytes under keys, below the prefix of a URL; safe to share between threads.

    Parameters
    ----------
    small, large : the store, for requests of a few bytes and for those of many
    url : to show
    variables : of the environment that it is configured by, to show
    folder : where it is one

    Every method raises UnusableStore where the store is away or refuses, StoreFull where it has
    no room.
    """

    def __init__(
        self, small: ObjectStore, large: ObjectStore, url: str, variables: str = "none",
        folder: Path | None = None,
    ) -> None:  # fmt: skip
        self._small, self._large, self._folder = small, large, folder
        self._variables = variables
        #: Where it is, to show; there are no credentials in it.
        self.url = url
        self._away = (0.0, "")  # until when, and what was said

    def put(self, key: str, data: bytes, *, create: bool = False) -> bool:
        """Keep bytes under a key; when this returns the store has acknowledged them.

        Parameters
        ----------
        key : within the prefix
        data : in place of what is there
        create : only where nothing is there

        Returns
        -------
        done : False where `create` found something
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError

        if len(data) > PART and not create:
            self.put_file(key, io.BytesIO(data))
            return True
        with self._explained(f"{key} cannot be written"):
            try:
                obstore.put(
                    self._small if len(data) < 1 << 20 else self._large, key, data,
                    mode="create" if create else "overwrite", use_multipart=False,
                )  # fmt: skip
            except AlreadyExistsError:
                return False
            self._make_durable(key)
        return True

    def put_file(self, key: str, file: Path | BinaryIO) -> None:
        """Keep a file under a key, in parts; it is there whole, or not at all.

        Parameters
        ----------
        key : within the prefix
        file : read from where it stands to its end
        """
        import obstore

        if isinstance(file, Path):
            with file.open("rb") as opened:
                self.put_file(key, opened)
            return
        place = file.tell()
        size = file.seek(0, os.SEEK_END) - place
        file.seek(place)
        with self._explained(f"{key} cannot be written"):
            obstore.put(
                self._large, key, file, use_multipart=size > PART,
                chunk_size=max(PART, -(-size // MOST_PARTS)), max_concurrency=AT_ONCE,
            )  # fmt: skip
            self._make_durable(key)

    def get(self, key: str) -> bytes:
        """All bytes under a key; FileNotFoundError where there are none."""
        import obstore

        with self._explained(f"{key} cannot be read"):
            found = obstore.get(self._small, key)
            if found.meta["size"] <= 1 << 20:
                return bytes(found.bytes())
            size = found.meta["size"]
            del found  # each part has a request of its own, and the time for it
        return b"".join(self.chunks(key, size))

    def part(self, key: str, start: int, length: int) -> bytes:
        """Some bytes of an object; FileNotFoundError where there is none.

        Parameters
        ----------
        key : within the prefix
        start, length : within the object, `length` more than 0
        """
        import obstore

        with self._explained(f"{key} cannot be read"):
            found = obstore.get_range(self._large, key, start=start, length=length)
        if len(found) != length:
            raise UnusableStore(
                f"{self.url}: {key} cannot be read (it ended early). Another program changed it "
                "meanwhile: try again."
            )
        return bytes(found)

    def chunks(self, key: str, size: int | None = None) -> Iterator[bytes]:
        """The bytes of an object in order, a part at a time; FileNotFoundError where there is none.

        Parameters
        ----------
        key : within the prefix
        size : of the object, where it is known
        """
        total = self.size(key) if size is None else size
        if total is None:
            raise FileNotFoundError(key)
        for start in range(0, total, PART):
            yield self.part(key, start, min(PART, total - start))

    def get_file(self, key: str, path: Path) -> None:
        """Write an object into a file that is made; FileNotFoundError where there is none."""
        with path.open("xb") as file:
            for chunk in self.chunks(key):
                file.write(chunk)

    def open(self, key: str) -> BinaryIO:
        """An object as a file that can be sought in, read a part at a time.

        FileNotFoundError where there is none.
        """
        size = self.size(key)
        if size is None:
            raise FileNotFoundError(key)
        return RangeFile.buffered(size, lambda start, length: self.part(key, start, length))

    def look(self, key: str) -> Found | None:
        """What is under a key; None where there is nothing."""
        import obstore

        with self._explained(f"{key} cannot be looked at"):
            try:
                one = obstore.head(self._small, key)
            except FileNotFoundError as error:
                if _NO_BUCKET.search(str(error)):
                    raise
                return None
        return Found(key, one["size"], one["last_modified"].timestamp())

    def size(self, key: str) -> int | None:
        """Bytes of an object; None where there is none."""
        found = self.look(key)
        return None if found is None else found.size

    def list(self, prefix: str) -> Iterator[Found]:
        """All objects whose keys lie below a prefix, a page at a time, in the store's order."""
        import obstore

        pages = iter(obstore.list(self._small, prefix, chunk_size=1000))
        while True:
            with self._explained(f"{prefix} cannot be listed"):
                page = next(pages, None)
            if page is None:
                return
            for one in page:
                yield Found(one["path"], one["size"], one["last_modified"].timestamp())

    def delete(self, *keys: str) -> None:
        """Remove objects; of no consequence where there are none."""
        import obstore

        with self._explained(f"{keys[0] if keys else 'nothing'} cannot be removed"):
            try:
                obstore.delete(self._small, keys)
            except FileNotFoundError as error:
                if _NO_BUCKET.search(str(error)):
                    raise
                if len(keys) > 1:  # it stopped at the first that was gone
                    for key in keys:
                        self.delete(key)

    def _make_durable(self, key: str) -> None:
        """Of a folder: the library does not sync what it writes."""
        if self._folder is None:
            return
        path = self._folder / key
        with path.open("rb") as file:
            os.fsync(file.fileno())
        while path != self._folder:
            path = path.parent
            sync_folder(path)

    @contextmanager
    def _explained(self, what: str) -> Iterator[None]:
        from obstore.exceptions import BaseError

        until, said = self._away
        if time.monotonic() < until:
            raise self._fault(what, said, StoreAway)
        try:
            yield
        except FileNotFoundError as error:
            if _NO_BUCKET.search(str(error)):
                raise self._fault(what, "there is no such bucket") from None
            raise FileNotFoundError(f"{self.url}: there is no {what.split(' ')[0]}") from None
        except (BaseError, OSError) as error:
            raise self._of(what, error) from None  # the library's text holds whole URLs

    def _of(self, what: str, error: Exception) -> UnusableStore:
        text = str(error)
        found = _SAID.search(text)
        said = next(filter(None, found.groups())).strip() if found else type(error).__name__
        if isinstance(error, OSError) and error.strerror:
            said = error.strerror
        refused = type(error).__name__ in _REFUSED or re.search(r"\b40[13]\b", said)
        if _FULL.search(text):
            return StoreFull(f"{self.url}: {what} ({said}). The store has no room: make some.")
        if refused:
            return UnusableStore(
                f"{self.url}: {what} ({said}). The store refuses us: see that the credentials in "
                f"the environment ({self._variables}) are right and allow to read, write, list "
                "and delete."
            )
        if not re.match(r"4\d\d ", said) and self._folder is None:
            self._away = (time.monotonic() + AWAY_S, said)
            return self._fault(what, said, StoreAway)
        return self._fault(what, said)

    def _fault(
        self, what: str, said: str, kind: type[UnusableStore] = UnusableStore
    ) -> UnusableStore:
        return kind(
            f"{self.url}: {what} ({said}). See that the store is there and can be reached from "
            f"here, and that its settings in the environment ({self._variables}) are "
            "right."
        )
