"""`sceneprint query` and `localize`: queries of frames against a map."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.options import add_query_options, add_service_options, open_client, query_fields
from sceneprint.cli.output import count_of, frame_label, one_line, percent, print_error
from sceneprint.cli.scenes import (
    Scene,
    add_scene_options,
    check_scene,
    open_scene,
    stamps_of,
)
from sceneprint.errors import (
    DatasetError,
    FrameError,
    InvalidPose,
    InvalidRequest,
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


def add_query(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint query`."""
    command.add_argument(
        "--map", action="append", default=[], metavar="NAME", dest="also",
        help="search this map together with MAP; repeatable (MAP may be '*' for all maps that the "
        "key may read)",
    )  # fmt: skip
    command.add_argument(
        "--stages", default="retrieve,diversify,validate",
        help="comma-separated stages, starting with `retrieve` (default: "
        "retrieve,diversify,validate)",
    )  # fmt: skip
    command.add_argument(
        "--overlay", type=Path, metavar="FILE.ply",
        help="for a single frame: write its points aligned with those of its first match",
    )  # fmt: skip
    command.add_argument(
        "--color", choices=COLOURS, default="source",
        help="colour of the overlay: by frame, by normal, or by distance to the other surface "
        "(default: source)",
    )  # fmt: skip
    command.add_argument(
        "--by", choices=TRANSFORMS, default="aligned",
        help="transform of the query: that of the match (`aligned`), that of its best rival, or "
        "none (default: aligned)",
    )  # fmt: skip
    _add_frame_options(command)
    command.set_defaults(run=run_query)


def _add_frame_options(command: argparse.ArgumentParser) -> None:
    """Add the options that `query` and `localize` share."""
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "path", type=Path, metavar="PATH", help="a depth image, a cloud, a folder or a recording"
    )
    command.add_argument(
        "--frame", metavar="N|FILE",
        help="use only this frame of a folder: index from 0, or name (default: all)",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="print one JSON answer per line")
    add_query_options(command)
    add_scene_options(command)
    add_recording_options(command)
    add_service_options(command)


def run_query(options: argparse.Namespace) -> int:
    """Query a map with depth frames or point clouds from a file, from a folder (7-Scenes, TUM
    RGB-D, depth images with an intrinsics.json beside them or in a folder above, or clouds), or
    from the keyframes of a ROS recording. The frames are not added to the map. The exit code is 2
    if the query of a frame failed.
    """
    _check_scene(options)
    references = _wanted_frames(options, _frames_at(options))
    fields = {**query_fields(options), "stages": options.stages}
    several = options.map == "*" or options.also
    if several:
        fields["maps"] = "*" if options.map == "*" else [options.map, *options.also]
    if options.overlay is not None:  # check before the first query
        if len(references) != 1:
            raise DatasetError(
                f"{options.path} has {len(references)} frames, but --overlay writes a single "
                "file. Select a frame with --frame."
            )
        check_writable(options.overlay)
    with open_client(options) as client, open_scene(options, client) as scene:

        def ask(reference: FrameReference) -> tuple[Answer, str]:
            answer = client.query(
                None if several else options.map, reference, up=options.up, **fields
            )
            lines = [*answer_lines(reference.name, answer), *_explanation_lines(answer)]
            return answer, "\n".join(lines)

        add_to_scene, failed = _answer_scene(scene, references), 0
        for reference, result in _results(options, references, ask):
            if result is None:
                failed += 1
                continue
            add_to_scene(reference, *result)
            if options.overlay is not None:
                print_error(_save_overlay(client, result[0], options))
    return 2 if failed else 0


def _results(
    options: argparse.Namespace,
    references: Sequence[FrameReference],
    ask: Callable[[FrameReference], tuple[Any, str]],
) -> Iterator[tuple[FrameReference, tuple[Any, str] | None]]:
    """Query frames, and print each result; yield the frame, and the result with its text.

    After an error, print the error and yield None instead of the result.
    """
    for reference in references:
        try:
            record, text = ask(reference)
        except (FrameError, MissingDependency, TooLarge) as error:
            print_error(f"{one_line(reference.name)}: {one_line(str(error))}")
            yield reference, None
            continue
        if options.json:
            fields = {"name": reference.name, **record.model_dump(mode="json")}
            print(json.dumps(fields), flush=True)
        else:
            print(text, flush=True)
        yield reference, (record, text)


def _check_scene(options: argparse.Namespace) -> None:
    check_scene(options)
    if options.mcap is not None and options.no_keep:
        raise InvalidRequest("A scene requires stored answers. Omit --no-keep.")


def _save_overlay(client: Client, answer: Answer, options: argparse.Namespace) -> str:
    """Write the points of the query, aligned with its best match, to a file; return a message.

    Raises
    ------
    UnknownFrame : If the answer has no match.
    InvalidRequest : If the first match does not have the requested transform.
    NotIndexed : If the query was not validated.
    """
    if not answer.matches:
        raise UnknownFrame("The query has no match to overlay. Query a map that has frames.")
    best = answer.matches[0]
    data = client.overlay(
        answer.query_id, best.frame_id, best.map, color=options.color, transform=options.by
    )
    write_whole(options.overlay, data)
    return f"{options.overlay}: the query aligned with {frame_label(best.frame_id, best.name)}"


def _answer_scene(
    scene: Scene | None, references: Sequence[FrameReference]
) -> Callable[[FrameReference, Answer, str], None]:
    """Return a function that adds an answer and its text to the scene, if there is a scene."""
    places = {reference.path: place for place, reference in enumerate(references)}
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


def _frames_at(options: argparse.Namespace) -> list[FrameReference]:
    return [frame for sequence in sequences_at(options.path, options) for frame in sequence.frames]


def _wanted_frames(
    options: argparse.Namespace, references: list[FrameReference]
) -> list[FrameReference]:
    """Return all frames, or that of `--frame`; raise DatasetError if it is missing or ambiguous."""
    path, selection = options.path, options.frame
    if selection is None:
        return references
    if selection.isascii() and selection.isdigit():
        if int(selection) < len(references):
            return [references[int(selection)]]
        raise DatasetError(
            f"{path} has {len(references)} frames. Set --frame to an index from 0 to "
            f"{len(references) - 1}."
        )
    named = [
        frame
        for frame in references
        if selection in (frame.name, frame.name.rpartition("/")[2], frame.path.name)
        or Path(selection).absolute() == frame.path
    ]
    if len(named) == 1:
        return named
    count = f"{len(named)} frames are named" if named else "no frame is named"
    raise DatasetError(
        f"{path}: {count} {selection}. Set --frame to an index from 0, or to a name such as "
        f"{references[0].name}."
    )


def answer_lines(name: str, answer: Answer) -> list[str]:
    """Return lines that describe an answer: status, matches and pose."""
    counts = answer.counts
    tried = f"{counts.accepted} of {counts.validated} validated, " if counts.validated else ""
    of = f"{counts.map}"
    if counts.passed != counts.map:
        of = f"{counts.passed} that match the filter, of {counts.map}"
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
            f"{status:15}  {overlap:>7}  {_metres(match.transform):>20}  "
            f"{_degrees(match.transform):>5}  {_metres(match.pose_in_map):>20}  "
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
        f"  at {_metres(pose)} m in {one_line(pose.parent_frame)}, rotation "
        f"{r.x:.4f} {r.y:.4f} {r.z:.4f} {r.w:.4f} (x y z w)"
    )


_DECIDED = {
    "matches": "decided by the matches",
    "map": "confirmed by the map's frames",
    "prior": "several poses fit, and the prior decided",
}


def _grounds(there: Location | Localization) -> str:
    """Return the votes, the verification and the evidence for a pose as text."""
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
    """Return the evidence for a pose as text; `expected`: only places near a prior are rivals."""
    if e is None:
        return "not compared with other places"
    place = "place that the prior expects" if expected else "place"
    rival = f"no other {place} fits"
    if e.rival >= 0.05:
        rival = f"the next best {place} fits {e.rival:.0%} as well"
    planes, frames = count_of(round(e.planes), "plane"), count_of(e.frames, "frame")
    missing = "nothing" if e.excess < 0.005 else f"{e.excess:.0%}"
    return f"{planes} and {frames} of the map agree, {missing} is missing, {rival}"


def _percent(confidence: float | None) -> str:
    """Return a confidence as a suffix of a status; empty for None."""
    return "" if confidence is None else f" {percent(confidence)}"


def _alternative_lines(alternatives: Sequence[Alternative]) -> list[str]:
    """Return lines that describe the alternative poses of an ambiguous answer."""
    if not alternatives:
        return []
    head = f"  {len(alternatives)} poses are supported; at most one is right:"
    if len(alternatives) == 1:
        head = "  one pose is supported, but not confirmed:"
    places = [
        f"  {_percent(alternative.confidence):>7}  {_metres(alternative.pose)} m in "
        f"{one_line(alternative.pose.parent_frame)}, support {alternative.support}; "
        f"{_evidence(alternative.evidence)}"
        for alternative in alternatives
    ]
    return [head, *places]


def _label(match: Match, several: bool) -> str:
    """Return a label of a match: map (if several), robot, session and file, and frame id."""
    source = "/".join(one_line(who) for who in (match.robot, match.session, match.name) if who)
    return "  ".join(
        part for part in (match.map if several else "", source, match.frame_id) if part
    )


def _metres(transform: Transform | None) -> str:
    """Return the translation of a transform as text, metres."""
    if transform is None:
        return ""
    t = transform.translation
    return " ".join(f"{round(value, 3) + 0.0:.3f}" for value in (t.x, t.y, t.z))


def _degrees(transform: Transform | None) -> str:
    """Return the rotation angle of a transform as text, degrees."""
    if transform is None:
        return ""
    r = transform.rotation
    return f"{math.degrees(2 * math.atan2(math.hypot(r.x, r.y, r.z), abs(r.w))):.1f}"


def _explanation_lines(answer: Answer) -> list[str]:
    """Return the explanations in an answer as lines of text; there may be none."""
    lines = [
        f"  {e.rank:4}  {frame_label(e.frame_id, e.name)}  {e.similarity:4.2f}  "
        f"{e.stage}: {e.outcome.replace('_', ' ')}; {one_line(e.reason)}"
        for e in answer.explanations or []
    ]
    explained = answer.explained_frame
    if explained is not None:
        place = (
            "not searched" if explained.rank is None else f"rank {explained.rank} of {explained.of}"
        )
        lost = "a match" if explained.lost_at is None else f"dropped at {explained.lost_at}"
        label = frame_label(explained.frame_id, explained.name)
        lines.append(f"  {label}: {place}; {lost}: {one_line(explained.reason)}")
    return lines


# `sceneprint localize`.

#: Default number of frames of a sequence, and maximum number of frames to look back.
_LAST, _FARTHEST_BACK = 3, 200


def add_localize(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint localize`."""
    command.add_argument(
        "--last", type=positive, metavar="K",
        help="number of frames per query, 1 to 10: each frame and earlier frames, 0.1 m or 6 "
        "degrees apart, whose poses in the folder serve as odometry (default: 3 if the frames "
        "have poses and --up is absent, else 1)",
    )  # fmt: skip
    _add_frame_options(command)
    command.set_defaults(run=run_localize)


def run_localize(options: argparse.Namespace) -> int:
    """Find the poses in a map at which depth frames or clouds were taken. The frames are not
    added to the map. The exit code is 0 if all poses are found, 1 if one is ambiguous or not found,
    and 2 if a query failed.
    """
    _check_scene(options)
    every = _frames_at(options)
    references = _frames_to_localize(options, every)
    fields = query_fields(options)
    lost = failed = 0
    with open_client(options) as client, open_scene(options, client) as scene:

        def ask(reference: FrameReference) -> tuple[Localization, str]:
            there = _localize(client, options, every, reference, fields)
            return there, "\n".join(localization_lines(reference.name, there))

        add_to_scene = _answer_scene(scene, references)
        for reference, result in _results(options, references, ask):
            if result is None:
                failed += 1
                continue
            there, text = result
            lost += there.status != "found"
            if scene is not None:
                add_to_scene(reference, client.answer(there.query_id), text)
    return 2 if failed else min(lost, 1)


def _frames_to_localize(
    options: argparse.Namespace, every: list[FrameReference]
) -> list[FrameReference]:
    """Return all frames, or the frame of `--frame`.

    Raise DatasetError if the frame does not exist, a prior applies to several frames, or --last
    conflicts with other options.
    """
    if options.last is not None and options.last > MOST_OF_SEQUENCE:
        raise DatasetError(f"--last {options.last}: use a number from 1 to {MOST_OF_SEQUENCE}.")
    if options.up is not None and (options.last or 1) > 1:
        raise DatasetError(
            "--up applies to one frame. Omit --last, or set `up` in the intrinsics.json beside the "
            "frames."
        )
    if options.prior is not None and options.frame is None and len(every) > 1:
        raise DatasetError(
            f"{options.path} has {len(every)} frames, but --prior applies to one. Select it with "
            "--frame."
        )
    return _wanted_frames(options, every)


def _localize(
    client: Client, options: argparse.Namespace, every: list[FrameReference],
    reference: FrameReference, fields: dict[str, Any],
) -> Localization:  # fmt: skip
    """Return the pose of a frame, queried with earlier frames, or alone if these are refused."""
    before = _frames_before(options, every, reference)
    if before:
        try:
            return client.localize_sequence(options.map, [*before, reference], **fields)
        except (FrameError, TooLarge):
            pass  # query the frame alone below
    return client.localize(options.map, reference, up=options.up, **fields)


def _frames_before(
    options: argparse.Namespace, every: list[FrameReference], reference: FrameReference
) -> list[FrameReference]:
    """Return up to K - 1 earlier frames of the same folder to query together with a frame.

    K is --last; the default is 3, or 1 with --up. The frames have poses, are spaced as in
    `spaced_views`, and are in chronological order. If the frame has no pose, return none, or raise
    DatasetError if --last exceeds 1.
    """
    most = options.last or (_LAST if options.up is None else 1)
    if most == 1:
        return []
    if reference.pose is None:
        if options.last is None:
            return []
        raise DatasetError(
            f"{reference.name} has no pose, but --last {options.last} requires odometry. Omit "
            "--last, or put the poses beside the frames."
        )
    run = reference.name.rpartition("/")[0]
    frames = [frame for frame in every if frame.name.rpartition("/")[0] == run]
    place = [frame.path for frame in frames].index(reference.path)
    posed = [(frame, pose) for frame in frames[max(place - _FARTHEST_BACK, 0) : place + 1]
             if (pose := _pose_or_none(frame)) is not None]  # fmt: skip
    return [posed[i][0] for i in spaced_views([pose for _, pose in posed], most)[:-1]]


def _pose_or_none(reference: FrameReference) -> Floats | None:
    """Return the pose of a frame; None if it has no valid pose."""
    try:
        return reference.pose
    except InvalidPose:
        return None


def localization_lines(name: str, there: Localization) -> list[str]:
    """Return lines that describe a localisation."""
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
