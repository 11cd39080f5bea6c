"""Uploads of whole files: archives of sequences, and maps in single files.

files  --import_archives-->  frames, counted
files  --import_maps-->  rendered views, and the result of test views
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from tqdm import tqdm

from sceneprint.cli import positive_number
from sceneprint.cli.options import mounting_of, up_of
from sceneprint.cli.output import print_error, waiting_reason
from sceneprint.errors import Busy, DatasetError, InvalidRequest, SceneprintError, UnknownFrame
from sceneprint.formats.archive import is_archive
from sceneprint.formats.exports import is_export
from sceneprint.formats.recording.bag import is_recording
from sceneprint_client.api.base import checked
from sceneprint_client.api.frames import (
    Axis,
    ImportOptions,
    MapImportResult,
    UploadSummary,
    camera_fields,
    offset_fields,
)
from sceneprint_client.formats import is_cloud, titles_of

if TYPE_CHECKING:
    from sceneprint.cli.upload import Tally
    from sceneprint_client import Client
    from sceneprint_client.api import Job, Progress
    from sceneprint_client.api.base import Direction

#: Seconds without progress after which the command gives up.
STALL_S = 120.0


class TimeLimit:
    """A time limit for the jobs of an upload: a total time, or STALL_S without progress.

    Parameters
    ----------
    limit_s : total time, seconds; None sets no limit while there is progress
    """

    def __init__(self, limit_s: float | None) -> None:
        self._until = None if limit_s is None else time.monotonic() + limit_s
        self._moved = time.monotonic()

    @property
    def left_s(self) -> float:
        """Seconds until the limit is reached if there is no further progress."""
        until = self._moved + STALL_S if self._until is None else self._until
        return max(until - time.monotonic(), 0.0)

    def note_progress(self) -> None:
        """Restart the time without progress."""
        self._moved = time.monotonic()

    def is_over(self, client: Client) -> bool:
        """Return whether the limit is reached; a service that is still starting extends it."""
        if self.left_s > 0:
            return False
        if self._until is None and is_starting(client):
            self.note_progress()
            return False
        return True


def unsigned_reason(client: Client, jobs: Iterable[str]) -> str:
    """Return the reason why jobs have not ended, from the statistics of the service."""
    from sceneprint_client.api import JobState

    if is_starting(client):
        return "They are signed when the service is ready."
    try:
        stats = client.stats(minutes=1)
        own = sum(job.state is JobState.QUEUED for job in client.wait(jobs, timeout_s=0.0))
    except SceneprintError:  # the key does not permit reading them
        return waiting_reason(None)
    return waiting_reason(stats, own)


def is_starting(client: Client) -> bool:
    """Return whether the service is still compiling kernels, before any worker runs.

    If so, print a message.
    """
    try:
        client.status()
    except Busy:
        print_error("the service is compiling its kernels, as it does once after an installation")
        return True
    return False


def _options_of(options: argparse.Namespace, file: str, **more: Any) -> ImportOptions:
    """Return the import options of a file; raise InvalidRequest if they are not valid."""
    return checked(
        ImportOptions, f"The metadata of {file}", robot=options.robot, session=options.session,
        tags=options.tag, parent_frame=options.parent_frame, with_poses=not options.no_pose,
        every=options.every, T_base_sensor=mounting_of(options), up=options.up,
        priority=options.priority, if_novel=options.if_novel, trust_depth=options.trust_depth,
        **more,
    )  # fmt: skip


# Archives: send them, and wait for their imports.

#: Labels of the phases of a map import in the progress bar.
_PHASES = {
    "read": "read", "choose": "choose viewpoints", "render": "render views", "sign": "sign views",
    "test": "query test views",
}  # fmt: skip
#: Number of bytes that identify an archive, and seconds between checks of an import.
_HEAD, _PAUSE_S = 512, 2.0


def is_archive_file(path: Path) -> bool:
    """Return whether a path is an archive file, but not an export with frames."""
    try:
        if not path.is_file() or is_export(path) or is_recording(path):
            return False
        with path.open("rb") as file:
            return is_archive(file.read(_HEAD))
    except OSError:  # the error appears when the file is read
        return False


def import_archives(
    client: Client, options: argparse.Namespace, archives: list[Path], tally: Tally
) -> bool:
    """Send archives and count their frames; return whether all imports ended in time."""
    for path in archives:
        import_options = _options_of(
            options, path.name, name=path.name.partition(".")[0][:64] or "import"
        )
        with path.open("rb") as file:
            job = client.import_archive(options.map, file, import_options)
        if options.no_wait:
            print(f"{path.name}: received; import {job.job_id} adds its frames")
            continue
        job = _wait_for_import(client, options, path.name, job)
        _count(client, options.map, job, tally)
        if not job.state.over:
            _report_late(client, options, path.name, job)
            return False
        if job.error is not None:
            tally.refuse(path.name, job.error)
        if job.result is not None:
            summary = UploadSummary.model_validate(job.result["summary"])
            tally.summaries.append(f"{path.name}: {summary.text}")
            tally.lost += summary.lost
    return True


def _report_late(client: Client, options: argparse.Namespace, name: str, job: Job) -> None:
    print_error(
        f"{name}: import {job.job_id} did not end within {options.timeout or STALL_S:g} s; it "
        f"continues when a worker is free. {unsigned_reason(client, [job.job_id])}"
    )


def _wait_for_import(client: Client, options: argparse.Namespace, name: str, job: Job) -> Job:
    """Wait until an import has ended or the time limit is reached; return its job."""
    from sceneprint_client.api import JobState

    limit, last_progress = TimeLimit(options.timeout), job.progress
    with tqdm(desc=name, unit="frame", disable=None) as bar:
        while not job.state.over:
            client.wait([job.job_id], timeout_s=_PAUSE_S)
            job = client.job(job.job_id)
            if job.progress is not None:
                _show_progress(bar, name, job.progress)
            if job.progress != last_progress or job.state == JobState.RUNNING:
                last_progress = job.progress
                limit.note_progress()
            if not job.state.over and limit.is_over(client):
                break
    return job


def _show_progress(bar: tqdm[Any], name: str, progress: Progress) -> None:
    """Update a bar with the progress of an import; for a whole map, of its current phase."""
    done, total = progress.done, progress.total
    if progress.phase is not None:
        steps = {"render": progress.rendered, "sign": progress.signed, "test": progress.tested}
        done, total = steps.get(progress.phase) or 0, progress.views
        if progress.phase == "test" and progress.total is not None and total is not None:
            total = progress.total - 2 * total
        bar.set_description(f"{name}: {_PHASES[progress.phase]}", refresh=False)
    bar.total, bar.n = total, done
    bar.refresh()


def _count(client: Client, map_name: str, job: Job, tally: Tally) -> None:
    from sceneprint_client.api import Added, FrameState

    for item in client.import_items(map_name, job.job_id):
        if item.frame_id is None or item.job_id is None:
            tally.refuse(item.name, "refused" if item.problem is None else item.problem.detail)
            continue
        state = FrameState.RECEIVED
        if item.status == 200:  # an existing frame, possibly signed already
            try:
                state = client.frame(map_name, item.frame_id).state
            except UnknownFrame:  # the frame was deleted
                continue
        added = Added(frame_id=item.frame_id, job_id=item.job_id, state=state, reason=None)
        tally.count(item.name, added, item.status == 202)


# Maps in one file: `sceneprint upload --as-map`.

#: Number of units per metre, by name of the unit.
_UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "ft": 1 / 0.3048}
#: Maximum size of a point file, bytes; a larger one is probably not a single scan.
_SCAN_BYTES = 24 << 20
#: Maximum number of weak areas to print.
_MOST_WEAK = 5


def axis_or_up(text: str) -> Axis | list[float]:
    """Parse an axis of a file, or an up vector in the axes of a sensor."""
    axis = next((axis for axis in get_args(Axis) if axis == text), None)
    return up_of(text) if axis is None else axis


def _fields(read: Callable[[str], dict[str, float]]) -> Callable[[str], dict[str, float]]:
    """Convert a parser of comma-separated numbers to an argparse type."""

    def fields(text: str) -> dict[str, float]:
        try:
            return read(text)
        except InvalidRequest as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return fields


def add_map_options(command: argparse.ArgumentParser) -> None:
    """Add `--as-map`, and the options that describe the file."""
    group = command.add_argument_group("a whole map in one file")
    group.add_argument(
        "--as-map", action="store_true",
        help=f"PATH is a cloud or mesh of a whole place ({titles_of('map', last='or')}): "
        "rendered views of it become frames of the map. --up is the axis of the file that points "
        "up: x, y, z, or the opposite as in --up=-y",
    )  # fmt: skip
    group.add_argument(
        "--height", type=positive_number, action="append", default=[], metavar="M",
        help="height of the robot's sensor above the floor, metres; repeatable (default: usual "
        "heights of such sensors)",
    )  # fmt: skip
    group.add_argument(
        "--units", type=lambda text: _UNITS.get(text) or positive_number(text), metavar="N",
        help="unit of the file: m, cm, mm, ft, or the number of units per metre (default: the "
        "unit that the file states, else an estimate)",
    )  # fmt: skip
    group.add_argument(
        "--offset", type=_fields(offset_fields), metavar="X,Y,Z",
        help="metres to subtract from the coordinates of the file (default: none, or the centre "
        "of the file if it is more than a kilometre from the origin)",
    )  # fmt: skip
    group.add_argument(
        "--camera", type=_fields(camera_fields), metavar="FX,FY,CX,CY,WIDTH,HEIGHT",
        help="depth camera of the robot, pixels (default: a typical one)",
    )  # fmt: skip


def check_map_options(options: argparse.Namespace) -> None:
    """Raise InvalidRequest if the options do not match the kind of upload."""
    is_whole = options.as_map or any(map(is_archive_file, options.paths))
    for name, kind, place in (
        ("depth_scale", "depth images and recordings",
         'the value as "depth_scale" into intrinsics.json'),
        ("row", ".bin files", 'the names as "row" into clouds.json'),
    ):  # fmt: skip
        if getattr(options, name) is not None and is_whole:
            raise InvalidRequest(
                f"--{name.replace('_', '-')} is for {kind}, not for maps and archives. In an "
                f"archive, put {place}.",
                ((name, "not allowed for a map or an archive"),),
            )
    if options.as_map:
        folders = [str(path) for path in options.paths if path.is_dir()]
        if folders:
            raise DatasetError(
                f"{folders[0]}: a map is one file, but this is a folder. Specify the file, or omit "
                "--as-map to upload the frames in the folder."
            )
        return
    for name in ("height", "units", "offset", "camera"):
        if getattr(options, name):
            raise InvalidRequest(
                f"--{name} is only for maps in one file. Add --as-map, or omit the option.",
                ((name, "without --as-map"),),
            )
    if isinstance(options.up, str):
        raise InvalidRequest(
            f"--up {options.up} is an axis of a file, for --as-map. Specify three numbers: the up "
            "vector in the axes of the sensor.",
            (("up", "an axis without --as-map"),),
        )


def import_maps(client: Client, options: argparse.Namespace) -> int:
    """Send maps and print their results; return 2 if an import failed."""
    code = 0
    for path in options.paths:
        import_options = _options_of(
            options, path.name, **{"as": "map"}, name=path.name[-64:].lstrip("."),
            heights=options.height, units_per_metre=options.units, offset=options.offset,
            camera=options.camera,
        )  # fmt: skip
        job = client.import_map(options.map, path, import_options)
        if options.no_wait:
            print(f"{path.name}: received; import {job.job_id} renders its views")
            continue
        job = _wait_for_import(client, options, path.name, job)
        if not job.state.over:
            _report_late(client, options, path.name, job)
            return 2
        if job.result is None:
            print_error(f"{path.name}: {job.error or job.state.sentence}")
            code = 2
            continue
        print("\n".join(lines_of(path.name, options.map, MapImportResult(**job.result))))
    return code


def lines_of(name: str, map_name: str, result: MapImportResult) -> list[str]:
    """Return the lines that describe the result of a map import."""
    how = {"stated": "as specified", "file": "from the file", "estimated": "estimated"}
    unit = next((u for u, n in _UNITS.items() if math.isclose(n, result.units_per_metre)), None)
    unit = unit or f"{result.units_per_metre:g} per metre"
    r = result
    refused = f" {r.refused} views were refused." if r.refused else ""
    lines = [
        f"{name}: {r.views} views are in map {map_name} and see {r.seen:.0%} of its surface. Their "
        f"parent frame is {r.parent_frame}.{refused}",
        f"units: {unit} ({how.get(r.units_from, r.units_from)}); up: {_axis(r.up)} "
        f"({how.get(r.up_from, r.up_from)})",
    ]
    if any(offset := (r.offset.x, r.offset.y, r.offset.z)):
        stated = ",".join(f"{x:.12g}" for x in offset)  # write it in the format of --offset
        lines.append(f"offset: {stated} m; add it to poses to get coordinates of the file")
    lines += r.notes
    if r.coverage is not None:
        lines.append(
            f"Of {r.tested} test views of this file, {r.coverage:.0%} are found in the map: "
            f"{r.found} found, {r.ambiguous} ambiguous, {r.not_found} not found, {r.wrong} wrong. "
            "Real frames are found less often; test with real frames too."
        )
    for area in r.weak[:_MOST_WEAK]:
        at = _numbers(area.centre.x, area.centre.y, area.centre.z)
        lines.append(
            f"weak area: {at}, {area.width_m:g} m wide ({area.found} of {area.views} found)"
        )
    if len(r.weak) > _MOST_WEAK:
        lines.append(f"and {len(r.weak) - _MOST_WEAK} more weak areas")
    return lines


def _axis(up: Direction) -> str:
    """Return a direction as text: the name of its axis, else its numbers."""
    for axis, value in zip("xyz", (up.x, up.y, up.z), strict=True):
        if abs(value) > 0.9999:
            return axis if value > 0 else f"-{axis}"
    return _numbers(up.x, up.y, up.z)


def _numbers(x: float, y: float, z: float) -> str:
    return f"{x:.2f}, {y:.2f}, {z:.2f}"


def hint_at_maps(paths: list[Path]) -> None:
    """Print a hint for point files that are too large for one scan."""
    for path in paths:
        if path.is_file() and is_cloud(path.name) and path.stat().st_size > _SCAN_BYTES:
            print_error(
                f"{path.name} is large for one scan. If it contains a whole place, upload it with "
                "--as-map."
            )
