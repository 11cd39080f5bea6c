"""Protection against foreign web pages: security headers, checks of Host and Origin, and CORS."""

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
    # A browser that displays a response as a page must not load or run anything.
    (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'"),
    (b"cache-control", b"no-store"),  # maps change, and responses depend on the key
]


def security_headers(headers: Headers) -> Headers:
    """Return the security headers that a response lacks."""
    present = {name.lower() for name, _ in headers}
    return [(name, value) for name, value in _ALWAYS if name not in present]


# Checks of requests to a service that serves only its own machine.
#
# A service on a loopback address requires no key, because only processes of this machine reach it.
# Among them are browsers, which run foreign pages. A foreign page can make its own host name
# resolve to 127.0.0.1 and read the responses ("DNS rebinding"); Host then contains this name. It
# can send requests without reading the responses; Origin then names the page. It can load an
# address as an image, without Origin; Sec-Fetch-Site then states that a page sent the request.
# Foreign links to a page of the service are allowed, because the foreign page learns nothing.

#: Values of Sec-Fetch-Site for the service's own pages, and for typed addresses and bookmarks.
_OWN_SITES = (b"same-origin", b"none")
#: Paths of pages that foreign links may open.
_PAGES = re.compile(r"/|/docs/?|/dashboard(/[^.]*)?")

_HOST = re.compile(r"(?:\[(?P<v6>[^\[\]]*)\]|(?P<name>[^:\[\]]*))(?::\d*)?")


#: Prefixes of the headers that most proxies add. Behind other proxies, set SCENEPRINT_REQUIRE_KEYS.
_FORWARDING = (b"forwarded", b"x-forwarded", b"x-real-ip", b"via")


def forwarded(headers: Mapping[bytes, bytes]) -> str | None:
    """Return the name of the first header that a proxy has added; None if there is none.

    The value of the header is not used, because any client can send it.
    """
    names = (name for name in headers if name.startswith(_FORWARDING))
    return next((name.decode("latin-1").title() for name in names), None)


def foreign_request_error(
    headers: Iterable[tuple[bytes, bytes]], allows: Callable[[bytes], bool], path: str = ""
) -> SceneprintError | None:
    """Return the error that refuses a request to a loopback service; None to accept the request.

    Requests without Host (HTTP/1.0) are accepted, because browsers always send Host.

    Parameters
    ----------
    allows : function that returns whether pages of an origin may send requests
    path : path of the request; foreign links to pages of the service are accepted
    """
    fetch: dict[bytes, bytes] = {}
    for name, value in headers:
        if name == b"origin" or name.startswith(b"sec-fetch-"):
            fetch[name] = value.strip().lower()
        text = value.decode("latin-1").strip()
        if name == b"host" and not _is_here(text):
            return Misdirected(
                f"The request is for the host {text!r:.80}, but this service requires no key, so "
                "it accepts only requests to its own machine. Use 127.0.0.1 or localhost. To serve "
                "other machines, listen on another address with `sceneprint serve --host`."
            )
        if name == b"origin" and not (_is_here(text.partition("://")[2]) or allows(value)):
            return ForeignOrigin(  # the origin `null` is refused too
                f"A page of {text!r:.80} sent this request, but this service requires no key, so "
                "it accepts requests only from pages on its own machine. Serve the page from "
                "localhost, or add its origin to SCENEPRINT_CORS_ORIGINS."
            )
    # A request with Origin has passed the check above.
    if b"origin" in fetch or fetch.get(b"sec-fetch-site", b"none") in _OWN_SITES:
        return None
    if _PAGES.fullmatch(path) and fetch.get(b"sec-fetch-dest") == b"document":
        return None
    return ForeignOrigin(
        "A page of another origin loaded this address, but this service requires no key, so it "
        "accepts requests only from its own pages. Open the address directly, or send the request "
        "with fetch() and add the page's origin to SCENEPRINT_CORS_ORIGINS."
    )


def _is_here(authority: str) -> bool:
    """Return whether a host, optionally with a port, is a loopback address."""
    match = _HOST.fullmatch(authority)
    return match is not None and is_loopback(match["v6"] or match["name"] or "")


# CORS: pages of other origins that may send requests.

#: Response headers that pages may read.
_EXPOSED = (
    "Accept-Ranges, Content-Disposition, Content-Range, ETag, Idempotent-Replayed, Location, "
    "Preference-Applied, Retry-After, X-Request-Id"
)
_SENT = (
    "Accept, Authorization, Content-Type, Idempotency-Key, If-Match, If-None-Match, If-Range, "
    "Last-Event-ID, Prefer, Range, X-Request-Id"
)
#: Headers of the response to a preflight request, which browsers cache for ten minutes.
PREFLIGHT_HEADERS = {
    "Access-Control-Allow-Methods": "GET, POST, PUT, PATCH, DELETE",
    "Access-Control-Allow-Headers": _SENT,
    "Access-Control-Max-Age": "600",
}


class Origins:
    """Origins whose pages may send requests.

    The service reads no cookies, and a page sends its key itself, so credentials of the browser are
    never allowed.

    Parameters
    ----------
    allowed : origins such as https://fleet.example; * allows all
    """

    def __init__(self, allowed: Iterable[str]) -> None:
        self._allowed = {origin.strip().rstrip("/").lower().encode() for origin in allowed}

    def allows(self, origin: bytes) -> bool:
        """Return whether pages of an origin may send requests."""
        return b"*" in self._allowed or origin.strip().lower() in self._allowed

    def headers(self, origin: bytes | None) -> Headers:
        """Return the CORS headers of a response, including Vary for caches."""
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
    """Return the allowed origins. Raise InvalidRequest for `*` if no key is required: any page
    opened on this machine could then read and delete all maps.
    """
    if "*" in settings.cors_origins and not settings.asks_for_keys:
        raise InvalidRequest(
            f"SCENEPRINT_CORS_ORIGINS is * and the service listens on {settings.host}, where it "
            "requires no key, so every web page that is opened in a browser on this machine would "
            "have full access. List the origins, or set SCENEPRINT_REQUIRE_KEYS.",
            (("cors_origins", "all origins, but no key required"),),
        )
    return Origins(settings.cors_origins)
