"""What a map holds, for people and dashboards: frames by their metadata, sessions, trajectories.

Each is read in one transaction, and a part at a time.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable

import numpy as np

from sceneprint.datasets import trajectory_row, trajectory_text
from sceneprint.engine.cursors import opened
from sceneprint.engine.wire import tell_frames, when
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Frame, Page
from sceneprint.schemas.browsing import FrameListing, Run, Session, Trajectory
from sceneprint.store import Store, browsing
from sceneprint.store.maps import find_map
from sceneprint.store.sessions import Held, count_run, list_runs, poses_of_run

#: Most poses of one trajectory: more are asked for in parts.
MOST_POSES = 100_000
#: Most parent frames that are told of a session.
_MOST_PARENTS = 20


def list_frames(
    store: Store, map_name: str, wanted: FrameListing, cursor: str | None, limit: int
) -> Page[Frame]:
    """Frames of a map in the order they came, or the newest first.

    Raises
    ------
    UnknownMap : no such map.
    InvalidRequest : a cursor that was not given out.
    """
    beyond = opened(store.seals, "frame", cursor)
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        found = browsing.list_frames(connection, row.number, beyond, limit + 1, wanted)
        items = tell_frames(connection, row, found[:limit])
    more = store.seals.seal("frame", found[limit - 1].number) if len(found) > limit else None
    return Page[Frame](items=items, next_cursor=more)


def list_sessions(store: Store, map_name: str, cursor: str | None, limit: int) -> Page[Session]:
    """Sessions of a map by their name and robot; frames that name none are one, the first.

    Raises
    ------
    UnknownMap : no such map.
    InvalidRequest : a cursor that was not given out.
    """
    after = None if cursor is None else _names_of(cursor)
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        found = list_runs(connection, row.number, after, limit + 1)
    more = len(found) > limit
    items = [_session(run) for run in found[:limit]]
    return Page[Session](items=items, next_cursor=_cursor(found[limit - 1]) if more else None)


def trajectory(store: Store, map_name: str, run: Run) -> Trajectory:
    """The poses of one run in the order of time; of frames of one time the first that came.

    Raises
    ------
    UnknownMap : no such map.
    InvalidRequest : the session is of several robots, or its poses lead to several frames, and it
        is not said which; or it has more than MOST_POSES.
    """
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        counted = count_run(connection, row.number, run)
        robot = _only("robot", run.robot, {one.robot for one in counted}, run.session)
        parents = {one.parent for one in counted if one.parent is not None}
        parent = _only("parent_frame", run.parent_frame, parents, run.session)
        total = sum(one.count for one in counted)
        if run.most is None and total > MOST_POSES:
            raise InvalidRequest(
                f"Session {run.session!r:.140} has {total} frames, and a trajectory at most "
                f"{MOST_POSES}. Ask for `most` of them, or for parts of it with `captured_after` "
                "and `captured_before`.",
                (("session", "too long for one answer"),),
            )
        only = run.model_copy(update={"robot": robot, "parent_frame": parent})
        kept, posed = ([], 0) if parent is None else poses_of_run(connection, row.number, only)
    return Trajectory(
        map=row.name,
        session=run.session,
        robot=robot,
        parent_frame=parent,
        frame_ids=[one.frame_id for one in kept],
        poses=[trajectory_row(one.at, np.array(one.pose)) for one in kept],
        posed=posed,
        left_out=total - len(kept),
    )


def trajectory_file(told: Trajectory) -> str:
    """A trajectory as a TUM file, which says in comments what its poses are of."""
    robot = "" if told.robot is None else f", robot {told.robot}"
    told_of = f"{len(told.poses)}"
    if told.posed > len(told.poses):
        told_of += f" of {told.posed}, evenly taken"
    comments = [
        f"map {told.map}, session {told.session}{robot}",
        f"poses of the sensors' frames in {told.parent_frame or 'no frame'}, metres",
        f"poses: {told_of}; frames left out: {told.left_out}",
        "t tx ty tz qx qy qz qw",
    ]
    return trajectory_text(told.poses, comments)


def _only(what: str, asked: str | None, found: Iterable[str | None], session: str) -> str | None:
    """The name that was asked for, or the only one that there is."""
    if asked is not None:
        return asked
    names = sorted(set(found), key=lambda name: name or "")
    if len(names) > 1:
        told = ", ".join("none" if name is None else repr(name)[:60] for name in names[:5])
        raise InvalidRequest(
            f"Session {session!r:.140} has frames of {len(names)} values of `{what}` ({told}), and "
            f"a trajectory is of one. Say which with `{what}`.",
            ((what, "needed: there are several"),),
        )
    return names[0] if names else None


def _session(run: Held) -> Session:
    return Session(
        robot=run.robot,
        session=run.session,
        frames=dict(sorted(run.states.items())),
        with_pose=run.posed,
        first_captured_at=when(run.first),
        last_captured_at=when(run.last),
        parent_frames=[name for name, _ in run.parents.most_common(_MOST_PARENTS)],
    )


def _cursor(run: Held) -> str:
    names = json.dumps([run.session or "", run.robot or ""])
    return base64.urlsafe_b64encode(names.encode()).decode().rstrip("=")


def _names_of(cursor: str) -> tuple[str, str]:
    try:
        names = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        session, robot = names
        if isinstance(session, str) and isinstance(robot, str):
            f"{session}{robot}".encode()  # half of a pair of surrogates is no text
            return session, robot
    except (ValueError, TypeError, RecursionError):  # whatever else somebody may think up
        pass
    raise InvalidRequest(
        f"The cursor {cursor!r:.40} was not given out. Take `next_cursor` of a page.",
        (("cursor", "not given out"),),
    )
