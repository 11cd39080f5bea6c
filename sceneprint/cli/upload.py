"""`sceneprint upload`: uploads of frames to a map of a service."""

from __future__ import annotations

import argparse
import math
import shlex
import statistics
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.cli import positive, positive_number
from sceneprint.cli.bag import (
    add_recording_options,
    print_note,
    recording_options,
    with_depth_scale,
)
from sceneprint.cli.imports import (
    STALL_S,
    TimeLimit,
    add_map_options,
    axis_or_up,
    check_map_options,
    hint_at_maps,
    import_archives,
    import_maps,
    is_archive_file,
    unsigned_reason,
)
from sceneprint.cli.options import (
    add_service_options,
    add_signing_options,
    add_up_option,
    base_of,
    mounting_of,
    open_client,
    up_of,
)
from sceneprint.cli.output import one_line, print_error, progress_bar
from sceneprint.errors import (
    DatasetError,
    FrameConflict,
    FrameError,
    InvalidRequest,
    MapExists,
    MissingDependency,
    Refused,
    UnknownMap,
)
from sceneprint.formats.dataset import FrameReference, FrameSequence, find_sequences
from sceneprint_client.api.maps import PRESETS
from sceneprint_client.sidecars import row_of

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api import Added, FrameMeta, Job
    from sceneprint_client.api.frames import SampleRange, UploadSummary
    from sceneprint_client.api.listing import Session

# Outcomes of uploaded frames.


@dataclass
class Tally:
    """Counts of uploaded frames by outcome."""

    new: int = 0
    there: int = 0  #: frames that the map already had
    refused: int = 0
    indexed: int = 0
    rejected: int = 0
    failed: int = 0
    redundant: int = 0  #: frames of places that the map already covered
    #: Names of unsigned frames by job; frames with the same content share a job.
    waiting: dict[str, list[str]] = field(default_factory=dict)
    errors: list[tuple[str, str]] = field(default_factory=list)  #: frame name and reason
    ranges: list[SampleRange] = field(default_factory=list)  #: ranges of received frames
    summaries: list[str] = field(default_factory=list)  #: summaries of archives
    lost: int = 0  #: frames and poses that could not be sent

    def count(self, name: str, added: Added, new: bool) -> None:
        """Count an accepted frame, new or already in the map."""
        from sceneprint_client.api import FrameState

        self.new += new
        self.there += not new
        if added.samples is not None:
            self.ranges.append(added.samples)
        if added.state in (FrameState.RECEIVED, FrameState.SIGNING):
            self.waiting.setdefault(added.job_id, []).append(name)
        elif added.state is FrameState.INDEXED:
            self.indexed += 1
        elif added.state is FrameState.REDUNDANT:
            self.redundant += 1
        else:
            self._lose(name, added.reason, rejected=added.state is FrameState.REJECTED)

    def refuse(self, name: str, reason: str) -> None:
        """Count a frame that was refused."""
        self.refused += 1
        self.errors.append((name, reason))

    def end(self, job: Job, *, redundant: bool = False) -> None:
        """Count the frames of a finished job, which may have become redundant."""
        from sceneprint_client.api import JobState

        for name in self.waiting.pop(job.job_id):
            if redundant:
                self.redundant += 1
            elif job.state is JobState.SUCCEEDED:
                self.indexed += 1
            else:
                reason = job.error or job.state.sentence
                self._lose(name, reason, rejected=job.state is JobState.FAILED)

    def report(self, total: int, seconds: float) -> None:
        """Print the counts, and a line for each frame that was not indexed."""
        refused = f", {self.refused} refused" if self.refused else ""
        waiting = f", {len(self.waiting)} waiting" if self.waiting else ""
        redundant = f", {self.redundant} redundant" if self.redundant else ""
        print(
            f"{total} frames: {self.new} received, {self.there} already there{refused}; "
            f"{self.indexed} indexed, {self.rejected} rejected, {self.failed} failed"
            f"{redundant}{waiting}; {(self.new + self.there) / max(seconds, 1e-9):.1f} frames/s"
        )
        for name, reason in sorted(self.errors):
            print_error(f"{one_line(name)}: {one_line(reason)}")

    def _lose(self, name: str, reason: str | None, *, rejected: bool) -> None:
        self.rejected += rejected
        self.failed += not rejected
        what = "rejected" if rejected else "failed"
        self.errors.append((name, f"{what}: {reason or 'no reason'}"))


# Waiting for the frames of an upload.


def wait_for_all(
    client: Client, map_name: str, tally: Tally, limit: TimeLimit, *, may_be_redundant: bool
) -> None:
    """Wait until all jobs have ended or the time limit is reached.

    Parameters
    ----------
    tally : counts of the upload, updated for each job that ends; `waiting` contains the others
    may_be_redundant : whether frames were sent with `if_novel`
    """
    total = len(tally.waiting)
    with progress_bar("sign", total=total) as progress:
        while tally.waiting:
            before = total - len(tally.waiting)

            def advance(done: int, _: int, before: int = before) -> None:
                progress(before + done, total)

            waited = client.wait(tally.waiting, timeout_s=limit.left_s, progress=advance)
            over = [job for job in waited if job.state.over]
            for job in over:
                redundant = may_be_redundant and _is_redundant(client, map_name, job)
                tally.end(job, redundant=redundant)
                limit.note_progress()
            if tally.waiting and limit.is_over(client):
                return


def _is_redundant(client: Client, map_name: str, job: Job) -> bool:
    """Return whether the frame of a succeeded job is redundant."""
    from sceneprint_client.api import FrameState, JobState

    if job.state is not JobState.SUCCEEDED:
        return False
    return client.frame(map_name, str(job.frame_id)).state is FrameState.REDUNDANT


# Metadata of frames from options.


def add_frame_options(
    command: argparse.ArgumentParser, up: Callable[[str], object] = up_of
) -> None:
    """Add `--robot` and other metadata of frames; `up` parses the value of `--up`."""
    command.add_argument(
        "--row", type=row_option, metavar="NAMES",
        help="values in a float32 row of .bin files, such as x,y,z,i,ring (default: x,y,z and "
        "intensity)",
    )  # fmt: skip
    command.add_argument(
        "--robot", metavar="NAME",
        help="robot that took the frames; its name also prefixes the parent frame of the poses",
    )  # fmt: skip
    command.add_argument(
        "--session", metavar="NAME", help="session of the frames (default: the sequence's name)"
    )
    command.add_argument(
        "--tag", action="append", default=[], metavar="TAG", help="tag of the frames; repeatable"
    )
    command.add_argument(
        "--parent-frame", metavar="NAME",
        help="parent frame of all poses; uploads with the same parent frame share coordinates "
        "(default: SCENE, the name of the scene's folder; with --robot, ROBOT/SCENE)",
    )  # fmt: skip
    command.add_argument("--no-pose", action="store_true", help="do not upload poses")
    command.add_argument(
        "--trust-depth", action="store_true",
        help="accept depth images that fail the sanity check",
    )  # fmt: skip
    command.add_argument(
        "--base", type=base_of, metavar="TX,TY,TZ,QX,QY,QZ,QW",
        help="mounting pose of the sensor (sensor to base): metres and a unit quaternion",
    )  # fmt: skip
    command.add_argument(
        "--base-frame", metavar="NAME", help="name of the robot's base frame (default: base_link)"
    )
    add_up_option(command, up)


def frame_metadata(
    options: argparse.Namespace, sequence: FrameSequence, reference: FrameReference
) -> FrameMeta:
    """Return the metadata of a frame, including the options; see `meta_of` for errors."""
    from sceneprint.formats.dataset.frame_reference import parent_frame_of, session_of
    from sceneprint_client.frame_files import meta_of

    return meta_of(
        reference,
        robot=options.robot,
        session=options.session or session_of(sequence),
        tags=options.tag,
        with_pose=not options.no_pose,
        base=mounting_of(options),
        up=options.up,
        parent_frame=options.parent_frame or parent_frame_of(sequence, options.robot),
        trust_depth=options.trust_depth,
    )


#: Errors of one frame, after which the upload continues.
OF_FRAME = (
    FrameError, DatasetError, FrameConflict, InvalidRequest, MissingDependency, Refused,
)  # fmt: skip


def add_upload(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint upload`."""
    command.add_argument(
        "map", metavar="MAP", help="map to upload to; created if it does not exist"
    )
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add_frame_options(command, axis_or_up)
    command.add_argument(
        "--create", action=argparse.BooleanOptionalAction, default=True,
        help="create the map if it does not exist (default)",
    )  # fmt: skip
    command.add_argument(
        "--model", choices=PRESETS, help=f"model of a new map (default: {PRESETS[0]})"
    )
    command.add_argument(
        "--every", type=positive, default=1, metavar="N", help="upload every n-th frame"
    )
    add_signing_options(command)
    command.add_argument("--no-wait", action="store_true", help="do not wait for signing")
    command.add_argument(
        "--timeout", type=positive_number, metavar="SECONDS",
        help="time limit for signing; the remaining frames are signed later (default: "
        f"{STALL_S:.0f} s without a signed frame)",
    )  # fmt: skip
    command.add_argument(
        "--parallel", type=positive, default=4, metavar="N",
        help="number of concurrent uploads (default: 4)",
    )  # fmt: skip
    add_map_options(command)
    add_recording_options(command)
    add_service_options(command)
    command.set_defaults(run=run_upload)


def run_upload(options: argparse.Namespace) -> int:
    """Upload all frames of files and folders (7-Scenes, TUM RGB-D, depth images with an
    intrinsics.json beside them or in a folder above, or point clouds), and wait until they are
    signed. From a ROS recording (MCAP, rosbag2, ROS 1 bag), keyframes are uploaded. RTAB-Map
    databases, E57 files, and exports of Polycam, Record3D and nerfstudio are uploaded with their
    poses. A zip or tar archive is sent whole, and the service unpacks it. With --as-map, one cloud
    or mesh of a whole place becomes the map. Frames that the map already has are not stored twice.
    """
    check_map_options(options)
    if options.as_map:
        with open_client(options) as client:
            _ensure_map(client, options)
            code = import_maps(client, options)
            for line in map_lines(client, options.map, clouds=0):
                print(line)
            return code
    archives = [path for path in options.paths if is_archive_file(path)]
    paths = [path for path in options.paths if path not in archives]
    sequences = sequences_of(paths, options)
    frames = [(run, frame) for run in sequences for frame in run.frames[:: options.every]]
    tally, start, late = Tally(), time.perf_counter(), False
    with open_client(options) as client:
        _ensure_map(client, options)
        try:
            _send_all(client, options, frames, tally)
            late = not import_archives(client, options, archives, tally)
            if not options.no_wait and not late:
                novel = options.if_novel is not None
                limit = TimeLimit(options.timeout)
                wait_for_all(client, options.map, tally, limit, may_be_redundant=novel)
                if tally.waiting:
                    late = True
                    _report_late(client, options, tally)
        finally:  # report the received frames even after an error
            counted = tally.new + tally.there + tally.refused
            tally.report(max(len(frames), counted), time.perf_counter() - start)
            for sequence in sequences:
                if sequence.layout.is_export:  # other notes are in the summary
                    print_note(sequence)
                tally.lost += 0 if options.no_pose else sequence.lost
            hint_at_maps(paths)
            if frames:
                summary = summary_of(frames, tally, with_pose=not options.no_pose)
                tally.summaries.append(summary.text)
            for line in tally.summaries:
                print(line)
        clouds = sum(frame.cloud is not None for _, frame in frames)
        for line in map_lines(client, options.map, clouds) if tally.new or tally.there else ():
            print(line)
    return 2 if tally.errors or tally.lost or late else 0


def _report_late(client: Client, options: argparse.Namespace, tally: Tally) -> None:
    how = "not" if options.timeout else "none was"
    print_error(
        f"{len(tally.waiting)} frames are stored and waiting, but {how} signed within "
        f"{options.timeout or STALL_S:g} s. {unsigned_reason(client, tally.waiting)}"
    )


def map_lines(client: Client, map_name: str, clouds: int) -> list[str]:
    """Return advice on the poses, the parent frames and the model of a map after an upload.

    Parameters
    ----------
    clouds : number of uploaded point clouds
    """
    now, lines = client.map(map_name), []
    if clouds and now.model.startswith("depth-"):
        lines.append(
            f"{clouds} of the frames are point clouds, but map {now.name} has the model for depth "
            f"cameras. For LiDAR scans, switch it with `sceneprint reencode {now.name} --model "
            "lidar`."
        )
    if now.frames.get("indexed") and not now.posed_frames:
        lines.append(f"map {now.name} has no poses, so answers have frames but no coordinates")
    if now.parent_frames > 1:
        first: dict[str, Session] = {}
        for session in client.sessions(now.name):
            if session.session is not None:
                for parent in session.parent_frames:
                    first.setdefault(parent, session)
        two = list(first.values())[:2]
        line = (
            f"the poses of map {now.name} are in {now.parent_frames} parent frames, and an answer "
            "uses the frame of its matches. The service joins those that reliably show one place"
        )
        if len(two) == 2:
            options = " ".join(f"--session {shlex.quote(str(session.session))}" for session in two)
            if two[0].session == two[1].session and all(session.robot for session in two):
                options += "".join(f" --robot {shlex.quote(str(session.robot))}" for session in two)
            line += (
                f"; `sceneprint make association {now.name} {options}` does so at once, or "
                "explains why not"
            )
        lines.append(f"{line}.")
    return lines


def summary_of(
    frames: list[tuple[FrameSequence, FrameReference]], tally: Tally, *, with_pose: bool
) -> UploadSummary:
    """Return the summary of the uploaded frames."""
    from sceneprint_client.api.frames import upload_summary

    failed = {name for name, _ in tally.errors}
    without: Counter[str] = Counter()
    for sequence, frame in frames:
        if not with_pose:
            without["--no-pose"] += 1
        elif frame.pose_source is None:
            without[sequence.unposed] += 1
        elif frame.name in failed:
            without["not indexed"] += 1
    sequences = dict.fromkeys(sequence for sequence, _ in frames)
    notes = [one_line(run.note) for run in sequences if run.note and not run.layout.is_export]
    notes += _doubt_steps([frame for _, frame in frames if with_pose and frame.name not in failed])
    return upload_summary(len(frames), without, tally.ranges, notes)


#: Maximum median distance between consecutive frames, as for poses in metres.
_LONGEST_STEP_M = 5.0


def _doubt_steps(frames: list[FrameReference]) -> list[str]:
    """Return a note if the poses of depth images are too far apart for metres."""
    places = [frame.pose[:3, 3] for frame in frames if frame.camera and frame.pose is not None]
    steps = [math.dist(a, b) for a, b in pairwise(places)]
    step = statistics.median(steps) if steps else 0.0
    if step <= _LONGEST_STEP_M:
        return []
    return [f"poses of consecutive frames are {step:.2g} m apart: check that they are in metres"]


def sequences_of(paths: list[Path], options: argparse.Namespace) -> list[FrameSequence]:
    """Return the sequences at all paths, numbered within their sessions.

    Raise DatasetError if a path has no frames, or two places have the same default parent frame.
    """
    from sceneprint.formats.dataset.frame_reference import numbered_sequences

    places: dict[str, Path] = {}
    sequences = []
    for path in paths:
        with recording_options(options) as recording:
            sequences_here = find_sequences(path, recording)
        for sequence in sequences_here:
            if options.row is not None:
                sequence = _with_row(sequence, options.row)
            sequence = with_depth_scale(sequence, options.depth_scale)
            place = sequence.place.resolve()
            first_place = places.setdefault(sequence.parent_frame, place)
            if first_place != place and options.parent_frame is None:
                raise DatasetError(
                    f"{path}: {first_place} also has the parent frame {sequence.parent_frame}, so "
                    "the poses of both would be mixed. Upload a folder above both, rename one, "
                    "or, if their poses share one parent frame, specify it with --parent-frame."
                )
            sequences.append(sequence)
    return numbered_sequences(sequences, options.session)


def row_option(text: str) -> tuple[str, ...]:
    """Parse the value of `--row`."""
    try:
        return row_of(text)
    except DatasetError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _with_row(sequence: FrameSequence, row: tuple[str, ...]) -> FrameSequence:
    """Return a sequence of .bin files with the names of the values in a row.

    Raise InvalidRequest if the sequence has other files.
    """
    frames = tuple(
        replace(frame, cloud=replace(frame.cloud, row=row))
        for frame in sequence.frames
        if frame.cloud
    )
    if len(frames) < len(sequence.frames) or not all(frame.row for frame in frames):
        raise InvalidRequest(
            f"--row is for .bin files, but {sequence.name} has other files. Omit it, or specify "
            "only folders of .bin files.",
            (("row", "not allowed for these files"),),
        )
    return replace(sequence, frames=frames)


def _ensure_map(client: Client, options: argparse.Namespace) -> None:
    try:
        model = client.map(options.map).model
    except UnknownMap:
        if not options.create:
            raise
        record = client.create_map(options.map, model=options.model or PRESETS[0])
        print(f"created map {record.name} with model {record.model}")
        return
    if options.model is not None and model.rpartition("-")[0] != options.model:
        raise MapExists(
            f"Map {options.map} already exists with model {model}. Omit --model, or use "
            "another map."
        )


def _send_all(
    client: Client,
    options: argparse.Namespace,
    frames: list[tuple[FrameSequence, FrameReference]],
    tally: Tally,
) -> None:
    """Upload all frames concurrently; stop if the service fails."""
    pool = ThreadPoolExecutor(options.parallel, thread_name_prefix="upload")
    sent = {pool.submit(_send, client, options, *pair): pair[1].name for pair in frames}
    try:
        with tqdm(total=len(sent), desc="upload", unit="frame", disable=None) as bar:
            for future in as_completed(tuple(sent)):
                name = sent.pop(future)
                try:
                    tally.count(name, *future.result())
                except OF_FRAME as error:
                    tally.refuse(name, str(error))
                bar.update()
    finally:  # complete uploads in progress, even after Ctrl-C, but start no others
        pool.shutdown(cancel_futures=True)
        for future, name in sent.items():
            if not future.cancelled() and future.exception() is None:
                tally.count(name, *future.result())


def _send(
    client: Client, options: argparse.Namespace, sequence: FrameSequence, reference: FrameReference
) -> tuple[Added, bool]:
    meta = frame_metadata(options, sequence, reference)
    return client.add(
        options.map, reference, meta, priority=options.priority, if_novel=options.if_novel
    )
