"""`sceneprint sign`: frames to signatures."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.atomic_files import write_whole
from sceneprint.cli import metres, positive, whole_number
from sceneprint.cli.bag import add_recording_options, sequences_at
from sceneprint.cli.options import add_model_options, open_for
from sceneprint.errors import DatasetError, FrameError, TrainingError
from sceneprint.formats.dataset import (
    Camera,
    FrameReference,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.formats.export import write_ply
from sceneprint.models import PRESETS, ModelParameters, save_model
from sceneprint.pipeline import Signature, Signer, sign
from sceneprint.settings import Settings
from sceneprint.types import AnyFrame, Cloud, DepthFrame

if TYPE_CHECKING:
    from sceneprint.lab.synth import LookalikeSite


def add_sign(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "sign",
        help="sign depth frames and point clouds",
        description="Sign every frame of the given files and folders (7-Scenes, TUM RGB-D or "
        "plain depth images, with an intrinsics.json beside them or in a folder above; or point "
        "clouds).",
    )
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add_model_options(command)
    command.add_argument(
        "--psi",
        action="store_true",
        help="sign with psi, the Fisher vectors of the paper, from the given model or else the "
        "preset paper",
    )
    command.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write one FRAME.sig per frame (the bytes of the signature) and signatures.json",
    )
    add_recording_options(command)
    command.set_defaults(run=run_sign)


@dataclass(frozen=True, eq=False)
class Signed:
    """One frame's outcome: a signature with its time, or the reason why there is none."""

    reference: FrameReference
    name: str
    signature: Signature | None
    milliseconds: float
    reason: str = ""


def named_frames(options: argparse.Namespace) -> list[tuple[str, FrameReference]]:
    """All frames below the paths, under names that are unique among them.

    Raises
    ------
    DatasetError : nothing is found at a path, or one path was given twice.
    """
    frames: dict[str, FrameReference] = {}
    files: set[Path] = set()
    paths = options.paths
    for path in paths:
        several = len(paths) > 1 and path.is_dir()  # a file is named by its folder already
        prefix = f"{path.resolve().name}/" if several else ""
        for sequence in sequences_at(path, options):
            for reference in sequence.frames:
                known = reference.name.startswith(prefix)
                name = reference.name if known else prefix + reference.name
                if name in frames or reference.path.resolve() in files:
                    first = frames[name].path if name in frames else "another of the paths"
                    raise DatasetError(
                        f"{path}: {name} is also the name of {first}. Sign the two in separate "
                        "runs."
                    )
                frames[name] = reference
                files.add(reference.path.resolve())
    return list(frames.items())


def run_sign(options: argparse.Namespace) -> int:
    """Sign; returns 2 where a frame could not be signed."""
    frames = named_frames(options)
    signer = open_for(options, Settings(), psi=options.psi)
    if options.out is not None:
        _claim(options.out, signer)
    done: list[Signed] = []
    heard = True  # whether anybody still reads the lines
    try:
        with tqdm(frames, desc="sign", unit="frame", disable=None) as bar:
            for name, reference in bar:
                one = _sign(name, reference, signer)
                if options.out is not None:
                    _write_signature(options.out / f"{name}.sig", one.signature)
                done.append(one)
                try:
                    if heard:
                        bar.write(_line(one, signer))
                except BrokenPipeError:
                    if options.out is None:
                        raise
                    heard = False
    finally:  # what was written is listed, however the run ended
        if options.out is not None:
            _write_index(options.out, done, signer)
    return _report(done, signer)


def _claim(folder: Path, signer: Signer) -> None:
    """Make the folder, or see that it holds signatures of this model."""
    folder.mkdir(parents=True, exist_ok=True)
    index = folder / "signatures.json"
    try:
        known = json.loads(index.read_text())["model"]["id"] if index.exists() else None
    except (ValueError, KeyError, TypeError):
        known = "no readable model id"
    if known not in (None, signer.model.id):
        raise DatasetError(
            f"{folder}: holds signatures of another model ({known[:12]}, not "
            f"{signer.model.id[:12]}), and models must not be mixed. Use a new folder, or empty "
            "this one."
        )


def _sign(name: str, reference: FrameReference, signer: Signer) -> Signed:
    try:
        frame = reference.read()
        start = time.perf_counter()
        signature = sign(frame, signer)
        return Signed(reference, name, signature, 1e3 * (time.perf_counter() - start))
    except FrameError as error:
        return Signed(reference, name, None, 0.0, str(error))


def _line(one: Signed, signer: Signer) -> str:
    # a name may hold line breaks and escapes; a line of ours never does
    name = one.name if one.name.isprintable() else ascii(one.name)
    if one.signature is None:
        return (
            f"{name}  NOT SIGNED  {one.reason if one.reason.isprintable() else ascii(one.reason)}"
        )
    patches = "/".join(map(str, one.signature.n_patches))
    return (
        f"{name}  {patches} patches  {sum(one.signature.n_pairs)} pairs  "
        f"{one.milliseconds:.0f} ms  {signer.model.label}"
    )


def _write_signature(path: Path, signature: Signature | None) -> None:
    """Write it, or where there is none now, see that an earlier one does not stay."""
    if signature is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, signature.vector.tobytes())


def _write_index(folder: Path, done: list[Signed], signer: Signer) -> None:
    model = signer.model
    index = {
        "model": {
            "name": model.name,
            "id": model.id,
            "signature_bytes": model.signature_bytes,
            "metric": model.metric,
            "unrelated_distance": model.unrelated_distance,
        },
        "frames": [_entry(one) for one in done],
    }
    write_whole(folder / "signatures.json", (json.dumps(index, indent=1) + "\n").encode())


def _entry(one: Signed) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": one.name, "path": str(one.reference.path)}
    if one.signature is None:
        return entry | {"signed": False, "reason": one.reason}
    return entry | {
        "signed": True,
        "file": f"{one.name}.sig",
        "sha256": hashlib.sha256(one.signature.vector.tobytes()).hexdigest(),
        "patches": list(one.signature.n_patches),
        "pairs": list(one.signature.n_pairs),
        "milliseconds": round(one.milliseconds, 1),
    }


def _report(done: list[Signed], signer: Signer) -> int:
    times = sorted(one.milliseconds for one in done if one.signature is not None)
    failed = len(done) - len(times)
    median = f", median {times[len(times) // 2]:.0f} ms" if times else ""
    print(
        f"{len(times)} of {len(done)} frames signed{median}; {signer.model.signature_bytes} bytes "
        f"each; model {signer.model.label}",
        file=sys.stderr,
    )
    if failed:
        print(f"{failed} could not be signed; see their lines above", file=sys.stderr)
    return 2 if failed else 0


# `sceneprint train`: synthetic rooms, and frames of one's own, to a model.


def add_train(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "train",
        help="train a model",
        description="Train a model on synthetic rooms or, for the preset lidar, on synthetic "
        "halls, storeys and blocks. The presets cover indoor depth cameras and spinning LiDAR; "
        "docs/model.md explains when to train your own.",
    )
    command.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="model file to write"
    )
    command.add_argument(
        "--preset",
        choices=PRESETS,
        default=PRESETS[0],
        help=f"base of signature size, lengths and scenes (default: {PRESETS[0]})",
    )
    command.add_argument(
        "--rooms",
        type=whole_number,
        default=100,
        metavar="N",
        help="number of synthetic rooms or sites (default: 100)",
    )
    command.add_argument(
        "--whitening-rooms",
        type=whole_number,
        metavar="N",
        help="number of synthetic rooms or sites to fit the whitening of signatures; 0 stores "
        "psi itself (default: 500; lidar 400, paper 0)",
    )
    command.add_argument("--seed", type=whole_number, default=0, metavar="S")
    command.add_argument(
        "--frames",
        type=Path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="also train on your own frames, in any layout that `sceneprint sign` reads",
    )
    command.add_argument("--projection", choices=("pca", "ica"), default="pca", help="default: pca")
    command.add_argument(
        "--range",
        type=metres,
        nargs=2,
        metavar=("MIN", "MAX"),
        help="range of the sensor in metres (default: 0.3 9; lidar 0.6 60)",
    )
    command.add_argument(
        "--radius",
        type=metres,
        metavar="R",
        help="neighbourhood radius of a patch in metres (default: 3; lidar 30)",
    )
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="processes"
    )
    command.set_defaults(run=run_train)


def run_train(options: argparse.Namespace) -> int:
    """Train and write the model."""
    from sceneprint.lab.training import (
        TrainingParameters,
        preset_answer,
        preset_parameters,
        preset_scenes,
        preset_whitening,
        train,
    )

    references: list[tuple[str, FrameReference]] = [
        (f"{path.resolve()}: {sequence.parent_frame}", reference)
        for path in options.frames
        for sequence in find_sequences(path)
        for reference in sequence.frames
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    if options.out.is_dir():
        raise TrainingError(f"{options.out}: is a folder. Name a file for the model.")
    scenes, views = preset_scenes(options.preset)
    levels, whitening, whitening_rooms = preset_whitening(options.preset)
    if options.whitening_rooms is not None:
        whitening_rooms = options.whitening_rooms
    p = TrainingParameters(
        rooms=options.rooms,
        views=views,
        seed=options.seed,
        projection=options.projection,
        scenes=scenes,
        whitening_rooms=whitening_rooms,
        levels=levels,
        whitening=whitening,
    )
    model_p, mixture_p = preset_parameters(options.preset)
    if options.range is not None:
        model_p = _of_range(model_p, *options.range)
    if options.radius is not None:
        properties = replace(model_p.properties, radius=options.radius)
        model_p = replace(model_p, properties=properties)
    name = re.sub(r"[^A-Za-z0-9_.-]", "-", options.out.stem)[:64] or options.preset
    with _Bars() as bars:
        model = train(name, model_p, mixture_p, p, references, options.jobs, bars.report)
    save_model(replace(model, answer=preset_answer(options.preset)), options.out)
    print(
        f"{options.out}: model {model.label}, {model.signature_bytes} bytes a signature, "
        f"trained on {model.provenance['frames_used']} frames and "
        f"{model.provenance['pairs_used']} pairs"
    )
    return 0


def _of_range(p: ModelParameters, least: float, most: float) -> ModelParameters:
    """The same for a sensor of another range, of depth images and of clouds."""
    if least >= most:
        raise TrainingError(f"--range {least:g} {most:g}: give the smaller distance first.")
    return replace(
        p,
        depth=replace(p.depth, minimum_depth=least, maximum_depth=most),
        cloud=replace(p.cloud, minimum_range=least, maximum_range=most),
    )


class _Bars:
    """A progress bar for each stage, in the order in which they come."""

    def __init__(self) -> None:
        self.stage = ""
        self.bar: Any = None

    def __enter__(self) -> _Bars:
        return self

    def __exit__(self, *reason: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def report(self, stage: str, done: int, total: int) -> None:
        """Advance the bar of a stage, closing the one before it."""
        if stage != self.stage:
            self.__exit__()
            self.stage, self.bar = stage, tqdm(desc=stage, total=total, disable=None)
        self.bar.update(done - self.bar.n)


# `sceneprint synth`: synthetic rooms, or sites scanned by a laser, as a data set.

#: Stored units per metre.
DEPTH_SCALE = 1000.0
#: Kinds of look-alike sites of a sensor, as `lookalikes` and `lookalike_surveys` have them.
LOOKALIKES = {
    "kinect": ("object", "offices", "unmapped", "kitchens", "opposite", "absent"),
    "lidar": ("bays", "streets", "halls", "unmapped", "absent", "sites"),
}


def add_synth(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "synth",
        help="generate synthetic rooms with known poses",
        description="Render furnished rooms as a Kinect would see them, in 7-Scenes layout: "
        "OUT/room-000/seq-01/frame-000000.depth.png and .pose.txt. With --sensor lidar: halls, "
        "storeys and blocks as a spinning laser would see them, OUT/site-000/scan-000000.ply "
        "and .pose.txt. With --lookalikes: sites that look like themselves or like another, as "
        "scenes whose TrainSplit.txt and TestSplit.txt say what is the map and what the "
        "queries, so that `sceneprint evaluate OUT` measures wrong answers.",
    )
    command.add_argument("out", type=Path, metavar="OUT", help="output folder, new or empty")
    command.add_argument(
        "--sensor", choices=("kinect", "lidar"), default="kinect", help="default: kinect"
    )
    command.add_argument(
        "--lookalikes",
        choices=sorted({kind for kinds in LOOKALIKES.values() for kind in kinds}),
        metavar="KIND",
        help="object: a symmetric object circled on a bare floor; offices: a row of equal rooms, "
        "or a hall of equal bays; unmapped: such a row, the queries from a room that the map "
        "lacks; kitchens: the queries from another kitchen with the same furniture; opposite: "
        "furniture in a room, the queries from its other side; absent: the queries from other "
        "rooms. With --sensor lidar: bays: a hall of equal bays; streets: a street of equal "
        "blocks; halls: a hall that is the same after half a turn; unmapped: equal halls or "
        "streets, the queries from one that the map lacks; absent: the queries from other halls "
        "and streets; sites: ordinary halls, storeys and blocks, which do not repeat",
    )
    command.add_argument(
        "--rooms",
        type=positive,
        default=4,
        metavar="N",
        help="number of rooms or sites (default: 4)",
    )
    command.add_argument(
        "--views",
        type=positive,
        default=25,
        metavar="M",
        help="number of views per room; with --lookalikes, of queries per site (default: 25)",
    )
    command.add_argument("--seed", type=whole_number, default=0, metavar="S", help="default: 0")
    command.add_argument(
        "--path",
        action="store_true",
        help="place views along a hand-held path, a few centimetres apart, instead of at "
        "random; with --sensor lidar along a walk, 1.5 m apart",
    )
    command.add_argument("--perfect", action="store_true", help="without sensor noise")
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="processes"
    )
    command.set_defaults(run=run_synth)


def run_synth(options: argparse.Namespace) -> int:
    """Make the rooms."""
    if options.lookalikes and options.path:
        raise DatasetError(
            "--lookalikes and --path: look-alike sites have paths of their own. Leave --path out."
        )
    kinds = LOOKALIKES[options.sensor]
    if options.lookalikes and options.lookalikes not in kinds:
        raise DatasetError(
            f"--lookalikes {options.lookalikes}: there is no such kind for --sensor "
            f"{options.sensor}. Choose from {', '.join(kinds)}."
        )
    if options.out.exists() and any(options.out.iterdir()):
        raise DatasetError(
            f"{options.out}: is not empty, and frames of two runs must not be mixed. Use a new "
            "folder, or empty this one."
        )
    options.out.mkdir(parents=True, exist_ok=True)
    with tqdm(total=options.rooms, desc="synth", unit="room", disable=None) as bar:
        for _ in _rooms(options):
            bar.update()
    made = "sites" if options.lookalikes or options.sensor == "lidar" else "rooms"
    views = "queries" if options.lookalikes else "views"
    print(f"{options.rooms} {made} of {options.views} {views} in {options.out}")
    return 0


def _rooms(options: argparse.Namespace) -> Iterator[None]:
    where = options.out, options.seed, options.views
    make: Callable[[int], None]
    if options.lookalikes:
        look = _write_lookalike_survey if options.sensor == "lidar" else _write_lookalike
        make = partial(look, *where, kind=options.lookalikes, perfect=options.perfect)
    else:
        write = _write_site if options.sensor == "lidar" else _write_room
        make = partial(write, *where, along_path=options.path, perfect=options.perfect)
    jobs = min(options.jobs, options.rooms)
    if jobs == 1:  # a process of its own would import all anew
        yield from map(make, range(options.rooms))
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(make, range(options.rooms))


def _write_room(
    out: Path, seed: int, views: int, index: int, *, along_path: bool, perfect: bool
) -> None:
    from sceneprint.lab.synth import KinectNoise, synthesise_room

    noise = None if perfect else KinectNoise()
    room = synthesise_room(seed, index, views, along_path=along_path, noise=noise)
    folder = out / room.name
    _write_sequence(folder / "seq-01", room.frames)
    write_intrinsics(folder, Camera(room.frames[0].intrinsics, DEPTH_SCALE, along_ray=False))


def _write_sequence(sequence: Path, frames: Sequence[DepthFrame]) -> None:
    sequence.mkdir(parents=True)
    for number, frame in enumerate(frames):
        write_depth_png(sequence / f"frame-{number:06d}.depth.png", frame.depth, DEPTH_SCALE)
        if frame.pose is not None:
            write_pose(sequence / f"frame-{number:06d}.pose.txt", frame.pose)


def _write_lookalike(
    out: Path, seed: int, queries: int, index: int, *, kind: str, perfect: bool
) -> None:
    """A scene of two sequences, or two scenes where the queries' place is not in the map."""
    from sceneprint.lab.synth import KinectNoise, synthesise_lookalike

    noise = None if perfect else KinectNoise()
    site = synthesise_lookalike(kind, seed, index, queries=queries, noise=noise)
    of_map, of_queries = _split_scenes(out, site)
    _write_sequence(of_map / "seq-01", site.map)
    _write_sequence(of_queries / "seq-02", site.queries)
    for folder in {of_map, of_queries}:
        write_intrinsics(folder, Camera(site.map[0].intrinsics, DEPTH_SCALE, along_ray=False))


def _write_lookalike_survey(
    out: Path, seed: int, queries: int, index: int, *, kind: str, perfect: bool
) -> None:
    """As `_write_lookalike`, of scans."""
    from sceneprint.lab.synth import synthesise_lookalike_survey

    site = synthesise_lookalike_survey(kind, seed, index, queries=queries, perfect=perfect)
    of_map, of_queries = _split_scenes(out, site)
    _write_scans(of_map / "seq-01", site.map)
    _write_scans(of_queries / "seq-02", site.queries)


def _split_scenes(out: Path, site: LookalikeSite[AnyFrame]) -> tuple[Path, Path]:
    """Folders of the scenes of a site's map and of its queries, with the files of their splits."""
    of_map = of_queries = out / site.name
    if not site.same_frame:
        of_queries = out / f"{site.name}-elsewhere"
    for folder in (of_map, of_queries):
        folder.mkdir(parents=True, exist_ok=True)
    (of_map / "TrainSplit.txt").write_text("sequence1\n")
    (of_queries / "TestSplit.txt").write_text("sequence2\n")
    return of_map, of_queries


def _write_site(
    out: Path, seed: int, views: int, index: int, *, along_path: bool, perfect: bool
) -> None:
    from sceneprint.lab.synth import synthesise_survey

    survey = synthesise_survey(seed, index, views, along_path=along_path, perfect=perfect)
    _write_scans(out / survey.name, survey.clouds)


def _write_scans(folder: Path, clouds: Sequence[Cloud]) -> None:
    folder.mkdir(parents=True)
    for number, cloud in enumerate(clouds):
        (folder / f"scan-{number:06d}.ply").write_bytes(write_ply(cloud.points))
        if cloud.pose is not None:
            write_pose(folder / f"scan-{number:06d}.pose.txt", cloud.pose)
