"""Continuous localization of a robot from the answers of a service and odometry.

    tracker = Tracker(client, "warehouse", camera=(525, 525, 319.5, 239.5))
    state = tracker.update(depth, T_odom_sensor, stamp=stamp)
    if state.status == "tracking":
        drive(state.T_map_odom)

frame, odometry  --Tracker.update-->  State
frame, odometry  --AsyncTracker.submit-->  State, without waiting
log  --replay-->  the same states
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from threading import Condition, RLock, Thread
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from sceneprint_client import errors
from sceneprint_client.api import FrameMeta, GivenPose, Localization, Prior
from sceneprint_client.http import frame_bytes
from sceneprint_client.poses import rigid_transform
from sceneprint_client.tracker_core import (
    Observation,
    PoseEvidence,
    State,
    TrackerCore,
    TrackerParameters,
    inverse,
    is_new_view,
    observation_of,
    spaced_views,
)

if TYPE_CHECKING:
    from typing_extensions import Self

    from sceneprint_client.client import Client
    from sceneprint_client.http import FrameInput, MetaInput

__all__ = ["AsyncTracker", "Observation", "State", "Tracker", "TrackerParameters", "replay"]

#: Errors after which the next query may succeed.
_AWAY = (errors.Unreachable, errors.Busy, errors.RateLimited, errors.StoreAway, errors.StoreLocked)
#: Maximum age of earlier frames in a query, seconds.
_MAXIMUM_AGE_S = 30.0
#: Lowest HTTP status that is a fault of the service or of a proxy.
_FIRST_FAULT = 500


@dataclass(frozen=True, eq=False)
class _View:
    """A frame in the form in which queries send it."""

    stamp: float
    T_odom_sensor: NDArray[np.float64]
    data: bytes
    meta: FrameMeta


class Tracker:
    """Pose of a robot in a map over time: `lost`, `ambiguous` or `tracking`, with T_map_odom.

    Each update sends one query and waits for the answer; AsyncTracker does not wait. While the
    robot is not tracked, a query contains the latest frames together (`TrackerParameters.frames`).

    Parameters
    ----------
    client : client of the service, or `Client.embedded`
    map_name : name of a map whose frames have poses
    camera : camera of frames that are arrays or bytes, as `meta` of `Client.localize`
    parameters : parameters; default: TrackerParameters()
    log : text file that receives one line per call for `replay`

    Raises
    ------
    SceneprintError : In `update`, if a retry cannot help, such as UnknownMap or a FrameError.
    """

    def __init__(
        self, client: Client, map_name: str, *, camera: MetaInput | None = None,
        parameters: TrackerParameters | None = None, log: TextIO | None = None,
    ) -> None:  # fmt: skip
        self._client, self._map, self._camera = client, map_name, camera
        self._core = TrackerCore(parameters)
        self._views: deque[_View] = deque(maxlen=self._core.parameters.frames)
        self._lock = RLock()
        self.epoch = 0  #: number of resets
        self._log = log
        self._write({"parameters": asdict(self._core.parameters)})

    def update(
        self, frame: FrameInput, odom_pose: NDArray[Any], up: Sequence[float] | None = None,
        stamp: float | None = None, *, meta: MetaInput | None = None,
    ) -> State:  # fmt: skip
        """Query the pose of a frame, and return the state after the answer.

        Parameters
        ----------
        frame : frame as for `Client.localize`
        odom_pose : (4, 4) T_odom_sensor at the capture of the frame, or
            T_odom_base @ T_base_sensor for odometry of the base
        up : unit vector in the sensor's axes, from an IMU
        stamp : capture time of the frame, seconds; default: now
        meta : metadata of the frame; default: `camera`

        Raises
        ------
        SceneprintError : If the frame or the map cannot be used. Without an answer the state
            follows the odometry instead.
        """
        stamp = time.time() if stamp is None else stamp
        return self.answer(frame, odom_pose, up, stamp, meta, self.epoch)

    def move(self, odom_pose: NDArray[Any], stamp: float | None = None) -> State:
        """Update the odometry between frames, and return the state."""
        stamp = time.time() if stamp is None else stamp
        with self._lock:
            state = self._core.move(stamp, np.asarray(odom_pose, np.float64))
            self._write({"stamp": stamp, "odometry": _flat_list(odom_pose)})
            return state

    def state(self) -> State:
        """Return the current state."""
        with self._lock:
            return self._core.state()

    def reset(self, reason: str = "it was reset") -> State:
        """Forget the pose, as after a lift, which odometry does not measure; return the state.

        The clock and the odometry may restart, and answers to earlier frames are ignored.
        """
        with self._lock:
            self.epoch += 1
            self._views.clear()
            self._write({"reset": reason})
            return self._core.reset(reason)

    def answer(
        self, frame: FrameInput, odom_pose: NDArray[Any], up: Sequence[float] | None,
        stamp: float, meta: MetaInput | None, epoch: int,
    ) -> State:  # fmt: skip
        """Send a query, and update and return the state as `update` does.

        If `epoch`, the attribute's value at the capture of the frame, has changed because of a
        reset, the answer is ignored.
        """
        T_odom_sensor = rigid_transform(np.asarray(odom_pose, np.float64))
        camera = self._camera if meta is None else meta
        view = _View(stamp, T_odom_sensor, *frame_bytes(frame, camera, with_pose=False, up=up))
        with self._lock:
            prior = self._core.prior(T_odom_sensor)
            earlier = self._earlier(view)
        observation, is_readable = self._observe(view, earlier, prior)
        with self._lock:
            if epoch != self.epoch:
                return self._core.state()
            state = self._core.update(stamp, T_odom_sensor, observation)
            if state.status == "tracking":
                self._views.clear()
            elif is_readable:
                self._remember(view)
            line = {"stamp": stamp, "odometry": _flat_list(odom_pose)}
            self._write({**line, "observation": _observation_json(observation)})
            return state

    def _earlier(self, view: _View) -> list[_View]:
        """Return the earlier frames of the next query; none while tracking."""
        views = [item for item in self._views if 0 <= view.stamp - item.stamp <= _MAXIMUM_AGE_S]
        poses = [item.T_odom_sensor for item in (*views, view)]
        places = spaced_views(poses, self._core.parameters.frames)
        return [views[place] for place in places[:-1]]

    def _remember(self, view: _View) -> None:
        """Store a frame for later queries, unless the robot has not moved since the last frame."""
        if not self._views or is_new_view(self._views[-1].T_odom_sensor, view.T_odom_sensor):
            self._views.append(view)

    def _observe(
        self, view: _View, earlier: list[_View], prior: PoseEvidence | None
    ) -> tuple[Observation, bool]:
        """Query a frame; return the evidence, and whether the service could read the frame."""
        try:
            answer, used = self._localize(view, earlier, prior)
        except errors.UselessFrame as error:
            return Observation("not_found", reason=str(error)), False
        except _AWAY as error:
            return Observation("unanswered", reason=f"no answer: {error}"), False
        except errors.Refused as error:
            if error.status < _FIRST_FAULT:
                raise
            return Observation("unanswered", reason=f"no answer: {error}"), False
        poses = tuple(item.T_odom_sensor for item in used)
        return replace(observation_of(answer), earlier=poses), True

    def _localize(
        self, view: _View, earlier: list[_View], prior: PoseEvidence | None
    ) -> tuple[Localization, list[_View]]:
        """Send a query; return its answer and the earlier frames that support it.

        If the service rejects the frames together, forget the earlier frames and send only `view`.
        """
        expected = None if prior is None else _prior_of(prior)
        if earlier:
            back = inverse(view.T_odom_sensor)  # the query uses poses relative to this frame
            views = [*earlier, view]
            metas = [_with_odometry(item.meta, back @ item.T_odom_sensor) for item in views]
            frames = [item.data for item in views]
            try:
                answer = self._client.localize_sequence(
                    self._map, frames, metas, keep=False, prior=expected
                )
            except (errors.FrameError, errors.TooLarge):
                pass  # a query with only this frame shows whether an earlier frame is the cause
            else:
                return answer, earlier
        answer = self._client.localize(self._map, view.data, view.meta, keep=False, prior=expected)
        if earlier:
            with self._lock:
                self._views.clear()
        return answer, []

    def _write(self, line: dict[str, Any]) -> None:
        if self._log is not None:
            self._log.write(json.dumps(line) + "\n")


class AsyncTracker:
    """A tracker that queries in its own thread, so that `submit` does not wait.

    During a query only the latest frame waits; older frames are dropped, but not their odometry.
    Close it, or use it in `with`.

    Parameters
    ----------
    tracker : tracker that nothing else updates
    """

    def __init__(self, tracker: Tracker) -> None:
        self.dropped = 0  #: number of frames that were replaced by a later frame
        self.answered = 0  #: number of queries that ended without an error
        self._tracker = tracker
        self._waiting: dict[str, Any] | None = None
        self._busy = self._closed = False
        self._error: Exception | None = None
        self._changed = Condition()
        self._thread = Thread(target=self._work, name="sceneprint-tracker", daemon=True)
        self._thread.start()

    def submit(
        self, frame: FrameInput, odom_pose: NDArray[Any], up: Sequence[float] | None = None,
        stamp: float | None = None, *, meta: MetaInput | None = None,
    ) -> State:  # fmt: skip
        """Pass a frame to the thread, and return the current state. See `Tracker.update`.

        Raise SceneprintError if an earlier frame or the map cannot be used.
        """
        stamp = time.time() if stamp is None else stamp
        epoch = self._tracker.epoch
        state = self._tracker.move(odom_pose, stamp)
        with self._changed:
            if self._error is not None:
                error, self._error = self._error, None
                raise error
            self.dropped += self._waiting is not None
            self._waiting = {
                "frame": frame, "odom_pose": odom_pose, "up": up, "stamp": stamp, "meta": meta,
                "epoch": epoch,
            }  # fmt: skip
            self._changed.notify_all()
        return state

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all frames have been processed; return False after a timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._waiting is None and not self._busy, timeout_s
            )

    def close(self) -> None:
        """Stop querying; wait for a query in progress."""
        with self._changed:
            self._closed, self._waiting = True, None
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting is not None or self._closed)
                if self._waiting is None:
                    return
                frame, self._waiting, self._busy = self._waiting, None, True
            try:
                self._tracker.answer(**frame)
            except Exception as error:
                with self._changed:
                    self._error = error
            else:
                with self._changed:
                    self.answered += 1


# A log of all calls, from which the states can be reproduced.


def replay(lines: Iterable[str], parameters: TrackerParameters | None = None) -> Iterator[State]:
    """Yield the states of a log that a tracker wrote, one for each call.

    Parameters
    ----------
    lines : lines of the log
    parameters : parameters to use instead of those of the log
    """
    core = TrackerCore(parameters)
    for text in lines:
        line = json.loads(text)
        if "parameters" in line:
            core = TrackerCore(parameters or TrackerParameters(**line["parameters"]))
        elif "reset" in line:
            yield core.reset(line["reset"])
        elif "observation" in line:
            yield core.update(
                line["stamp"], _matrix(line["odometry"]), _observation_from(line["observation"])
            )
        else:
            yield core.move(line["stamp"], _matrix(line["odometry"]))


def _flat_list(matrix: NDArray[Any]) -> list[float]:
    return [float(value) for value in np.asarray(matrix, np.float64).ravel()]


def _matrix(listed: list[float], size: int = 4) -> NDArray[np.float64]:
    return np.array(listed).reshape(size, size)


def _observation_json(observation: Observation) -> dict[str, Any]:
    poses = [
        {
            "parent_frame": evidence.parent_frame,
            "matrix": _flat_list(evidence.T_map_sensor),
            "weight": evidence.weight,
            "covariance": None if evidence.covariance is None else _flat_list(evidence.covariance),
        }
        for evidence in observation.poses
    ]
    return {
        "status": observation.status, "poses": poses, "strong": observation.strong,
        "by_prior": observation.by_prior, "reason": observation.reason,
        "earlier": [_flat_list(pose) for pose in observation.earlier],
    }  # fmt: skip


def _observation_from(line: dict[str, Any]) -> Observation:
    poses = tuple(
        PoseEvidence(
            entry["parent_frame"], _matrix(entry["matrix"]), entry["weight"],
            None if entry["covariance"] is None else _matrix(entry["covariance"], 6),
        )
        for entry in line["poses"]
    )  # fmt: skip
    earlier = tuple(map(_matrix, line["earlier"]))
    return Observation(
        line["status"], poses, line["strong"], line["by_prior"], line["reason"], earlier
    )


def _prior_of(pose: PoseEvidence) -> Prior:
    if pose.covariance is None:
        raise AssertionError("the prior of a tracker has a covariance")
    expected = GivenPose(parent_frame=pose.parent_frame, matrix=pose.T_map_sensor.tolist())
    return Prior(pose=expected, covariance=_flat_list(pose.covariance))


def _with_odometry(meta: FrameMeta, T_odom_sensor: NDArray[np.float64]) -> FrameMeta:
    pose = GivenPose(parent_frame="odom", matrix=T_odom_sensor.tolist())
    return meta.model_copy(update={"pose": pose})
