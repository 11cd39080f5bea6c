"""Events, figures and models of a service.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from typing import Protocol

from sceneprint.client.events import EmbeddedEvents, Events, EventsBackend, RemoteEvents
from sceneprint.client.sending import given
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Map, Page
from sceneprint.schemas.operations import ModelInfo, Stats


class OperationsBackend(EventsBackend, Protocol):
    """What this topic needs of whoever does the work."""

    def stats(self, minutes: int, map_name: str | None) -> Stats:
        """How the service, or one map, does and did."""

    def list_models(self) -> list[ModelInfo]:
        """Models that maps can be signed with."""

    def reencode(self, map_name: str, model: str) -> Map:
        """Have a map signed with another model."""

    def cancel_reencoding(self, map_name: str) -> Map:
        """Let a map keep its model."""


class RemoteOperations(RemoteEvents):
    """Over HTTP."""

    def stats(self, minutes: int, map_name: str | None) -> Stats:
        """How the service, or one map, does and did."""
        asked = given(minutes=minutes, map=map_name)
        return self._ask(Stats, "GET", "/v1/stats", params=asked)

    def list_models(self) -> list[ModelInfo]:
        """Models that maps can be signed with."""
        return self._ask(Page[ModelInfo], "GET", "/v1/models").items

    def reencode(self, map_name: str, model: str) -> Map:
        """Have a map signed with another model."""
        from sceneprint.client.messages import map_path

        return self._ask(Map, "POST", f"{map_path(map_name)}/reencoding", json={"model": model})

    def cancel_reencoding(self, map_name: str) -> Map:
        """Let a map keep its model; asked twice, the second time there is nothing to give up."""
        from sceneprint.client.messages import map_path

        return self._ask(Map, "DELETE", f"{map_path(map_name)}/reencoding")


class EmbeddedOperations(EmbeddedEvents):
    """In this process."""

    def stats(self, minutes: int, map_name: str | None) -> Stats:
        """How the store, or one map, does and did."""
        return self._engine.operations.statistics.tell(minutes, map_name)

    def list_models(self) -> list[ModelInfo]:
        """Models that maps can be signed with."""
        return self._engine.operations.models()

    def reencode(self, map_name: str, model: str) -> Map:
        """Have a map signed with another model."""
        return self._engine.reencode(map_name, self._engine.operations.catalogue.find(model))

    def cancel_reencoding(self, map_name: str) -> Map:
        """Let a map keep its model."""
        return self._engine.cancel_reencode(map_name)


class Operations(Events):
    """The calls."""

    _backend: OperationsBackend

    def stats(self, map_name: str | None = None, *, minutes: int = 60) -> Stats:
        """How the service, or one map, does now and did in the last minutes, at most 60.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : too many minutes, or none.
        """
        if not 1 <= minutes <= 60:
            raise InvalidRequest(
                f"{minutes} minutes of history were asked for. Give 1 to 60.",
                (("minutes", "out of its range"),),
            )
        return self._backend.stats(minutes, map_name)

    def models(self) -> list[ModelInfo]:
        """Models that maps can be signed with: those that ship, and those that maps have or had."""
        return self._backend.list_models()

    def reencode(self, map_name: str, model: str) -> Map:
        """Have a map signed with another model, to which it switches when all frames are.

        Parameters
        ----------
        map_name : of the map
        model : `depth`, `lidar`, `paper`, or the id or label of one of `models`

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : no such model.
        Conflict : it is the map's model, or the map is being signed with a third one.
        """
        return self._backend.reencode(map_name, model)

    def cancel_reencoding(self, map_name: str) -> Map:
        """Let a map keep the model that it has.

        Raises
        ------
        UnknownMap : no such map.
        Conflict : no other model is on its way.
        """
        return self._backend.cancel_reencoding(map_name)
