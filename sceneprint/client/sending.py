"""Requests to one service: sent until they are answered, and read as records."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from sceneprint import __version__
from sceneprint.errors import Unreachable
from sceneprint.settings import is_loopback

if TYPE_CHECKING:
    import httpx

    from sceneprint.client.messages import Record

#: Frames a page.
PAGE = 500


class Sender:
    """A service, and how to ask it; the base of every topic's calls over HTTP.

    Parameters
    ----------
    url : of it, with http:// or https://
    key : where it asks for one
    timeout_s : longest silence of the service

    Raises
    ------
    Unreachable : the address is none.
    """

    def __init__(self, url: str, key: str | None, timeout_s: float) -> None:
        import httpx

        from sceneprint.client.messages import Quiet

        self._url = url.rstrip("/")
        self._timeout_s = timeout_s
        self._met = False  # whether it has ever answered
        headers = {"User-Agent": f"sceneprint/{__version__}"}
        if key is not None:
            headers["Authorization"] = f"Bearer {key}"
        try:
            parsed = httpx.URL(self._url)
            if parsed.scheme not in ("http", "https") or not parsed.host:
                raise httpx.InvalidURL("it does not begin with http:// or https://")
            self._http = httpx.Client(
                base_url=self._url,
                headers=headers,
                timeout=timeout_s,
                trust_env=not is_loopback(parsed.host),  # no proxy stands before this machine
            )
        except (httpx.InvalidURL, UnicodeEncodeError, ValueError) as error:
            raise Unreachable(
                f"{url!r:.200} is not the address of a service, or the key is not one ({error}). "
                "Write it like http://127.0.0.1:8008."
            ) from error
        self._quiet = Quiet(self._url)
        logging.getLogger("httpx").addFilter(self._quiet)

    def close(self) -> None:
        """Close all connections."""
        logging.getLogger("httpx").removeFilter(self._quiet)
        self._http.close()

    def _ask(self, kind: type[Record], method: str, path: str, **request: Any) -> Record:
        """What it answers, as a record."""
        from sceneprint.client.messages import read

        return read(kind, self._send(method, path, **request))

    def _bytes(self, method: str, path: str, **request: Any) -> bytes:
        """What it answers, as it comes."""
        return self._send(method, path, **request).content

    def _delete(self, path: str) -> None:
        self._send("DELETE", path)

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Every call may be repeated: what is made is found, what was deleted is gone."""
        from sceneprint.client.problems import refusal
        from sceneprint.client.retrying import persist

        response, lost = persist(
            lambda: self._http.request(method, path, **request), self._url, met=self._met
        )
        self._met = True
        deleted_before = method == "DELETE" and lost > 0 and response.status_code == 404
        if response.is_success or deleted_before:
            return response
        raise refusal(response)


def given(**parameters: Any) -> dict[str, Any]:
    """Those parameters of a request that are not None."""
    return {name: value for name, value in parameters.items() if value is not None}
