"""Tests of pages of lists, which must equal pydantic's output."""

from __future__ import annotations

import asyncio
import threading
from datetime import UTC, datetime

import httpx
import pytest
from fastapi import APIRouter, FastAPI
from pydantic import TypeAdapter, field_serializer

from sceneprint_client.api import Page
from sceneprint_client.api.admin import EventPage
from sceneprint_client.api.base import ApiRecord, Direction
from service.auth import ListRoute, page_response


class _Row(ApiRecord):
    name: str
    at: datetime
    up: Direction | None = None


#: Threads that wrote a row as JSON.
_WRITERS = []


class _Traced(ApiRecord):
    number: int

    @field_serializer("number")
    def write(self, number):
        _WRITERS.append(threading.get_ident())
        return number


_ROWS = [
    _Row(name='"quotes", \\ and ü\n', at=datetime(2026, 11, 27, 8, 30, tzinfo=UTC)),
    _Row(name="next", at=datetime(1970, 1, 1, tzinfo=UTC), up=Direction(x=0.1, y=-0.0, z=1e-300)),
]


@pytest.mark.parametrize("rows", [[], _ROWS[:1], _ROWS], ids=len)
@pytest.mark.parametrize("cursor", [None, 'a"b'])
def test_a_page_is_the_text_that_pydantic_writes(rows, cursor):
    page = Page[_Row](items=rows, next_cursor=cursor)
    assert page_response(page).body == TypeAdapter(Page[_Row]).dump_json(page, by_alias=True)


def test_a_page_of_a_kind_of_its_own_keeps_what_it_has_beside_items():
    page = EventPage(items=[], next_cursor="next", newest="newest")
    written = page_response(page).body
    assert written == b'{"items":[],"next_cursor":"next","newest":"newest"}'
    assert written == page.model_dump_json(by_alias=True).encode()


def test_rows_are_not_written_in_the_event_loop():
    _WRITERS.clear()
    router, app = APIRouter(route_class=ListRoute), FastAPI()

    @router.get("/rows")
    def list_rows(limit: int) -> Page[_Traced]:
        return Page[_Traced](items=[_Traced(number=i) for i in range(limit)])

    app.include_router(router)

    async def ask():
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return threading.get_ident(), await client.get("/rows?limit=3")

    loop, answer = asyncio.run(ask())
    assert answer.json() == {"items": [{"number": i} for i in range(3)], "next_cursor": None}
    assert answer.headers["content-type"] == "application/json"
    assert len(_WRITERS) == 3
    assert loop not in _WRITERS
