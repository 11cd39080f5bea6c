"""Client for object stores: bytes under keys, below a URL.

    URL  --open_objects-->  Objects  --put | get | list | delete-->  object store

Each attempt at a request has a time limit, and so do all attempts together. For AWAY_S seconds
after a failure to reach the store, calls fail immediately. Large objects are sent in parts to limit
memory. Error messages contain the URL and the reason, but not the text of the library, which may
contain credentials.
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

#: Minimum size of a read request, bytes.
AHEAD = 1 << 20


class RangeFile(io.RawIOBase):
    """A remote file that is read in ranges; see `buffered`.

    Parameters
    ----------
    size : size of the file, bytes
    fetch : function of offset and length that returns these bytes of the file
    """

    def __init__(self, size: int, fetch: Callable[[int, int], bytes]) -> None:
        super().__init__()
        self._size, self._fetch, self._place = size, fetch, 0

    @classmethod
    def buffered(cls, size: int, fetch: Callable[[int, int], bytes]) -> BinaryIO:
        """Return a buffered file, which combines small reads into larger requests."""
        return cast("BinaryIO", io.BufferedReader(cls(size, fetch), AHEAD))

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Set the position, possibly beyond the end, and return it."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError("the position is negative")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """Return the position."""
        return self._place

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        """Fill the buffer, as far as the file reaches; return the number of bytes read."""
        view = memoryview(buffer).cast("B")
        length = min(len(view), self._size - self._place)
        if length <= 0:
            return 0
        view[:length] = self._fetch(self._place, length)
        self._place += length
        return length


#: Size, in bytes, of the parts in which large objects are sent, and number of concurrent parts.
PART, AT_ONCE = 8 << 20, 3
#: Maximum number of parts of an object.
MOST_PARTS = 9_000
#: Maximum number of keys in one request to remove objects.
MOST_KEYS = 500
#: Seconds for which calls fail without a request after a store was unreachable.
AWAY_S = 1.0
_REFUSED = ("PermissionDeniedError", "UnauthenticatedError")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist")
_FULL = re.compile(
    r"\b507\b|StorageFull|QuotaExceeded|InsufficientStorage|os error (?:27|28|122)\b", re.IGNORECASE
)
_REASON = re.compile(
    r"<Code>(\w{1,60})</Code>|(?:HTTP error: )([a-z ]{3,60})|\b([45]\d\d [A-Z][\w ]{2,40})"
)


@dataclass(frozen=True)
class ListedObject:
    """An object listed by a store.

    Parameters
    ----------
    key : key relative to the prefix
    size : size of the object, bytes
    changed_at : time of modification according to the clock of the store, seconds since 1970
    """

    key: str
    size: int
    changed_at: float


class Objects:
    """Client for the objects below the prefix of a URL; safe to share between threads.

    All methods raise UnusableStore if the store is unreachable or refuses the request, and
    StoreFull if the store is full.

    Parameters
    ----------
    small, large : clients for requests that transfer few bytes, and many bytes
    once : client for requests that must not be repeated
    variables : names of the environment variables that configure the store, for messages
    folder : path of the store if it is a folder
    """

    def __init__(
        self, small: ObjectStore, large: ObjectStore, once: ObjectStore, url: str,
        variables: str = "none", folder: Path | None = None,
    ) -> None:  # fmt: skip
        self._small, self._large, self._once, self._folder = small, large, once, folder
        self._variables = variables
        #: URL for messages, without credentials.
        self.url = url
        self._away = (0.0, "")  # end of the pause after a failure, and the reason of the failure

    def put(self, key: str, data: bytes, *, create: bool = False) -> bool:
        """Store bytes under a key durably.

        Parameters
        ----------
        key : key below the prefix
        data : bytes to store; they replace an existing object
        create : whether to store the bytes only if the object does not exist

        Returns
        -------
        done : False if `create` is set and an object exists
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError

        if len(data) > PART and not create:
            self.put_file(key, io.BytesIO(data))
            return True
        with self._translate_errors(f"{key} cannot be written"):
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
        """Store a file under a key in parts; the object appears completely or not at all.

        Parameters
        ----------
        key : key below the prefix
        file : path, or open file that is read from its position to its end
        """
        import obstore

        if isinstance(file, Path):
            with file.open("rb") as opened:
                self.put_file(key, opened)
            return
        place = file.tell()
        size = file.seek(0, os.SEEK_END) - place
        file.seek(place)
        with self._translate_errors(f"{key} cannot be written"):
            obstore.put(
                self._large, key, file, use_multipart=size > PART,
                chunk_size=max(PART, -(-size // MOST_PARTS)), max_concurrency=AT_ONCE,
            )  # fmt: skip
            self._make_durable(key)

    def get(self, key: str) -> bytes:
        """Return the bytes under a key. Raise FileNotFoundError if there is no object."""
        import obstore

        with self._translate_errors(f"{key} cannot be read"):
            answer = obstore.get(self._small, key)
            size = answer.meta["size"]
            if size <= 1 << 20:
                return bytes(answer.bytes())
            del answer  # request each part separately, with its own time limit
        return b"".join(self.chunks(key, size))

    def read_range(self, key: str, start: int, length: int) -> bytes:
        """Return exactly `length` bytes of an object.

        Parameters
        ----------
        key : key below the prefix
        start, length : range within the object, bytes; `length` must be positive

        Raises
        ------
        FileNotFoundError : If the object does not exist.
        UnusableStore : If the object ends before the end of the range.
        """
        import obstore

        with self._translate_errors(f"{key} cannot be read"):
            data = obstore.get_range(self._large, key, start=start, length=length)
        if len(data) != length:
            raise UnusableStore(
                f"{self.url}: {key} cannot be read, because another program changed it in the "
                "meantime. Try again."
            )
        return bytes(data)

    def chunks(self, key: str, size: int | None = None) -> Iterator[bytes]:
        """Yield the content of an object in parts.

        Parameters
        ----------
        key : key below the prefix
        size : size of the object, bytes; None if unknown

        Raises
        ------
        FileNotFoundError : If the object does not exist.
        """
        total = self.size(key) if size is None else size
        if total is None:
            raise FileNotFoundError(key)
        for start in range(0, total, PART):
            yield self.read_range(key, start, min(PART, total - start))

    def get_file(self, key: str, path: Path) -> None:
        """Write an object to a new file. Raise FileNotFoundError if the object does not exist."""
        with os.fdopen(create_private(path), "wb") as file:
            for chunk in self.chunks(key):
                file.write(chunk)

    def open(self, key: str) -> BinaryIO:
        """Return an object as a seekable file. Raise FileNotFoundError if it does not exist."""
        size = self.size(key)
        if size is None:
            raise FileNotFoundError(key)
        return RangeFile.buffered(size, lambda start, length: self.read_range(key, start, length))

    def head(self, key: str) -> ListedObject | None:
        """Return the properties of an object; None if it does not exist."""
        import obstore

        with self._translate_errors(f"{key} cannot be inspected"):
            try:
                meta = obstore.head(self._small, key)
            except FileNotFoundError as error:
                if _NO_BUCKET.search(str(error)):
                    raise
                return None
        return ListedObject(key, meta["size"], meta["last_modified"].timestamp())

    def size(self, key: str) -> int | None:
        """Return the size of an object, bytes; None if it does not exist."""
        listed = self.head(key)
        return None if listed is None else listed.size

    def list(self, prefix: str) -> Iterator[ListedObject]:
        """Yield the objects whose keys start with a prefix, in the order of the store."""
        import obstore

        pages = iter(obstore.list(self._small, prefix, chunk_size=1000))
        while True:
            with self._translate_errors(f"{prefix} cannot be listed"):
                page = next(pages, None)
            if page is None:
                return
            for entry in page:
                yield ListedObject(entry["path"], entry["size"], entry["last_modified"].timestamp())

    def delete(self, *keys: str, seconds: float = math.inf, once: bool = False) -> None:
        """Remove objects; ignore missing objects.

        Parameters
        ----------
        keys : keys below the prefix
        seconds : time limit
        once : whether to send each request only once. A store may execute an unanswered request
            late, that is, after a repetition

        Raises
        ------
        StoreAway : If keys remain at the time limit.
        """
        import obstore

        until = time.monotonic() + seconds
        for start in range(0, len(keys), MOST_KEYS):
            block = keys[start : start + MOST_KEYS]
            with self._translate_errors(f"{block[0]} cannot be removed"):
                if start and time.monotonic() > until:
                    raise self._error(block[0], "too slow", StoreAway)
                try:
                    obstore.delete(self._once if once else self._small, block)
                except FileNotFoundError as error:
                    if _NO_BUCKET.search(str(error)):
                        raise
                    if len(block) > 1:  # some stores stop at the first missing object
                        for key in block:
                            if time.monotonic() > until:
                                raise self._error(key, "too slow", StoreAway) from None
                            self.delete(key, once=once)

    def _make_durable(self, key: str) -> None:
        """Sync an object to disk if the store is a folder, since the library does not."""
        if self._folder is None:
            return
        path = self._folder / key
        with path.open("rb") as file:
            os.fsync(file.fileno())
        while path != self._folder:
            path = path.parent
            sync_folder(path)

    @contextmanager
    def _translate_errors(self, what: str) -> Iterator[None]:
        """Translate errors of the library; during the pause after a failure, raise StoreAway."""
        from obstore.exceptions import BaseError

        until, reason = self._away
        if time.monotonic() < until:
            raise self._error(what, reason, StoreAway)
        try:
            yield
        except FileNotFoundError as error:
            if _NO_BUCKET.search(str(error)):
                raise self._error(what, "there is no such bucket") from None
            raise FileNotFoundError(f"{self.url}: there is no {what.split(' ')[0]}") from None
        except (BaseError, OSError) as error:
            raise self._translate(what, error) from None  # the library's text contains whole URLs

    def _translate(self, what: str, error: Exception) -> UnusableStore:
        """Return the store error for an error; if the store was unreachable, begin the pause."""
        text = str(error)
        match = _REASON.search(text)
        reason = next(filter(None, match.groups())).strip() if match else type(error).__name__
        if isinstance(error, OSError) and error.strerror:
            reason = error.strerror
        refused = type(error).__name__ in _REFUSED or re.search(r"\b40[13]\b", reason)
        if _FULL.search(text):
            return StoreFull(f"{self.url}: {what} ({reason}). The store is full. Free some space.")
        if refused:
            return UnusableStore(
                f"{self.url}: {what} ({reason}). The store denies access. Check that the "
                f"credentials in the environment ({self._variables}) allow reading, writing, "
                "listing and deleting."
            )
        if not re.match(r"4\d\d ", reason) and self._folder is None:
            self._away = (time.monotonic() + AWAY_S, reason)
            return self._error(what, reason, StoreAway)
        return self._error(what, reason)

    def _error(
        self, what: str, reason: str, kind: type[UnusableStore] = UnusableStore
    ) -> UnusableStore:
        return kind(
            f"{self.url}: {what} ({reason}). Check that the store exists and is reachable from "
            f"this machine, and check its settings in the environment ({self._variables})."
        )


# Access to a store. Credentials and settings come only from the environment.

#: Time limits for connecting, small requests, parts, and all repetitions together, seconds.
CONNECT_S, SMALL_S, PART_S, TRIED_S = 3, 10, 60, 8
#: Maximum number of repetitions of a request.
RETRIES = 8
#: Prefix of the environment variables that configure a store, by the scheme of its URL.
VARIABLES = {
    "s3": "AWS_", "s3a": "AWS_", "gs": "GOOGLE_", "az": "AZURE_", "azure": "AZURE_",
    "abfs": "AZURE_", "abfss": "AZURE_", "file": "", "memory": "",
}  # fmt: skip
_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")


def check_url(url: str, setting: str = "SCENEPRINT_BLOB_URL") -> None:
    """Check that a URL is a valid object store URL without credentials.

    Parameters
    ----------
    url : URL such as s3://bucket/prefix
    setting : name of the setting for messages; they omit the URL, which may contain a password

    Raises
    ------
    UnusableStore : If the URL is not valid.
    """
    try:
        parts = urlsplit(url)
        named, netloc = parts.scheme.lower(), parts.netloc
    except ValueError:
        named, netloc, parts = "", "", urlsplit("")
    if "@" in netloc or parts.query or parts.fragment:
        raise UnusableStore(
            f"{setting} contains a user, a password or a query. Set credentials only in the "
            "environment (AWS_..., GOOGLE_..., AZURE_...)."
        )
    steps = unquote(parts.path).split("/")
    wrong = any(step in (".", "..") for step in steps) or not unquote(parts.path).isprintable()
    lacking = {"file": not parts.path.startswith("/") or parts.path == "/", "memory": False}
    if named not in VARIABLES or wrong or lacking.get(named, not netloc) or (
        named in lacking and netloc
    ):  # fmt: skip
        raise UnusableStore(
            f"{setting} is not the URL of an object store. Set it to s3://bucket/prefix, "
            "gs://bucket/prefix, az://account/container/prefix, file:///folder, or memory:/// for "
            "a test."
        )


def open_objects(url: str, setting: str = "SCENEPRINT_BLOB_URL") -> Objects:
    """Open an object store without contacting it.

    Parameters
    ----------
    url : s3://bucket/prefix, gs://bucket/prefix, az://account/container/prefix, file:///folder, or
        memory:/// (a store in the memory of this process). Credentials come from the environment
    setting : name of the setting, for messages

    Raises
    ------
    UnusableStore : If the URL is not valid, or the store cannot be opened with this environment.
    """
    check_url(url, setting)
    try:
        from obstore.exceptions import BaseError
        from obstore.store import LocalStore, MemoryStore, from_url
    except ImportError as error:
        raise UnusableStore(
            f"{setting} requires obstore, which cannot be imported ({error}). Install it: "
            "pip install obstore"
        ) from error
    kind, url = url.partition(":")[0].lower(), url.rstrip("/")
    plain = [name for name in _ENDPOINTS if os.environ.get(name, "").startswith("http://")]
    if kind.startswith("s3") and plain and not _allows_http():
        raise UnusableStore(
            f"{plain[0]} is the URL of a server without TLS. Use https://, or set "
            "AWS_ALLOW_HTTP=true if the network is trusted."
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
                f"{folder}: The folder cannot be created ({error.strerror}). Check its permissions."
            ) from error
        local = LocalStore(folder)
        return Objects(local, local, local, url, folder=folder)
    try:
        small, large, once = (
            from_url(url, client_options=_client(seconds), retry_config=_retries(most))
            for seconds, most in ((SMALL_S, RETRIES), (PART_S, RETRIES), (SMALL_S, 0))
        )
    except (BaseError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise UnusableStore(
            f"{url}: The store cannot be opened ({reason:.200}). Check {setting} and the "
            f"environment variables {VARIABLES[kind]}..."
        ) from None
    return Objects(small, large, once, url, f"{VARIABLES[kind]}...")


def _client(seconds: int) -> ClientConfig:
    return {
        "allow_http": _allows_http(),  # this overrides the setting of the library
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
    """Write, read and remove a small object; return the duration in seconds.

    Raises
    ------
    UnusableStore : If an operation fails, or returns different bytes.
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
            f"{objects.url}: An object that was just written returned different bytes. Use a "
            "strongly consistent store, such as S3, GCS or Azure."
        )
    return time.perf_counter() - begun
