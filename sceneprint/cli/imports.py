"""Files that `sceneprint upload` sends whole: archives of sequences, and maps that are one file.

files  --import_archives-->  frames, counted
files  --import_maps-->  views of each, and where other views are found
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

#: Seconds without a frame signed after which no worker is believed to be there.
STALL_S = 120.0


class Patience:
    """A time limit for the jobs of an upload: a deadline, or STALL_S without progress.

    Parameters
    ----------
    limit_s : seconds from now; None: as long as it moves
    """

    def __init__(self, limit_s: float | None) -> None:
        self._until = None if limit_s is None else time.monotonic() + limit_s
        self._moved = time.monotonic()

    @property
    def left_s(self) -> float:
        """Return the seconds that are left, unless something moves meanwhile."""
        until = self._moved + STALL_S if self._until is None else self._until
        return max(until - time.monotonic(), 0.0)

    def note_progress(self) -> None:
        """Note that something moved."""
        self._moved = time.monotonic()

    def is_over(self, client: Client) -> bool:
        """Return whether to give up; a service that still starts is waited for."""
        if self.left_s > 0:
            return False
        if self._until is None and is_starting(client):
            self.note_progress()
            return False
        return True


def why_unsigned(client: Client, jobs: Iterable[str]) -> str:
    """Return why jobs have not ended, by what the service counts now."""
    from sceneprint_client.api import JobState

    try:
        stats = client.stats(minutes=1)
        own = sum(job.state is JobState.QUEUED for job in client.wait(jobs, timeout_s=0.0))
    except SceneprintError:  # a key for some maps alone may not see them
        return waiting_reason(None)
    return waiting_reason(stats, own)


def is_starting(client: Client) -> bool:
    """Return whether the service still compiles kernels, so that no worker has begun."""
    try:
        client.status()
    except Busy:
        print_error("the service compiles its kernels, once after an installation")
        return True
    return False


def _options_of(options: argparse.Namespace, file: str, **more: Any) -> ImportOptions:
    """Return the options of the import of a file; InvalidRequest where they do not fit it."""
    return checked(
        ImportOptions, f"The metadata of {file}", robot=options.robot, session=options.session,
        tags=options.tag, parent_frame=options.parent_frame, with_poses=not options.no_pose,
        every=options.every, T_base_sensor=mounting_of(options), up=options.up,
        priority=options.priority, if_novel=options.if_novel, trust_depth=options.trust_depth,
        **more,
    )  # fmt: skip


# Archives given to `sceneprint upload`: sent whole, and waited for until all frames are taken.

#: What the bar calls the phases of the import of a map.
_PHASES = {
    "read": "read", "choose": "choose viewpoints", "render": "render views", "sign": "sign views",
    "test": "look up other views",
}  # fmt: skip
#: Bytes that tell whether a file is an archive, and seconds between two looks at an import.
_HEAD, _PAUSE_S = 512, 2.0


def is_archive_file(path: Path) -> bool:
    """Return whether a path is a file that begins as an archive does, and no export with frames."""
    try:
        if not path.is_file() or is_export(path):
            return False
        with path.open("rb") as file:
            return is_archive(file.read(_HEAD))
    except OSError:  # whoever reads it says so
        return False


def import_archives(
    client: Client, options: argparse.Namespace, archives: list[Path], tally: Tally
) -> bool:
    """Send archives and count their frames; return whether all imports ended in time."""
    for path in archives:
        said = _options_of(options, path.name, name=path.name.partition(".")[0][:64] or "import")
        with path.open("rb") as file:
            job = client.import_archive(options.map, file, said)
        if options.no_wait:
            print(f"{path.name}: received; import {job.job_id} adds its frames")
            continue
        job = _waited(client, options, path.name, job)
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
        f"{name}: import {job.job_id} did not end within {options.timeout or STALL_S:g} s, and "
        f"goes on when a worker is free. {why_unsigned(client, [job.job_id])}"
    )


def _waited(client: Client, options: argparse.Namespace, name: str, job: Job) -> Job:
    """Return an import once it is over, or as it is when nothing moved for long."""
    from sceneprint_client.api import JobState

    patience, seen = Patience(options.timeout), job.progress
    with tqdm(desc=name, unit="frame", disable=None) as bar:
        while not job.state.over:
            client.wait([job.job_id], timeout_s=_PAUSE_S)
            job = client.job(job.job_id)
            if job.progress is not None:
                _show(bar, name, job.progress)
            if job.progress != seen or job.state == JobState.RUNNING:
                seen = job.progress
                patience.note_progress()
            if not job.state.over and patience.is_over(client):
                break
    return job


def _show(bar: tqdm[Any], name: str, progress: Progress) -> None:
    """Let a bar show how far an import has come; of a map, in its phase."""
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
        if item.status == 200:  # it may be over long since
            try:
                state = client.frame(map_name, item.frame_id).state
            except UnknownFrame:  # deleted meanwhile
                continue
        added = Added(frame_id=item.frame_id, job_id=item.job_id, state=state, reason=None)
        tally.count(item.name, added, item.status == 202)


# Maps that are one file: `sceneprint upload --as-map`.

#: Units of a metre by their names.
_UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "ft": 1 / 0.3048}
#: Bytes of a file of points that are too many for one scan.
_SCAN_BYTES = 24 << 20
#: Weak areas that are printed.
_MOST_WEAK = 5


def axis_or_up(text: str) -> Axis | list[float]:
    """Return an axis of a file, or up in the axes of a sensor."""
    axis = next((one for one in get_args(Axis) if one == text), None)
    return up_of(text) if axis is None else axis


def _fields(read: Callable[[str], dict[str, float]]) -> Callable[[str], dict[str, float]]:
    """Return a function that reads comma-separated numbers as argparse wants it."""

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
        "views of it are rendered, and become the frames of the map. --up takes the axis of the "
        "file that points up: x, y, z or, as in --up=-y, its opposite",
    )  # fmt: skip
    group.add_argument(
        "--height", type=positive_number, action="append", default=[], metavar="M",
        help="height of the robot's sensor above the floor, metres; repeatable (default: some "
        "that are usual for such a sensor)",
    )  # fmt: skip
    group.add_argument(
        "--units", type=lambda text: _UNITS.get(text) or positive_number(text), metavar="N",
        help="unit of the file: m, cm, mm, ft, or how many are a metre (default: as the file "
        "says, else estimated)",
    )  # fmt: skip
    group.add_argument(
        "--offset", type=_fields(offset_fields), metavar="X,Y,Z",
        help="metres that are taken off the coordinates of the file (default: none, or where it "
        "lies more than a kilometre from its origin, its middle)",
    )  # fmt: skip
    group.add_argument(
        "--camera", type=_fields(camera_fields), metavar="FX,FY,CX,CY,WIDTH,HEIGHT",
        help="depth camera of the robot, pixels (default: a usual one)",
    )  # fmt: skip


def check_map_options(options: argparse.Namespace) -> None:
    """See that options are of the kind of upload; InvalidRequest where they are not."""
    is_whole = options.as_map or any(map(is_archive_file, options.paths))
    for name, kind, place in (
        ("depth_scale", "depth images and recordings",
         'it as "depth_scale" into intrinsics.json'),
        ("row", ".bin files", 'the names as "row" into clouds.json'),
    ):  # fmt: skip
        if getattr(options, name) is not None and is_whole:
            raise InvalidRequest(
                f"--{name.replace('_', '-')} is for {kind}, and not for a map or an archive. In an "
                f"archive, put {place}.",
                ((name, "of a map or an archive"),),
            )
    if options.as_map:
        folders = [str(path) for path in options.paths if path.is_dir()]
        if folders:
            raise DatasetError(
                f"{folders[0]}: A map is one file, and this is a folder. Name the file, or leave "
                "--as-map out to upload the frames in it."
            )
        return
    for name in ("height", "units", "offset", "camera"):
        if getattr(options, name):
            raise InvalidRequest(
                f"--{name} is for a map that is one file. Add --as-map, or leave it out.",
                ((name, "without --as-map"),),
            )
    if isinstance(options.up, str):
        raise InvalidRequest(
            f"--up {options.up} is an axis of a file, for --as-map. Give three numbers: up in the "
            "axes of the sensor.",
            (("up", "an axis without --as-map"),),
        )


def import_maps(client: Client, options: argparse.Namespace) -> int:
    """Send maps and say what became of each; returns 2 where one was not imported."""
    code = 0
    for path in options.paths:
        said = _options_of(
            options, path.name, **{"as": "map"}, name=path.name[-64:].lstrip("."),
            heights=options.height, units_per_metre=options.units, offset=options.offset,
            camera=options.camera,
        )  # fmt: skip
        job = client.import_map(options.map, path, said)
        if options.no_wait:
            print(f"{path.name}: received; import {job.job_id} renders its views")
            continue
        job = _waited(client, options, path.name, job)
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
    """Say in sentences what became of a map that is one file."""
    how = {"stated": "as you said", "file": "from the file", "estimated": "estimated"}
    unit = next((u for u, n in _UNITS.items() if math.isclose(n, result.units_per_metre)), None)
    unit = unit or f"{result.units_per_metre:g} per metre"
    r = result
    refused = f" {r.refused} views were refused." if r.refused else ""
    lines = [
        f"{name}: {r.views} views are in map {map_name} and see {r.seen:.0%} of its surface. Their "
        f"poses lead to {r.parent_frame}.{refused}",
        f"units: {unit} ({how.get(r.units_from, r.units_from)}); up: {_axis(r.up)} "
        f"({how.get(r.up_from, r.up_from)})",
    ]
    if any(offset := (r.offset.x, r.offset.y, r.offset.z)):
        stated = ",".join(f"{x:.12g}" for x in offset)  # as --offset takes it
        lines.append(f"offset: {stated} m; add it to a pose for the file's coordinates")
    lines += r.notes
    if r.coverage is not None:
        lines.append(
            f"Of {r.tested} other views of this file {r.coverage:.0%} are found in the map: "
            f"{r.found} found, {r.ambiguous} ambiguous, {r.not_found} not found, {r.wrong} wrong. "
            "Real frames are found less often: try some."
        )
    for area in r.weak[:_MOST_WEAK]:
        at = _numbers(area.centre.x, area.centre.y, area.centre.z)
        lines.append(
            f"weak here: {at}, {area.width_m:g} m wide ({area.found} of {area.views} found)"
        )
    if len(r.weak) > _MOST_WEAK:
        lines.append(f"and {len(r.weak) - _MOST_WEAK} more weak areas")
    return lines


def _axis(up: Direction) -> str:
    """Return the axis that a direction is along, or its numbers."""
    for axis, value in zip("xyz", (up.x, up.y, up.z), strict=True):
        if abs(value) > 0.9999:
            return axis if value > 0 else f"-{axis}"
    return _numbers(up.x, up.y, up.z)


def _numbers(x: float, y: float, z: float) -> str:
    return f"{x:.2f}, {y:.2f}, {z:.2f}"


def hint_at_maps(paths: list[Path]) -> None:
    """Say of files of points that are too large for one scan how a map is uploaded."""
    for path in paths:
        if path.is_file() and is_cloud(path.name) and path.stat().st_size > _SCAN_BYTES:
            print_error(
                f"{path.name} is large for one scan. If it holds a whole place, upload it with "
                "--as-map."
            )
