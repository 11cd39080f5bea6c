"""Send the frames and odometry of a recording to a `Tracker`, like a live robot.

    python examples/live_from_bag.py office drives/later --truth drives/later.tum

The map has frames with poses, such as those of `sceneprint upload office drives/mapping`. The
program prints T_map_odom while it is tracked, as a robot would publish it. `--url` uses a service
(default: http://127.0.0.1:8008), `--data` a data folder without a service.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from pathlib import Path

import numpy as np

from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.formats.recording.selection import RecordingOptions
from sceneprint.types import Floats
from sceneprint_client import Client, Tracker
from sceneprint_client.http import DEFAULT_URL
from sceneprint_client.tracker import State


def frames_of(bag: Path) -> tuple[FrameReference, ...]:
    """Return all frames of a recording, with poses from odometry."""
    sequence, *others = find_sequences(bag, RecordingOptions(pose_frame="odom", keyframe_m=0))
    if others:
        raise SystemExit(f"{bag}: Its stamps go back. Split it there, and specify a part.")
    print(sequence.note)
    return sequence.frames


def line_of(state: State, elapsed: float, truth: Floats | None) -> str:
    """Return a state as text, with the error of the camera's position if the truth is known."""
    text = f"{elapsed:5.1f} s  {state.status:9}"
    if state.T_map_odom is None or state.T_map_sensor is None or state.covariance is None:
        return f"{text} {state.reason}"
    x, y, z = state.T_map_odom[:3, 3]
    yaw = np.degrees(np.arctan2(state.T_map_odom[1, 0], state.T_map_odom[0, 0]))
    sure = 100 * np.sqrt(np.trace(state.covariance[:3, :3]))
    text += f" {state.parent_frame} <- odom: {x:6.2f} {y:6.2f} {z:6.2f} m, yaw {yaw:6.1f} deg"
    text += f", +-{sure:.0f} cm"
    return text if truth is None else f"{text}, off by {100 * error_of(state, truth):.1f} cm"


def error_of(state: State, truth: Floats) -> float:
    """Return the distance of the camera from the true position (x, y, z), metres."""
    assert state.T_map_sensor is not None
    return float(np.linalg.norm(state.T_map_sensor[:3, 3] - truth))


def play(client: Client, map_name: str, bag: Path, truth: Path | None = None) -> list[float]:
    """Play a recording to a tracker; return the error of each tracked position, metres."""
    frames = frames_of(bag)
    rows = np.loadtxt(truth, ndmin=2) if truth is not None else np.empty((0, 8))
    tracker = Tracker(client, map_name)
    seen: Counter[str] = Counter()
    errors, first = [], None
    begin = frames[0].timestamp or 0.0
    for frame in frames:
        if frame.pose is None or frame.timestamp is None:  # no odometry at this time
            continue
        up = None if frame.camera is None else frame.camera.up
        state = tracker.update(frame, frame.pose, up=up, stamp=frame.timestamp)
        near = rows[np.abs(rows[:, 0] - frame.timestamp) < 1e-3]
        place = near[0, 1:4] if len(near) else None
        elapsed = frame.timestamp - begin
        print(line_of(state, elapsed, place))
        seen[state.status] += 1
        if state.status == "tracking":
            first = elapsed if first is None else first
            if place is not None:
                errors.append(error_of(state, place))
    when = "no fix" if first is None else f"first fix after {first:g} s"
    print(f"tracking on {seen['tracking']} of {seen.total()} frames, {when}")
    if errors:
        print(f"position error: {100 * np.median(errors):.1f} cm, at most {100 * max(errors):.1f}")
    return errors


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("map", help="name of the map")
    parser.add_argument("bag", type=Path, help=".mcap, .db3 or .bag file, or rosbag2 folder")
    parser.add_argument("--truth", type=Path, help="true TUM trajectory of the camera")
    url = os.environ.get("SCENEPRINT_URL") or DEFAULT_URL
    parser.add_argument("--url", default=url, help=f"address of a service (default: {url})")
    parser.add_argument("--key", help="key of the service, if it requires one")
    parser.add_argument("--data", help="data folder, without a service")
    options = parser.parse_args()
    embedded = options.data is not None
    with Client.embedded(options.data) if embedded else Client(options.url, options.key) as client:
        play(client, options.map, options.bag, options.truth)


if __name__ == "__main__":
    main()
