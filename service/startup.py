"""Startup of the service: `/healthz` responds at once, while the application is being loaded.

    uvicorn  -->  Front  -->  the application, once it is loaded

All other requests wait until the application is loaded, approximately one second.
"""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable
from typing import TYPE_CHECKING

from starlette.responses import JSONResponse

from sceneprint import __version__
from sceneprint.settings import Settings
from service.browser_security import foreign_request_error, security_headers

if TYPE_CHECKING:
    from fastapi import FastAPI
    from starlette.types import Receive, Scope, Send


class Front:
    """An ASGI application that loads the real application in a thread. If this fails, it calls
    `failed`, and `error` contains the cause.
    """

    def __init__(
        self, settings: Settings, load: Callable[[], FastAPI], failed: Callable[[], None]
    ) -> None:
        self._load, self._failed = load, failed
        self._alone = not settings.asks_for_keys
        self._loaded, self._stop = asyncio.Event(), asyncio.Event()
        #: The application after it is loaded, and the error if it could not be loaded.
        self.app: FastAPI | None = None
        self.error: Exception | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle the lifespan of the service or one request."""
        if scope["type"] == "lifespan":
            await self._live(receive, send)
            return
        if self.app is None:
            if self._is_harmless(scope):
                content = {"status": "ok", "version": __version__}  # the application sends the same
                response = JSONResponse(content, headers={"X-Request-Id": uuid.uuid4().hex})
                response.raw_headers += security_headers(response.raw_headers)
                await response(scope, receive, send)
                return
            await self._loaded.wait()
        if self.app is None:
            raise RuntimeError("the service could not start") from self.error
        await self.app(scope, receive, send)

    def _is_harmless(self, scope: Scope) -> bool:
        """Return whether a request is for `/healthz`, and not from a page of another site."""
        asks = scope["path"] == "/healthz" and scope["method"] in ("GET", "HEAD")
        headers = scope["headers"]
        if not asks or any(name == b"origin" for name, _ in headers):
            return False
        return not self._alone or foreign_request_error(headers, lambda _: False) is None

    async def _live(self, receive: Receive, send: Send) -> None:
        """Run the application until the server stops it."""
        await receive()
        running = asyncio.create_task(self._run())
        await send({"type": "lifespan.startup.complete"})
        await receive()
        self._stop.set()
        await running
        await send({"type": "lifespan.shutdown.complete"})

    async def _run(self) -> None:
        try:
            app = await asyncio.to_thread(self._load)
            async with app.router.lifespan_context(app):
                self.app = app
                self._loaded.set()
                await self._stop.wait()
        except Exception as error:
            self.error = error
            self._failed()
        finally:
            self._loaded.set()
