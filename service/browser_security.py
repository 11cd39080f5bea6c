"""What protects browsers and the service from pages of others: headers of every answer, checks of
Host and Origin, and CORS.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

from sceneprint.errors import ForeignOrigin, InvalidRequest, Misdirected, SceneprintError
from sceneprint.settings import Settings
from sceneprint_client.api.base import is_loopback

Headers = list[tuple[bytes, bytes]]

_ALWAYS: Headers = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
#: An answer is data: were it ever shown as a page, it could load and run nothing.
_NOTHING = b"default-src 'none'; frame-ancestors 'none'"


def security_headers(given: Headers) -> Headers:
    """Return the headers that an answer needs and does not have."""
    there = {name.lower() for name, _ in given}
    wanted = [
        *_ALWAYS,
        (b"content-security-policy", _NOTHING),
        (b"cache-control", b"no-store"),  # maps change, and answers are not for all
    ]
    return [(name, value) for name, value in wanted if name not in there]


# Who a request was meant for, and which page sent it, where only this machine is served.
#
# A service on a loopback address asks for no key: whoever reaches it is on this machine. So is a
# browser, and pages of others run in it. A page may let its own name point to 127.0.0.1 and read
# the answers as its own ("DNS rebinding"): the header Host then still has its name. It may also
# send without reading, and the header Origin then has its name; or load an address as a picture,
# which has no Origin, and the header Sec-Fetch-Site then says that a page did it. A link of others
# to a page of the service shows them nothing.

#: What Sec-Fetch-Site says of our own pages, and of who types an address or opens a bookmark.
_OWN_SITES = (b"same-origin", b"none")
#: Pages that links of others may lead to.
_PAGES = re.compile(r"/|/docs/?|/dashboard(/[^.]*)?")

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
    headers: Iterable[tuple[bytes, bytes]], allows: Callable[[bytes], bool], path: str = ""
) -> SceneprintError | None:
    """Why a request for this machine alone is refused by its headers; None where it is not.

    Without a Host, as HTTP/1.0 may be, it is none of a browser's.

    Parameters
    ----------
    allows : whether pages of another origin may ask nevertheless
    path : of the request: links of others may lead to pages of the service
    """
    fetch: dict[bytes, bytes] = {}
    for name, value in headers:
        if name == b"origin" or name.startswith(b"sec-fetch-"):
            fetch[name] = value.strip().lower()
        text = value.decode("latin-1").strip()
        if name == b"host" and not _is_here(text):
            return Misdirected(
                f"The request is for the host {text!r:.80}, but this service requires no key and "
                "so answers only its own machine. Use 127.0.0.1 or localhost; to serve others, "
                "listen on another address with `sceneprint serve --host`."
            )
        if name == b"origin" and not (_is_here(text.partition("://")[2]) or allows(value)):
            return ForeignOrigin(  # also of `null`
                f"A page of {text!r:.80} sent this request, but this service requires no key and "
                "so accepts requests only from pages on its own machine. Serve the page from "
                "localhost, or name its origin in SCENEPRINT_CORS_ORIGINS."
            )
    # a page that may ask says who it is: its Origin was looked at above
    if b"origin" in fetch or fetch.get(b"sec-fetch-site", b"none") in _OWN_SITES:
        return None
    if _PAGES.fullmatch(path) and fetch.get(b"sec-fetch-dest") == b"document":
        return None
    return ForeignOrigin(
        "A page of another origin loaded this address, but this service requires no key and so "
        "accepts requests only from its own pages. Open the address itself; or send the request "
        "with fetch(), and name the page's origin in SCENEPRINT_CORS_ORIGINS."
    )


def _is_here(authority: str) -> bool:
    """Whether a host, with or without a port, is this machine."""
    found = _HOST.fullmatch(authority)
    return found is not None and is_loopback(found["v6"] or found["name"] or "")


# Pages of other origins that may ask: what a browser wants to hear before it lets them.

#: What a page may read of an answer beside its body.
_EXPOSED = (
    "Accept-Ranges, Content-Disposition, Content-Range, ETag, Idempotent-Replayed, Location, "
    "Preference-Applied, RateLimit, RateLimit-Policy, Retry-After, X-Request-Id"
)
_CORS_METHODS = "GET, POST, PUT, PATCH, DELETE"
_SENT = (
    "Accept, Authorization, Content-Type, Idempotency-Key, If-Match, If-None-Match, If-Range, "
    "Last-Event-ID, Prefer, Range, X-Request-Id"
)
#: Seconds for which a browser need not ask again.
_MAX_AGE_S = 600


class Origins:
    """Origins whose pages may ask.

    No cookie is ever read, so that a page has only what its own code knows: a key where one is
    asked for. Credentials of the browser are therefore never allowed.

    Parameters
    ----------
    allowed : such as https://fleet.example; * for all
    """

    def __init__(self, allowed: Iterable[str]) -> None:
        self._allowed = {one.strip().rstrip("/").lower().encode() for one in allowed}

    def allows(self, origin: bytes) -> bool:
        """Whether pages of an origin may ask."""
        return b"*" in self._allowed or origin.strip().lower() in self._allowed

    def headers(self, origin: bytes | None) -> Headers:
        """What every answer to a page says; also to others, as a cache may keep it for pages."""
        if not self._allowed:
            return []
        if origin is None or not self.allows(origin):
            return [(b"vary", b"Origin")]
        return [
            (b"access-control-allow-origin", origin),
            (b"access-control-expose-headers", _EXPOSED.encode()),
            (b"vary", b"Origin"),
        ]


def origins_of(settings: Settings) -> Origins:
    """Return the origins that an operator allows. Raise InvalidRequest for `*` where no key is
    required: any page opened on this machine could then read and delete all maps.
    """
    if "*" in settings.cors_origins and not settings.asks_for_keys:
        raise InvalidRequest(
            f"SCENEPRINT_CORS_ORIGINS is * and the service listens on {settings.host}, where it "
            "requires no key: every web page that a browser on this machine opens would have "
            "full access. Name the origins, or set SCENEPRINT_REQUIRE_KEYS.",
            (("cors_origins", "all origins, but no key required"),),
        )
    return Origins(settings.cors_origins)


def is_preflight(method: str, headers: dict[bytes, bytes]) -> bool:
    """Whether a browser asks if a page may ask."""
    return method == "OPTIONS" and b"access-control-request-method" in headers


def preflight_headers() -> dict[str, str]:
    """What a page that may ask may send."""
    return {
        "Access-Control-Allow-Methods": _CORS_METHODS,
        "Access-Control-Allow-Headers": _SENT,
        "Access-Control-Max-Age": str(_MAX_AGE_S),
    }
