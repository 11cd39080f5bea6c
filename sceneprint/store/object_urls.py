"""URLs of object stores: what they may hold, and how they are opened.

Credentials and settings come from the environment alone.
"""

from __future__ import annotations

import os
import time
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from sceneprint.errors import UnusableStore
from sceneprint.store.objects import Objects
from sceneprint.writing import make_folder

if TYPE_CHECKING:
    from obstore.store import ClientConfig, RetryConfig

#: Seconds for a connection, for a request of a few bytes, and for one of a part; and seconds after
#: which no request is tried again.
CONNECT_S, SMALL_S, PART_S, TRIED_S = 3, 10, 60, 8
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
        return Objects(memory, memory, "memory:///")
    if kind == "file":
        folder = Path(unquote(urlsplit(url).path))
        try:
            make_folder(folder)
        except OSError as error:
            raise UnusableStore(
                f"{folder}: the folder cannot be made ({error.strerror}). Check its permissions."
            ) from error
        local = LocalStore(folder)
        return Objects(local, local, url, folder=folder)
    try:
        small, large = (
            from_url(url, client_options=_client(seconds), retry_config=_retries())
            for seconds in (SMALL_S, PART_S)
        )
    except (BaseError, ValueError) as error:
        said = str(error).partition("\n")[0]
        raise UnusableStore(
            f"{url}: the store cannot be opened ({said:.200}). See {setting} and the variables "
            f"{VARIABLES[kind]}... of the environment."
        ) from None
    return Objects(small, large, url, f"{VARIABLES[kind]}...")


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


def _retries() -> RetryConfig:
    backoff: Any = {
        "init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=1), "base": 2,
    }  # fmt: skip
    return {"max_retries": 8, "retry_timeout": timedelta(seconds=TRIED_S), "backoff": backoff}


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
