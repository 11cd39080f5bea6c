"""What every answer says to browsers and caches, whatever made it."""

from __future__ import annotations

Headers = list[tuple[bytes, bytes]]

_ALWAYS: Headers = [
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
#: An answer is data: were it ever shown as a page, it could load and run nothing.
_NOTHING = b"default-src 'none'; frame-ancestors 'none'"
#: The pages of the documentation load Swagger UI and ReDoc from where FastAPI has them.
_DOCS = (
    b"default-src 'none'; script-src https://cdn.jsdelivr.net 'unsafe-inline'; "
    b"style-src https://cdn.jsdelivr.net https://fonts.googleapis.com 'unsafe-inline'; "
    b"font-src https://fonts.gstatic.com; img-src https: data:; worker-src blob:; "
    b"connect-src 'self'; frame-ancestors 'none'"
)
_DOC_PATHS = ("/docs", "/docs/oauth2-redirect", "/redoc")


def guards(path: str, given: Headers) -> Headers:
    """Headers that an answer needs and has not.

    Parameters
    ----------
    path : that was asked for
    given : headers that the answer has
    """
    there = {name.lower() for name, _ in given}
    wanted = [
        *_ALWAYS,
        (b"content-security-policy", _DOCS if path in _DOC_PATHS else _NOTHING),
        (b"cache-control", b"no-store"),  # maps change, and answers are not for all
    ]
    return [(name, value) for name, value in wanted if name not in there]
