"""Frames read, signed and laid aside, so that every later stage takes what it needs.

Protocol  --prepare_all-->  Member, ... and what could not be used; depth and geometry in a Store
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from sceneprint.artifacts import read_geometry, write_geometry
from sceneprint.errors import FrameError
from sceneprint.evaluation.protocol import Chosen
from sceneprint.evaluation.records import Member
from sceneprint.evaluation.workers import Watch, map_over, unwatched
from sceneprint.geometry.retrieval import Metric
from sceneprint.geometry.validation import ValidationParameters
from sceneprint.models import Model
from sceneprint.pipeline import Signer, open_signer, prepare
from sceneprint.types import AnyFrame, Bytes, Cloud, Frame, Geometry, Intrinsics


@dataclass(frozen=True)
class Store:
    """A folder with what is too large to hold: depth and geometry of every frame by its number.

    Parameters
    ----------
    folder : of the files; whoever made it removes it
    """

    folder: Path

    def keep(self, number: int, frame: AnyFrame, geometry: Geometry) -> None:
        """Lay a frame aside."""
        (self.folder / f"{number}.geometry").write_bytes(write_geometry(geometry))
        if isinstance(frame, Cloud):
            seen = "seen" if frame.has_viewpoint else "fused"
            np.save(self.folder / f"{number}.{seen}.npy", np.ascontiguousarray(frame.points))
            return
        k = frame.intrinsics
        camera = np.array([k.width, k.height, k.fx, k.fy, k.cx, k.cy])
        np.save(self.folder / f"{number}.depth.npy", np.ascontiguousarray(frame.depth))
        np.save(self.folder / f"{number}.camera.npy", camera)

    def is_depth(self, member: Member) -> bool:
        """Whether the frame is a depth image and no cloud."""
        return (self.folder / f"{member.number}.depth.npy").exists()

    def frame(self, member: Member) -> AnyFrame:
        """The depth image or cloud again, with the pose of the evaluation."""
        for has_viewpoint, seen in ((True, "seen"), (False, "fused")):
            if (path := self.folder / f"{member.number}.{seen}.npy").exists():
                return Cloud(np.load(path), has_viewpoint, member.name, member.pose)
        depth = np.load(self.folder / f"{member.number}.depth.npy")
        width, height, *rest = np.load(self.folder / f"{member.number}.camera.npy").tolist()
        camera = Intrinsics(int(width), int(height), *rest)
        return Frame(depth, camera, member.name, member.pose)

    def geometry(self, number: int) -> Geometry:
        """What validation needs of the frame, as a service would load it."""
        return read_geometry((self.folder / f"{number}.geometry").read_bytes())


@dataclass(frozen=True, eq=False)
class Prepared:
    """The frames that can be used, and why others cannot.

    Parameters
    ----------
    queries, database : in the order of the protocol
    left_out : (name, reason) of the others
    milliseconds : median time to sign a frame and work out its geometry; None without frames
    validation, metric : of the model
    """

    queries: list[Member]
    database: list[Member]
    left_out: list[tuple[str, str]]
    milliseconds: float | None
    validation: ValidationParameters = field(default_factory=ValidationParameters)
    metric: Metric = "l2"


@dataclass(frozen=True, eq=False)
class _Task:
    number: int
    chosen: Chosen
    judged: bool
    length: int | None


@dataclass(frozen=True, eq=False)
class _Done:
    member: Member | None
    reason: str
    milliseconds: float


def prepare_all(
    chosen: tuple[Chosen, ...],
    signer: Signer,
    store: Store,
    *,
    levels: int | None = None,
    jobs: int = 1,
    cache_dir: Path | None = None,
    watch: Watch = unwatched,
) -> Prepared:
    """Read, sign and lay aside every frame.

    A frame without a pose cannot be judged, and is left out; but a database frame of a scene
    that no query is of needs none, as it is wrong wherever it lies.

    Parameters
    ----------
    chosen : see Protocol
    signer : see `open_signer`
    store : an empty one
    levels : how many levels of psi to keep, finest first; None for all, or what is stored
    jobs : processes
    cache_dir : of derived files of the model
    watch : told of each frame
    """
    asked = {one.scene for one in chosen if one.is_for("query")}
    length = signer.model.level_length * levels if levels else None
    tasks = [_Task(i, one, one.scene in asked, length) for i, one in enumerate(chosen)]
    # a process of its own opens the model itself: a table is too large to send
    own = signer if jobs == 1 else signer.model
    results = map_over(tasks, _prepare, partial(_open, own, cache_dir, store), jobs)
    by_use: dict[str, list[Member]] = {"query": [], "database": []}
    left_out, spent = [], []
    for one, done in zip(chosen, watch(results, "read and sign", len(tasks)), strict=True):
        if done.member is None:
            left_out.append((one.name, done.reason))
        else:
            for use in ("query", "database"):
                if one.is_for(use):
                    by_use[use].append(done.member)
            spent.append(done.milliseconds)
    median = float(np.median(spent)) if spent else None
    model = signer.model
    return Prepared(
        by_use["query"], by_use["database"], left_out, median, model.parameters.validation,
        model.metric,
    )  # fmt: skip


def _open(model: Signer | Model, cache_dir: Path | None, store: Store) -> tuple[Signer, Store]:
    return (model if isinstance(model, Signer) else open_signer(model, cache_dir)), store


def _prepare(opened: tuple[Signer, Store], task: _Task) -> _Done:
    signer, store = opened
    try:
        frame = task.chosen.reference.read()
        if frame.pose is None and task.judged:
            return _Done(None, "no pose is known, so nothing can be judged by it", 0.0)
        start = time.perf_counter()
        signature, geometry = prepare(replace(frame, name=task.chosen.name), signer)
        spent = 1e3 * (time.perf_counter() - start)
    except FrameError as error:
        return _Done(None, str(error), 0.0)
    store.keep(task.number, frame, geometry)
    vector: Bytes = signature.vector[: task.length]
    # of a distractor without a pose only this is known: no other frame can be placed by it
    scene = task.chosen.name if frame.pose is None else task.chosen.scene
    pose = np.eye(4) if frame.pose is None else frame.pose
    return _Done(Member(task.number, task.chosen.name, scene, pose, vector), "", spent)
