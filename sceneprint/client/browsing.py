"""What a map holds: frames by their metadata, sessions, trajectories.

A part of the topic of outputs: what it needs of a backend, both backends, and the calls.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, Protocol

from sceneprint.client.frames import checked
from sceneprint.client.messages import map_path
from sceneprint.client.sending import PAGE, Sender, given
from sceneprint.schemas import Frame, FrameState, Page
from sceneprint.schemas.browsing import FrameListing, Run, Session, Trajectory
from sceneprint.schemas.growth import By, Growth, GrowthOf

if TYPE_CHECKING:
    from sceneprint.engine import Engine


class BrowsingBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def list_frames(self, map_name: str, cursor: str | None, wanted: FrameListing) -> Page[Frame]:
        """A page of the frames of a map."""

    def list_sessions(self, map_name: str, cursor: str | None) -> Page[Session]:
        """A page of the sessions of a map."""

    def trajectory(self, map_name: str, run: Run) -> Trajectory:
        """The poses of a run."""

    def trajectory_text(self, map_name: str, run: Run) -> str:
        """The same as a TUM file."""

    def growth(self, map_name: str, asked: GrowthOf) -> Growth:
        """How a map grew."""


class RemoteBrowsing(Sender):
    """Over HTTP."""

    def list_frames(self, map_name: str, cursor: str | None, wanted: FrameListing) -> Page[Frame]:
        """A page of the frames of a map."""
        asked = wanted.model_dump(mode="json", exclude_defaults=True)
        parameters = {**asked, **given(cursor=cursor), "limit": PAGE}
        return self._ask(Page[Frame], "GET", f"{map_path(map_name)}/frames", params=parameters)

    def list_sessions(self, map_name: str, cursor: str | None) -> Page[Session]:
        """A page of the sessions of a map."""
        parameters = given(cursor=cursor, limit=PAGE)
        return self._ask(Page[Session], "GET", f"{map_path(map_name)}/sessions", params=parameters)

    def trajectory(self, map_name: str, run: Run) -> Trajectory:
        """The poses of a run."""
        return self._ask(Trajectory, "GET", **_of_run(map_name, run, "application/json"))

    def trajectory_text(self, map_name: str, run: Run) -> str:
        """The same as a TUM file."""
        return self._bytes("GET", **_of_run(map_name, run, "text/plain")).decode()

    def growth(self, map_name: str, asked: GrowthOf) -> Growth:
        """How a map grew."""
        path = f"{map_path(map_name)}/growth"
        return self._ask(Growth, "GET", path, params=asked.model_dump())


class EmbeddedBrowsing:
    """In this process."""

    _engine: Engine

    def list_frames(self, map_name: str, cursor: str | None, wanted: FrameListing) -> Page[Frame]:
        """A page of the frames of a map."""
        return self._engine.list_frames(map_name, cursor, PAGE, wanted=wanted)

    def list_sessions(self, map_name: str, cursor: str | None) -> Page[Session]:
        """A page of the sessions of a map."""
        from sceneprint.engine.browsing import list_sessions

        return list_sessions(self._engine.store, map_name, cursor, PAGE)

    def trajectory(self, map_name: str, run: Run) -> Trajectory:
        """The poses of a run."""
        from sceneprint.engine.browsing import trajectory

        return trajectory(self._engine.store, map_name, run)

    def trajectory_text(self, map_name: str, run: Run) -> str:
        """The same as a TUM file."""
        from sceneprint.engine.browsing import trajectory_file

        return trajectory_file(self.trajectory(map_name, run))

    def growth(self, map_name: str, asked: GrowthOf) -> Growth:
        """How a map grew."""
        from sceneprint.engine.growth import growth

        return growth(self._engine.store, map_name, asked.by, asked.last)


class Browsing:
    """The calls."""

    _backend: BrowsingBackend

    def frames(
        self, map_name: str, state: FrameState | None = None, *,
        robot: str | Iterable[str] = (), session: str | Iterable[str] = (),
        tags: str | Iterable[str] = (), captured_after: datetime | None = None,
        captured_before: datetime | None = None, received_after: datetime | None = None,
        received_before: datetime | None = None, parent_frame: str | None = None,
        has_pose: bool | None = None, content_id: str | None = None,
        order: Literal["asc", "desc"] = "asc",
    ) -> Iterator[Frame]:  # fmt: skip
        """Frames of a map in the order they came; deleted ones only where asked for.

        All that is given must hold; a frame that lacks what is asked about is left out.

        Parameters
        ----------
        map_name : of the map
        state : in this one
        robot, session : by this one, or one of these
        tags : it has all of them
        captured_after, captured_before : taken then or later, then or earlier; with a time zone
        received_after, received_before : uploaded then or later, then or earlier
        parent_frame : its pose leads there
        has_pose : whether it has one
        content_id : of its samples and camera, or points and viewpoint
        order : "desc" for the newest first

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a name that none can be, or a time without zone.
        """
        wanted = checked(
            FrameListing, "The list", state=state, robot=_names(robot), session=_names(session),
            tag=_names(tags), captured_after=captured_after, captured_before=captured_before,
            received_after=received_after, received_before=received_before,
            parent_frame=parent_frame, has_pose=has_pose, content_id=content_id, order=order,
        )  # fmt: skip
        return self._rest(map_name, wanted, self._backend.list_frames(map_name, None, wanted))

    def sessions(self, map_name: str) -> Iterator[Session]:
        """Runs of a map by session and robot: how many frames, when, where their poses lead.

        Raises
        ------
        UnknownMap : no such map.
        """
        page = self._backend.list_sessions(map_name, None)
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_sessions(map_name, page.next_cursor)
            yield from page.items

    def trajectory(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Literal["captured", "received"] = "captured",
    ) -> Trajectory:  # fmt: skip
        """The poses of a run in the order of time.

        Parameters
        ----------
        map_name : of the map
        session : of the run
        robot : needed where several called a run so
        parent_frame : needed where the poses lead to several
        captured_after, captured_before : a part of it; with a time zone
        clock : `received` has frames too that do not say when they were taken, as they came
        most : poses, evenly taken along it, at most so many; `posed` tells how many there are

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : it is not clear which run is meant, or it is too long for one answer.
        """
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return self._backend.trajectory(map_name, run)

    def trajectory_text(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Literal["captured", "received"] = "captured",
    ) -> str:  # fmt: skip
        """As `trajectory`, as text of a TUM file."""
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return self._backend.trajectory_text(map_name, run)

    def growth(self, map_name: str, by: By = "day", last: int = 30) -> Growth:
        """How many frames a map has by the hour or the day (UTC) in which they were indexed.

        Parameters
        ----------
        map_name : of the map
        by : what is counted by
        last : hours or days, with the one that is not over; at most 400

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : neither hours nor days, or too many.
        """
        return self._backend.growth(map_name, checked(GrowthOf, "The growth", by=by, last=last))

    def _rest(self, map_name: str, wanted: FrameListing, page: Page[Frame]) -> Iterator[Frame]:
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_frames(map_name, page.next_cursor, wanted)
            yield from page.items


def _names(given: str | Iterable[str]) -> list[str]:
    return [given] if isinstance(given, str) else list(given)


def _run(
    session: str, robot: str | None, parent_frame: str | None, after: datetime | None,
    before: datetime | None, most: int | None, clock: Literal["captured", "received"],
) -> Run:  # fmt: skip
    return checked(
        Run, "The run", session=session, robot=robot, parent_frame=parent_frame,
        captured_after=after, captured_before=before, most=most,
        clock=clock,
    )  # fmt: skip


def _of_run(map_name: str, run: Run, accept: str) -> dict[str, Any]:
    """Arguments of a request for a trajectory."""
    parameters = run.model_dump(mode="json", exclude_none=True)
    path = f"{map_path(map_name)}/trajectory"
    return {"path": path, "params": parameters, "headers": {"Accept": accept}}
