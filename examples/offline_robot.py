"""Spool the frames of a robot without a connection, and upload them when it is back.

    python examples/offline_robot.py drives/mapping office --spool office.spool
    python examples/offline_robot.py drives/mapping office --spool office.spool --copy copy

With `--copy FOLDER`, a copy of the map by `sceneprint pull`, it also localises without the service.

Replace `frames_of` by your camera. The program continues while the service is unreachable. Each
frame is on disk before the next one is taken, so a crash or an empty battery loses none. Run it
again at any time: frames that the map or the spool already has are not duplicated.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint_client import Client, Spool, meta_of
from sceneprint_client.api import FrameMeta
from sceneprint_client.errors import SceneprintError
from sceneprint_client.http import DEFAULT_URL

#: Number of frames between two attempts to upload.
TRY_EVERY = 50


def frames_of(folder: Path) -> Iterator[tuple[FrameReference, FrameMeta]]:
    """Yield frames with their metadata."""
    for sequence in find_sequences(folder):
        for frame in sequence.frames:
            yield frame, meta_of(frame, parent_frame=sequence.parent_frame)


def upload_waiting(client: Client, spool: Spool, map_name: str) -> bool:
    """Upload the waiting frames; return whether all were uploaded."""
    try:
        report = spool.sync(client, map_name, patience_s=30)
    except SceneprintError as error:  # unreachable, busy, or a wrong key or map
        print(f"offline, {spool.status().waiting} frames wait: {error}")
        return False
    print(f"uploaded {report.received}, already there {report.there}, refused {report.refused}")
    return True


def localise(robot: Client, map_name: str, frame: FrameReference, meta: FrameMeta) -> None:
    """Print the pose of a frame in the robot's own copy of the map."""
    place = robot.localize(map_name, frame, meta.model_copy(update={"pose": None}))
    print(f"{frame.path.name}: {place.status}")


def main() -> None:
    """Spool every frame, and localise and upload at intervals."""
    parser = argparse.ArgumentParser(description="Spool frames, and upload them when online.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("map")
    parser.add_argument("--spool", type=Path, default=Path("offline.spool"))
    parser.add_argument("--most-bytes", type=int, default=1 << 30)
    parser.add_argument("--copy", type=Path, help="copy of the map by `sceneprint pull`, for poses")
    parser.add_argument("--url", default=os.environ.get("SCENEPRINT_URL") or DEFAULT_URL)
    options = parser.parse_args()
    with ExitStack() as stack:
        client = stack.enter_context(Client(options.url))
        spool = stack.enter_context(Spool(options.spool, options.most_bytes))
        robot = stack.enter_context(Client.embedded(options.copy)) if options.copy else None
        for number, (frame, meta) in enumerate(frames_of(options.folder), 1):
            spool.add(frame, meta)
            if robot is not None and number % TRY_EVERY == 1:
                localise(robot, options.map, frame, meta)
            if number % TRY_EVERY == 0:
                upload_waiting(client, spool, options.map)
        upload_waiting(client, spool, options.map)
        for refusal in spool.refusals():
            print(f"{refusal.name}: {refusal.reason}")
        now = spool.status()
    print(f"{now.uploaded} uploaded, {now.waiting} wait, {now.thinned} thinned")


if __name__ == "__main__":
    main()
