"""Events of a service: those that are kept, and those that happen.

Half of the topic `operations` of the client; see there.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Protocol

from sceneprint.client.sending import Sender, given
from sceneprint.schemas.events import Event, EventPage

if TYPE_CHECKING:
    import httpx

    from sceneprint.engine import Engine

#: Events a page; and seconds between two looks for more, where the store is ours.
_PAGE, _LOOK_S = 500, 0.25
_EVENTS = "/v1/events"


class EventsBackend(Protocol):
    """What events need of whoever does the work."""

    def list_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None, cursor: str | None,
        limit: int, *, newest_first: bool,
    ) -> EventPage:  # fmt: skip
        """A page of the events that are kept."""

    def follow_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> Iterator[Event]:
        """Events as they happen, for ever."""


class RemoteEvents(Sender):
    """Over HTTP."""

    def list_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None, cursor: str | None,
        limit: int, *, newest_first: bool,
    ) -> EventPage:  # fmt: skip
        """A page of the events that are kept."""
        asked = given(
            map=map_name, kind=list(kinds), after=after, cursor=cursor, limit=limit,
            order="newest" if newest_first else "oldest",
        )  # fmt: skip
        return self._ask(
            EventPage, "GET", _EVENTS, params=asked, headers={"Accept": "application/json"}
        )

    def follow_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> Iterator[Event]:
        """Events as they happen, for ever."""
        from sceneprint.client.problems import refusal
        from sceneprint.client.retrying import persist
        from sceneprint.client.streams import SILENCE_S, followed

        def send(last: str | None) -> httpx.Response:
            request = self._http.build_request(
                "GET",
                _EVENTS,
                params=given(map=map_name, kind=list(kinds)),
                headers={"Accept": "text/event-stream"} | given(**{"Last-Event-ID": last}),
                timeout=SILENCE_S,
            )
            response = self._http.send(request, stream=True)
            if not response.is_success:
                response.read()
            return response

        def opened(last: str | None) -> httpx.Response:
            response, _ = persist(lambda: send(last), self._url, met=self._met)
            self._met = True
            if not response.is_success:
                raise refusal(response)
            return response

        return followed(opened, after)


class EmbeddedEvents:
    """In this process."""

    _engine: Engine

    def list_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None, cursor: str | None,
        limit: int, *, newest_first: bool,
    ) -> EventPage:  # fmt: skip
        """A page of the events that are kept."""
        return self._engine.operations.events(
            self._engine.operations.wanted(map_name, kinds), after=after, cursor=cursor,
            limit=limit, newest_first=newest_first,
        )  # fmt: skip

    def follow_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> Iterator[Event]:
        """Events as they happen, for ever; the store is looked at four times a second."""
        operations = self._engine.operations
        wanted = operations.wanted(map_name, kinds)
        found, place = operations.begin(wanted, after)
        while True:
            yield from found
            if not found:
                time.sleep(_LOOK_S)
            found, place = operations.read_on(wanted, place)


class Events:
    """The calls."""

    _backend: EventsBackend

    def events(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        follow: bool = True,
    ) -> Iterator[Event]:  # fmt: skip
        """Events in the order in which they happened: those that are kept, and those to come.

        A stream that breaks is taken up again where it broke, for as long as it takes: nothing is
        lost, and nothing comes twice. Where events are no longer kept, one of the kind
        `events.missed` stands in their place.

        Parameters
        ----------
        map_name : only of this map
        kinds : beginnings of the kinds that are wanted, such as `frame.`; default: all
        after : id of the event to begin behind, "0" for all that are kept; default: these, or the
            newest where they are followed
        follow : go on for ever with what happens; else end with what has happened

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a kind that cannot be one, or an id of no event.
        Unreachable : there is no service, when this is asked first.
        """
        if follow:
            return self._backend.follow_events(map_name, kinds, after)
        return self._kept_events(map_name, kinds, after)

    def event_page(
        self, map_name: str | None = None, *, kinds: Sequence[str] = (), after: str | None = None,
        cursor: str | None = None, limit: int = 100, newest_first: bool = True,
    ) -> EventPage:  # fmt: skip
        """Some of the events that are kept, the newest first; `cursor` is that of another page."""
        return self._backend.list_events(
            map_name, kinds, after, cursor, limit, newest_first=newest_first
        )

    def _kept_events(
        self, map_name: str | None, kinds: Sequence[str], after: str | None
    ) -> Iterator[Event]:
        cursor = None
        while True:
            page = self._backend.list_events(
                map_name, kinds, after, cursor, _PAGE, newest_first=False
            )
            yield from page.items
            cursor = page.next_cursor
            if cursor is None:
                return
