"""Pages of other origins that may ask: what a browser wants to hear before it lets them."""

from __future__ import annotations

from collections.abc import Iterable

from sceneprint.errors import InvalidRequest
from sceneprint.settings import Settings

Headers = list[tuple[bytes, bytes]]

#: What a page may read of an answer beside its body.
_EXPOSED = (
    "Accept-Ranges, Content-Disposition, Content-Range, ETag, Idempotent-Replayed, Location, "
    "Preference-Applied, RateLimit, RateLimit-Policy, Retry-After, X-Request-Id"
)
_METHODS = "GET, POST, PUT, PATCH, DELETE"
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
    """The origins that an operator allows.

    Raises
    ------
    InvalidRequest : all, where no key is asked for: any page that is opened on this machine could
        then read and delete all maps.
    """
    if "*" in settings.cors_origins and not settings.asks_for_keys:
        raise InvalidRequest(
            f"SCENEPRINT_CORS_ORIGINS is * and the service listens on {settings.host}, where no "
            "key is asked for: every web page that a browser here opens could do all with it. "
            "Name the origins, or set SCENEPRINT_REQUIRE_KEYS.",
            (("cors_origins", "all, where no key is asked for"),),
        )
    return Origins(settings.cors_origins)


def is_preflight(method: str, headers: dict[bytes, bytes]) -> bool:
    """Whether a browser asks if a page may ask."""
    return method == "OPTIONS" and b"access-control-request-method" in headers


def preflight_headers() -> dict[str, str]:
    """What a page that may ask may send."""
    return {
        "Access-Control-Allow-Methods": _METHODS,
        "Access-Control-Allow-Headers": _SENT,
        "Access-Control-Max-Age": str(_MAX_AGE_S),
    }
