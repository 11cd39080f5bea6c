"""Who a request was meant for, and which page sent it, where only this machine is served.

A service on a loopback address asks for no key: whoever reaches it is on this machine. So is a
browser, and pages of others run in it. A page may let its own name point to 127.0.0.1 and read
the answers as its own ("DNS rebinding"): the header Host then still has its name. It may also
send without reading, and the header Origin then has its name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

from sceneprint.errors import ForeignOrigin, Misdirected, SceneprintError
from sceneprint.settings import is_loopback

_HOST = re.compile(r"(?:\[(?P<v6>[^\[\]]*)\]|(?P<name>[^:\[\]]*))(?::\d*)?")


#: What a proxy adds to say for whom it asks.
_FORWARDING = frozenset(
    (b"forwarded", b"via", b"x-real-ip", b"x-client-ip", b"x-cluster-client-ip",
     b"true-client-ip", b"cf-connecting-ip")
)  # fmt: skip


def forwarded(headers: Mapping[bytes, bytes]) -> str | None:
    """The first header by which a proxy says that it asks for another; None where none does.

    What it says is not believed: anybody may write it.
    """
    for name in headers:
        if name in _FORWARDING or name.startswith(b"x-forwarded"):
            return name.decode("latin-1").title()
    return None


def stranger(
    headers: Iterable[tuple[bytes, bytes]], allows: Callable[[bytes], bool]
) -> SceneprintError | None:
    """Why a request for this machine alone is refused by its headers; None where it is not.

    Without a Host, as HTTP/1.0 may be, it is none of a browser's.

    Parameters
    ----------
    headers : of the request
    allows : whether pages of another origin may ask nevertheless
    """
    for name, value in headers:
        text = value.decode("latin-1").strip()
        if name == b"host" and not _is_here(text):
            return Misdirected(
                f"The request is for the host {text!r:.80}, and this service, which asks for no "
                "key, is for its own machine alone. Ask 127.0.0.1 or localhost; to serve others, "
                "let it listen on another address with `sceneprint serve --host`."
            )
        if name == b"origin" and not (_is_here(text.partition("://")[2]) or allows(value)):
            return ForeignOrigin(  # also of `null`
                f"A page of {text!r:.80} sent this, and this service, which asks for no key, "
                "takes only what pages of its own machine send. Serve the page from localhost, or "
                "name its origin in SCENEPRINT_CORS_ORIGINS."
            )
    return None


def _is_here(authority: str) -> bool:
    """Whether a host, with or without a port, is this machine."""
    found = _HOST.fullmatch(authority)
    return found is not None and is_loopback(found["v6"] or found["name"] or "")
