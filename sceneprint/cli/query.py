"""`sceneprint query`: where in a map were these frames taken?"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.options import (
    add_asking_options,
    add_prior_option,
    add_service_options,
    add_up_option,
    explained_lines,
    frame_label,
    one_line,
    open_client,
    options_of,
    percent,
)
from sceneprint.cli.scenes import (
    Scene,
    add_scene_options,
    check_kept,
    check_scene,
    open_scene,
    stamps_of,
)
from sceneprint.errors import (
    DatasetError,
    FrameError,
    InvalidPose,
    MissingDependency,
    TooLarge,
    UnknownFrame,
)
from sceneprint.formats.dataset import FrameReference
from sceneprint_client.api.base import CameraIntrinsics
from sceneprint_client.api.query import MOST_OF_SEQUENCE
from sceneprint_client.api.results import COLOURS, TRANSFORMS
from sceneprint_client.tracker_core import spaced_views

if TYPE_CHECKING:
    from sceneprint.types import Floats
    from sceneprint_client import Client
    from sceneprint_client.api import (
        Alternative,
        Answer,
        EvidenceRecord,
        Localization,
        Location,
        Match,
        Transform,
    )

# The query's points laid on those of its best match, as a file for any viewer of clouds.


def add_overlay_options(command: argparse.ArgumentParser) -> None:
    """Describe the overlay to the parser of a command that asks for one frame."""
    command.add_argument(
        "--overlay",
        type=Path,
        metavar="FILE.ply",
        help="for a single frame: write its points, aligned with those of its first match",
    )
    command.add_argument(
        "--color",
        choices=COLOURS,
        default="source",
        help="colour the overlay by frame, by normal, or by distance from the other surface "
        "(default: source)",
    )
    command.add_argument(
        "--by",
        choices=TRANSFORMS,
        default="aligned",
        help="transform of the overlay: the match's, its best rival, or none (default: aligned)",
    )


def check_overlay(options: argparse.Namespace, frames: int) -> None:
    """See before the first query that the overlay can be written.

    Raises
    ------
    DatasetError : several frames would go to one file.
    OSError : the file cannot be written.
    """
    if options.overlay is None:
        return
    if frames != 1:
        raise DatasetError(
            f"{options.path}: has {frames} frames, but --overlay writes a single file. Choose a "
            "frame with --frame."
        )
    check_writable(options.overlay)


def save_overlay(client: Client, answer: Answer, options: argparse.Namespace) -> str:
    """Write the overlay; returns a line about it.

    Raises
    ------
    UnknownFrame : the answer has no match.
    InvalidRequest : its first match has no such transform.
    NotIndexed : the query was asked without validation.
    """
    if not answer.matches:
        raise UnknownFrame("The query has no match to overlay. Query a map that has frames.")
    best = answer.matches[0]
    data = client.overlay(
        answer.query_id, best.frame_id, best.map, color=options.color, transform=options.by
    )
    write_whole(options.overlay, data)
    return f"{options.overlay}: the query aligned with {frame_label(best.frame_id, best.name)}"


def add_query(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint query`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument("path", type=Path, metavar="PATH")
    command.add_argument(
        "--frame", metavar="N|FILE", help="use only this frame of a folder: index from 0, or name"
    )
    command.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="NAME",
        dest="also",
        help="search this map together with MAP; repeatable (MAP may be '*' for every map that "
        "you may read)",
    )
    command.add_argument(
        "--stages",
        default="retrieve,diversify,validate",
        help=(
            "comma-separated stages, starting with `retrieve` (default: "
            "retrieve,diversify,validate)"
        ),
    )
    command.add_argument("--json", action="store_true", help="print one JSON answer per line")
    add_up_option(command)
    add_asking_options(command)
    add_prior_option(command)
    add_overlay_options(command)
    add_scene_options(command)
    add_recording_options(command)
    add_service_options(command)
    command.set_defaults(run=run_query)


def run_query(options: argparse.Namespace) -> int:
    """Query a map with depth frames or point clouds: one file, or the frames of a folder
    (7-Scenes, TUM RGB-D or plain depth images, with an intrinsics.json beside them or in a
    folder above; or clouds), or the keyframes of a recording of ROS. They are not added to the
    map.
    """
    check_scene(options)
    check_kept(options)
    references = query_frames(options)
    how = {**options_of(options), "stages": options.stages, "prior": options.prior}
    several = options.map == "*" or options.also
    if several:
        how["maps"] = "*" if options.map == "*" else [options.map, *options.also]
    check_overlay(options, len(references))
    failed = 0
    with open_client(options) as client, open_scene(options, client) as scene:
        add_to_scene = _answer_scene(scene, references)
        for reference in references:
            try:
                answer = client.query(
                    None if several else options.map, reference, up=options.up, **how
                )
            except (FrameError, MissingDependency, TooLarge) as error:  # of this file alone
                failed += 1
                print(f"{one_line(reference.name)}: {one_line(str(error))}", file=sys.stderr)
                continue
            text = "\n".join([*answer_lines(reference.name, answer), *explained_lines(answer)])
            if options.json:
                told = {"name": reference.name, **answer.model_dump(mode="json")}
                print(json.dumps(told), flush=True)
            else:
                print(text, flush=True)
            add_to_scene(reference, answer, text)
            if options.overlay is not None:
                print(save_overlay(client, answer, options), file=sys.stderr)
    return 2 if failed else 0


def _answer_scene(
    scene: Scene | None, references: Sequence[FrameReference]
) -> Callable[[FrameReference, Answer, str], None]:
    """Return what adds the answer of a frame, and its text, to the scene, if there is one."""
    places = {one.path: place for place, one in enumerate(references)}
    stamps = stamps_of(references)

    def add(reference: FrameReference, answer: Answer, text: str) -> None:
        if scene is None:
            return
        place = places[reference.path]
        camera = None
        if reference.camera is not None:
            k = reference.camera.intrinsics
            camera = CameraIntrinsics(
                width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy
            )
        of = place, len(references)
        scene.add_answer(answer, one_line(reference.name), text, camera, of, stamps[place])

    return add


def query_frames(options: argparse.Namespace) -> list[FrameReference]:
    """The frames to look up: all, or that of `--frame`.

    Raises
    ------
    DatasetError : nothing is found at the path, or no such frame.
    """
    path = options.path
    references = [frame for one in sequences_at(path, options) for frame in one.frames]
    return references if options.frame is None else _wanted_frame(path, options.frame, references)


def _wanted_frame(
    path: Path, wanted: str, references: list[FrameReference]
) -> list[FrameReference]:
    """The frame of that index or name, alone; DatasetError where there is none."""
    if wanted.isascii() and wanted.isdigit():
        if int(wanted) < len(references):
            return [references[int(wanted)]]
        raise DatasetError(
            f"{path}: has {len(references)} frames. Set --frame to an index from 0 to "
            f"{len(references) - 1}."
        )
    named = [
        frame
        for frame in references
        if wanted in (frame.name, frame.name.rpartition("/")[2], frame.path.name)
        or Path(wanted).absolute() == frame.path
    ]
    if len(named) == 1:
        return named
    found = f"{len(named)} frames are called" if named else "no frame is called"
    raise DatasetError(
        f"{path}: {found} {wanted}. Set --frame to an index from 0, or to a name such as "
        f"{references[0].name}."
    )


def answer_lines(name: str, answer: Answer) -> list[str]:
    """An answer for people: a line of what came out, a line each match, and the pose."""
    counts = answer.counts
    tried = f"{counts.accepted} of {counts.validated} validated, " if counts.validated else ""
    of = f"{counts.map}"
    if counts.passed != counts.map:
        of = f"{counts.passed} that pass the filter, of {counts.map}"
    there = answer.location or next(iter(answer.alternatives), None)
    sure = "" if there is None else _percent(there.confidence)
    lines = [
        f"{one_line(name)}: {answer.status.replace('_', ' ')}{sure} ({tried}{counts.ranked} "
        f"ranked of {of} frames, {answer.milliseconds.get('total', 0.0):.0f} ms)"
    ]
    if answer.matches:
        several = len(answer.maps) > 1
        width = max(len(_label(match, several)) for match in answer.matches)
        lines.append(
            f"  {'match':{width}}  rank  similarity  {'validation':15}  overlap  "
            f"{'to the match, m':>20}  {'deg':>5}  {'in the map, m':>20}  reason"
        )
    for match in answer.matches:
        v = match.validation
        status = f"{v.status} {v.strength}" if v.strength else v.status
        overlap = "" if v.overlap is None else f"{v.overlap:.2f}"
        lines.append(
            f"  {_label(match, several):{width}}  {match.rank:4}  {match.similarity:10.2f}  "
            f"{status:15}  {overlap:>7}  {metres(match.transform):>20}  "
            f"{_degrees(match.transform):>5}  {metres(match.pose_in_map):>20}  "
            f"{one_line(v.reason)}".rstrip()
        )
    if answer.location is not None:
        lines += [_pose_line(answer.location.pose), f"  {_grounds(answer.location)}"]
    elif answer.reason:
        cause = f"{answer.cause}: " if answer.cause else ""
        lines.append(f"  {cause}{one_line(answer.reason)}")
    return lines + _alternative_lines(answer.alternatives)


def _pose_line(pose: Transform) -> str:
    r = pose.rotation
    return (
        f"  at {metres(pose)} m in {one_line(pose.parent_frame)}, rotation "
        f"{r.x:.4f} {r.y:.4f} {r.z:.4f} {r.w:.4f} (x y z w)"
    )


_DECIDED = {
    "matches": "decided by the matches",
    "map": "confirmed by the map's frames",
    "prior": "several poses fit, and the prior decided",
}


def _grounds(there: Location | Localization) -> str:
    """What a pose that is found rests on, and what the map says of it and of other places."""
    if there.support == 0:
        voted = "no match votes for it"
    elif there.support == 1:
        voted = f"one view ({there.strength})"
    else:
        voted = f"{there.support} of {there.votes} accepted matches vote for it ({there.strength})"
        if there.spread_m is not None and there.spread_deg is not None:
            voted += f", spread {100 * there.spread_m:.1f} cm, {there.spread_deg:.1f} deg"
    why = _evidence(there.evidence, expected=there.verified_by == "prior")
    return f"{voted}; {_DECIDED[there.verified_by or 'matches']}; {why}"


def _evidence(e: EvidenceRecord | None, *, expected: bool = False) -> str:
    """The evidence that a confidence was computed from, in a line.

    Parameters
    ----------
    e : of a pose
    expected : whether it was compared only with places that the prior expects
    """
    if e is None:
        return "not compared with other places"
    place = "place that the prior expects" if expected else "place"
    rival = f"no other {place} fits"
    if e.rival >= 0.05:
        rival = f"the next best {place} fits {e.rival:.0%} as well"
    planes, frames = _things(round(e.planes), "plane"), _things(e.frames, "frame")
    missing = "nothing" if e.excess < 0.005 else f"{e.excess:.0%}"
    return f"{planes} and {frames} of the map agree, {missing} is missing, {rival}"


def _things(number: int, name: str) -> str:
    return f"{number} {name}{'' if number == 1 else 's'}"


def _percent(confidence: float | None) -> str:
    """A confidence behind a status; nothing where there is none."""
    return "" if confidence is None else f" {percent(confidence)}"


def _alternative_lines(alternatives: Sequence[Alternative]) -> list[str]:
    """The poses of an ambiguous answer, a line each; none of them is the answer."""
    if not alternatives:
        return []
    head = f"  {len(alternatives)} poses are supported; at most one is right:"
    if len(alternatives) == 1:
        head = "  one pose is supported, and not confirmed:"
    places = [
        f"  {_percent(one.confidence):>7}  {metres(one.pose)} m in "
        f"{one_line(one.pose.parent_frame)}, support {one.support}; "
        f"{_evidence(one.evidence)}"
        for one in alternatives
    ]
    return [head, *places]


def _label(match: Match, several: bool) -> str:
    """Who saw it, in which of several maps, its file, and its id to ask for the rest."""
    seen = "/".join(one_line(who) for who in (match.robot, match.session, match.name) if who)
    return "  ".join(part for part in (match.map if several else "", seen, match.frame_id) if part)


def metres(transform: Transform | None) -> str:
    """Its translation; nothing where there is none."""
    if transform is None:
        return ""
    t = transform.translation
    return " ".join(f"{round(value, 3) + 0.0:.3f}" for value in (t.x, t.y, t.z))


def _degrees(transform: Transform | None) -> str:
    """Angle of the turn."""
    if transform is None:
        return ""
    r = transform.rotation
    return f"{math.degrees(2 * math.atan2(math.hypot(r.x, r.y, r.z), abs(r.w))):.1f}"


# `sceneprint localize`: where in a map was this frame taken? One pose, or why there is none.

#: With how many frames each is looked up by default, and how many before it these may be.
_LAST, _FARTHEST_BACK = 3, 200


def add_localize(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint localize`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "path", type=Path, metavar="FRAME", help="a depth image, a cloud, a folder or a recording"
    )
    command.add_argument(
        "--frame", metavar="N|FILE", help="frame of a folder: index from 0, or name (default: all)"
    )
    command.add_argument(
        "--last", type=positive, metavar="K",
        help="look each frame up together with the frames before it, K in all, 1 to 10: those "
        "that were taken 0.1 m or 6 degrees apart. Their poses in the folder are used as odometry "
        "(default: 3 where frames have poses and --up is not given; 1: each frame alone)",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="print JSON")
    add_up_option(command)
    add_asking_options(command)
    add_prior_option(command)
    add_scene_options(command)
    add_recording_options(command)
    add_service_options(command)
    command.set_defaults(run=run_localize)


def run_localize(options: argparse.Namespace) -> int:
    """Find the poses in a map at which depth frames or clouds were taken. They are not added to
    the map. Exit code 0: all are found; 1: one is ambiguous or not found.
    """
    check_scene(options)
    check_kept(options)
    every = [frame for one in sequences_at(options.path, options) for frame in one.frames]
    chosen = _frames_to_localize(options, every)
    how = {**options_of(options), "prior": options.prior}
    lost = failed = 0
    with open_client(options) as client, open_scene(options, client) as scene:
        add_to_scene = _answer_scene(scene, chosen)
        for reference in chosen:
            try:
                there = _localize(client, options, every, reference, how)
            except (FrameError, MissingDependency, TooLarge) as error:  # of this file alone
                if len(chosen) == 1:
                    raise
                failed += 1
                print(f"{one_line(reference.name)}: {one_line(str(error))}", file=sys.stderr)
                continue
            lost += there.status != "found"
            text = "\n".join(localization_lines(reference.name, there))
            if options.json:
                told = {"name": reference.name, **there.model_dump(mode="json")}
                print(json.dumps(told), flush=True)
            else:
                print(text, flush=True)
            if scene is not None:
                add_to_scene(reference, client.answer(there.query_id), text)
    return 2 if failed else min(lost, 1)


def _frames_to_localize(
    options: argparse.Namespace, every: list[FrameReference]
) -> list[FrameReference]:
    """Return all frames, or that of `--frame`.

    Raises
    ------
    DatasetError : no such frame, a prior of several, or --last that cannot be used.
    """
    if options.last is not None and options.last > MOST_OF_SEQUENCE:
        raise DatasetError(f"--last {options.last}: choose from 1 to {MOST_OF_SEQUENCE}.")
    if options.up is not None and (options.last or 1) > 1:
        raise DatasetError(
            "--up is of one frame. Leave --last out, or have `up` in the intrinsics.json beside "
            "the frames."
        )
    if options.frame is not None:
        return _wanted_frame(options.path, options.frame, every)
    if options.prior is not None and len(every) > 1:
        raise DatasetError(
            f"{options.path} has {len(every)} frames, and --prior is of one. Name it with --frame."
        )
    return every


def _localize(
    client: Client, options: argparse.Namespace, every: list[FrameReference],
    reference: FrameReference, how: dict[str, Any],
) -> Localization:  # fmt: skip
    """Look a frame up with those before it; alone where the service refuses one of these."""
    before = _frames_before(options, every, reference)
    if before:
        try:
            return client.localize_sequence(options.map, [*before, reference], **how)
        except (FrameError, TooLarge):
            pass  # asking with the frame alone tells whether the earlier ones are at fault
    return client.localize(options.map, reference, up=options.up, **how)


def _frames_before(
    options: argparse.Namespace, every: list[FrameReference], reference: FrameReference
) -> list[FrameReference]:
    """Return the frames of its sequence that a frame is looked up with.

    Raises
    ------
    DatasetError : --last asks for some, and the frame has no pose.
    """
    most = options.last or (_LAST if options.up is None else 1)
    if most == 1:
        return []
    if reference.pose is None:
        if options.last is None:
            return []
        raise DatasetError(
            f"{reference.name} has no pose, and --last {options.last} needs odometry. Leave --last "
            "out, or put the poses beside the frames."
        )
    run = reference.name.rpartition("/")[0]
    frames = [frame for frame in every if frame.name.rpartition("/")[0] == run]
    place = [frame.path for frame in frames].index(reference.path)
    posed = [(one, pose) for one in frames[max(place - _FARTHEST_BACK, 0) : place + 1]
             if (pose := _pose_or_none(one)) is not None]  # fmt: skip
    return [posed[i][0] for i in spaced_views([pose for _, pose in posed], most)[:-1]]


def _pose_or_none(reference: FrameReference) -> Floats | None:
    """Its pose; None where it has none, or its file holds none, as where tracking was lost."""
    try:
        return reference.pose
    except InvalidPose:
        return None


def localization_lines(name: str, there: Localization) -> list[str]:
    """A localization for people."""
    sure = f" ({there.strength})" if there.strength else ""
    several = f"{there.frames} frames, " if there.frames > 1 else ""
    lines = [
        f"{one_line(name)}: {there.status.replace('_', ' ')}{_percent(there.confidence)}{sure}; "
        f"{one_line(there.reason)} "
        f"({several}{there.milliseconds.get('total', 0.0):.0f} ms)"
    ]
    if there.cause is not None:
        lines.append(f"  cause: {there.cause}")
    if there.pose is not None:
        lines += [_pose_line(there.pose), f"  {_grounds(there)}"]
    elif there.best is not None:
        best = frame_label(there.best.frame_id, there.best.name)
        lines.append(f"  no coordinates: frame {best} has no pose")
    return lines + _alternative_lines(there.alternatives)
