"""Object storage by URL: bytes under keys, in a store that others operate.

URL  --open_objects-->  Objects  --put | get | list | delete-->  a store

Every call ends: a request has a time limit, all tries of one together have another, and after a
store was found away the next callers are told at once for a moment. What is large goes in parts,
so that memory is bounded. Messages name the store and what it said, never a key or a token: the
library's own hold whole URLs.
"""

from __future__ import annotations

import io
import math
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast
from urllib.parse import unquote, urlsplit

from sceneprint.atomic_files import create_private, make_folder, sync_folder
from sceneprint.errors import StoreAway, StoreFull, UnusableStore

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer
    from obstore.store import ClientConfig, ObjectStore, RetryConfig

# A file that lies elsewhere and is fetched a range at a time.

#: Bytes that are fetched at once at least.
AHEAD = 1 << 20


class RangeFile(io.RawIOBase):
    """To be read and sought in; see `buffered`.

    Parameters
    ----------
    size : bytes of it
    fetch : its bytes from a place on, so many
    """

    def __init__(self, size: int, fetch: Callable[[int, int], bytes]) -> None:
        super().__init__()
        self._size, self._fetch, self._place = size, fetch, 0

    @classmethod
    def buffered(cls, size: int, fetch: Callable[[int, int], bytes]) -> BinaryIO:
        """With a buffer, so that small reads cost no request each."""
        return cast("BinaryIO", io.BufferedReader(cls(size, fetch), AHEAD))

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go elsewhere; beyond the end there is nothing to read."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError("before the beginning")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """The place that is read next."""
        return self._place

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        """Read what there is, as much as the buffer takes."""
        view = memoryview(buffer).cast("B")
        length = min(len(view), self._size - self._place)
        if length <= 0:
            return 0
        view[:length] = self._fetch(self._place, length)
        self._place += length
        return length


#: Bytes that one request carries at most; what has more goes in parts, so many at once.
PART, AT_ONCE = 8 << 20, 3
#: Most parts that a store takes of one object.
MOST_PARTS = 9_000
#: Most keys that one request removes.
MOST_KEYS = 500
#: Seconds for which nobody tries again a store that was just found away.
AWAY_S = 1.0
_REFUSED = ("PermissionDeniedError", "UnauthenticatedError")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist")
_FULL = re.compile(
    r"\b507\b|StorageFull|QuotaExceeded|InsufficientStorage|os error (?:27|28|122)\b", re.IGNORECASE
)
_SAID = re.compile(
    r"<Code>(\w{1,60})</Code>|(?:HTTP error: )([a-z ]{3,60})|\b([45]\d\d [A-Z][\w ]{2,40})"
)


@dataclass(frozen=True)
class ListedObject:
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
    once : for those that are not tried again
    url : to show
    variables : of the environment that it is configured by, to show
    folder : where it is one

    Every method raises UnusableStore where the store is away or refuses, StoreFull where it has
    no room.
    """

    def __init__(
        self, small: ObjectStore, large: ObjectStore, once: ObjectStore, url: str,
        variables: str = "none", folder: Path | None = None,
    ) -> None:  # fmt: skip
        self._small, self._large, self._once, self._folder = small, large, once, folder
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
        with os.fdopen(create_private(path), "wb") as file:
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

    def look(self, key: str) -> ListedObject | None:
        """What is under a key; None where there is nothing."""
        import obstore

        with self._explained(f"{key} cannot be looked at"):
            try:
                one = obstore.head(self._small, key)
            except FileNotFoundError as error:
                if _NO_BUCKET.search(str(error)):
                    raise
                return None
        return ListedObject(key, one["size"], one["last_modified"].timestamp())

    def size(self, key: str) -> int | None:
        """Bytes of an object; None where there is none."""
        found = self.look(key)
        return None if found is None else found.size

    def list(self, prefix: str) -> Iterator[ListedObject]:
        """All objects whose keys lie below a prefix, a page at a time, in the store's order."""
        import obstore

        pages = iter(obstore.list(self._small, prefix, chunk_size=1000))
        while True:
            with self._explained(f"{prefix} cannot be listed"):
                page = next(pages, None)
            if page is None:
                return
            for one in page:
                yield ListedObject(one["path"], one["size"], one["last_modified"].timestamp())

    def delete(self, *keys: str, seconds: float = math.inf, once: bool = False) -> None:
        """Remove objects; of no consequence where there are none.

        Parameters
        ----------
        keys : within the prefix
        seconds : after which no further request is begun; StoreAway where keys are left then
        once : do not try again what failed: a request without an answer may be carried out after
            the one that was tried again, and this would not tell of it
        """
        import obstore

        until = time.monotonic() + seconds
        for start in range(0, len(keys), MOST_KEYS):
            some = keys[start : start + MOST_KEYS]
            with self._explained(f"{some[0]} cannot be removed"):
                if start and time.monotonic() > until:
                    raise self._fault(some[0], "too slow", StoreAway)
                try:
                    obstore.delete(self._once if once else self._small, some)
                except FileNotFoundError as error:
                    if _NO_BUCKET.search(str(error)):
                        raise
                    if len(some) > 1:  # it stopped at the first that was gone
                        for key in some:
                            if time.monotonic() > until:
                                raise self._fault(key, "too slow", StoreAway) from None
                            self.delete(key, once=once)

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


# URLs of object stores: what they may hold, and how they are opened.
#
# Credentials and settings come from the environment alone.

#: Seconds for a connection, for a request of a few bytes, and for one of a part; and seconds after
#: which no request is tried again.
CONNECT_S, SMALL_S, PART_S, TRIED_S = 3, 10, 60, 8
#: How often one is at most.
RETRIES = 8
#: Kinds of stores, and the beginnings of the environment variables they are configured by.
VARIABLES = {
    "s3": "AWS_", "s3a": "AWS_", "gs": "GOOGLE_", "az": "AZURE_", "azure": "AZURE_",
    "abfs": "AZURE_", "abfss": "AZURE_", "file": "", "memory": "",
}  # fmt: skip
_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")


def check_url(url: str, setting: str = "SCENEPRINT_BLOB_URL") -> None:
    """See that a URL names an object store, and nothing that must not be in it.

    Parameters
    ----------
    url : such as s3://bucket/prefix
    setting : that it is of, for messages; the URL itself is not shown, it may hold a password

    Raises
    ------
    UnusableStore : it does not.
    """
    try:
        parts = urlsplit(url)
        named, netloc = parts.scheme.lower(), parts.netloc
    except ValueError:
        named, netloc, parts = "", "", urlsplit("")
    if "@" in netloc or parts.query or parts.fragment:
        raise UnusableStore(
            f"{setting} holds a user, a password or a query. Credentials are read from the "
            "environment alone (AWS_..., GOOGLE_..., AZURE_...): leave them out of it."
        )
    steps = unquote(parts.path).split("/")
    wrong = any(one in (".", "..") for one in steps) or not unquote(parts.path).isprintable()
    lacking = {"file": not parts.path.startswith("/") or parts.path == "/", "memory": False}
    if named not in VARIABLES or wrong or lacking.get(named, not netloc) or (
        named in lacking and netloc
    ):  # fmt: skip
        raise UnusableStore(
            f"{setting} names no object store. Set it to s3://bucket/prefix, gs://bucket/prefix, "
            "az://account/container/prefix, file:///folder, or memory:/// to try."
        )


def open_objects(url: str, setting: str = "SCENEPRINT_BLOB_URL") -> Objects:
    """Open an object store; nothing is asked of it yet.

    Parameters
    ----------
    url : s3://bucket/prefix, gs://bucket/prefix, az://account/container/prefix, file:///folder, or
        memory:/// for what ends with the process; credentials come from the environment
    setting : that it is of, for messages

    Raises
    ------
    UnusableStore : it is none, or cannot be opened with this environment.
    """
    check_url(url, setting)
    try:
        from obstore.exceptions import BaseError
        from obstore.store import LocalStore, MemoryStore, from_url
    except ImportError as error:
        raise UnusableStore(
            f"{setting} needs obstore, which cannot be imported here ({error}). Install it: "
            "pip install obstore"
        ) from error
    kind, url = url.partition(":")[0].lower(), url.rstrip("/")
    plain = [name for name in _ENDPOINTS if os.environ.get(name, "").startswith("http://")]
    if kind.startswith("s3") and plain and not _allows_http():
        raise UnusableStore(
            f"{plain[0]} names a server without TLS. Set AWS_ALLOW_HTTP=true where nobody can "
            "listen in between, or give it as https://."
        )
    if kind == "memory":
        memory = MemoryStore()
        return Objects(memory, memory, memory, "memory:///")
    if kind == "file":
        folder = Path(unquote(urlsplit(url).path))
        try:
            make_folder(folder)
        except OSError as error:
            raise UnusableStore(
                f"{folder}: the folder cannot be made ({error.strerror}). Check its permissions."
            ) from error
        local = LocalStore(folder)
        return Objects(local, local, local, url, folder=folder)
    try:
        small, large, once = (
            from_url(url, client_options=_client(seconds), retry_config=_retries(most))
            for seconds, most in ((SMALL_S, RETRIES), (PART_S, RETRIES), (SMALL_S, 0))
        )
    except (BaseError, ValueError) as error:
        said = str(error).partition("\n")[0]
        raise UnusableStore(
            f"{url}: the store cannot be opened ({said:.200}). See {setting} and the variables "
            f"{VARIABLES[kind]}... of the environment."
        ) from None
    return Objects(small, large, once, url, f"{VARIABLES[kind]}...")


def _client(seconds: int) -> ClientConfig:
    return {
        "allow_http": _allows_http(),  # takes the place of what the library finds itself
        "connect_timeout": timedelta(seconds=CONNECT_S),
        "timeout": timedelta(seconds=seconds),
        "user_agent": "sceneprint",
    }


def _allows_http() -> bool:
    names = [f"{begin}ALLOW_HTTP" for begin in ("AWS_", "GOOGLE_", "AZURE_")]
    return any(os.environ.get(name, "").lower() in ("1", "true", "yes") for name in names)


def _retries(most: int) -> RetryConfig:
    backoff: Any = {
        "init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1), "base": 2,
    }  # fmt: skip
    return {"max_retries": most, "retry_timeout": timedelta(seconds=TRIED_S), "backoff": backoff}


def check_objects(objects: Objects) -> float:
    """Write, read and remove a small object; returns the seconds it took.

    Raises
    ------
    UnusableStore : one of that is not possible, or what is read is not what was written.
    """
    key, data = f"check/{os.urandom(8).hex()}", os.urandom(64)
    begun = time.perf_counter()
    objects.put(key, data)
    try:
        same = objects.get(key) == data
    except FileNotFoundError:
        same = False
    finally:
        objects.delete(key)
    if not same:
        raise UnusableStore(
            f"{objects.url}: what is written is not what is read at once afterwards. Use a store "
            "that is strongly consistent, as S3, GCS and Azure are."
        )
    return time.perf_counter() - begun
