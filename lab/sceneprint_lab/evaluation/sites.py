"""Answers to queries at synthetic sites, computed by the functions of the service.

kind, seed, index  --ask_site-->  SiteAnswer, ...
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.geometry.rigid import apply_rotation
from sceneprint.geometry.views import view_parameters
from sceneprint.models import Model
from sceneprint.pipeline import Signer, prepare
from sceneprint.places import PosePrior
from sceneprint.types import AnyFrame, Cloud, Floats, Geometry
from sceneprint_client.poses import rotation_of
from sceneprint_lab.evaluation.judgement import Candidate, Judge, QueryTask, answer_of, rank
from sceneprint_lab.evaluation.protocol import JudgedAnswer, SignedFrame, overlaps, view_of
from sceneprint_lab.evaluation.surface_maps import join_frames, render_views
from sceneprint_lab.synth import synthesise_lookalike, synthesise_lookalike_survey
from sceneprint_lab.synth.lookalike_surveys import SURVEYED_KINDS
from sceneprint_lab.synth.lookalikes import KINDS, ORDINARY, LookalikeSite

#: Minimum overlap (`Overlaps.least`) of an answerable query with a frame of the map.
ANSWERABLE = 0.3
#: Maximum distance of a scanner's answerable query from a scan of the map, metres.
ANSWERABLE_M = 10.0
#: Standard deviations of a prior, metres and degrees; PRIOR_DEG is also its maximum rotation error.
PRIOR_M, PRIOR_DEG = 0.3, 10.0
#: Minimum and maximum edge of the voxels in which a site's map is fused, metres.
CLOUD_VOXEL_M, MESH_VOXEL_M = (0.05, 0.2), (0.015, 0.03)
#: Maximum number of views of the fused surface.
VIEWS = 150


@dataclass(frozen=True)
class SiteAnswer:
    """The answer to a query at a site.

    Parameters
    ----------
    site, kind, query : name and kind of the site, and index of the query
    answerable : whether a frame of the map overlaps the query by ANSWERABLE, or a scan is within
        ANSWERABLE_M
    """

    site: str
    kind: str
    query: int
    answerable: bool
    answer: JudgedAnswer


@dataclass(frozen=True)
class MapFlaws:
    """The flaws of a map: missing frames and drifting poses.

    Parameters
    ----------
    missing : maximum share of missing frames
    drift_m, drift_rad : maximum standard deviation of the change in error from one pose to the
        next, per direction; errors decay, so they stay within about twice this deviation
    """

    missing: float = 0.5
    drift_m: float = 0.01
    drift_rad: float = 0.003


def with_flaws(
    frames: Sequence[AnyFrame], flaws: MapFlaws, rng: np.random.Generator
) -> list[AnyFrame]:
    """Return a random subset of a map's frames, in order, with correlated pose errors.

    Parameters
    ----------
    flaws : maximum flaws; the map gets a random share of each
    """
    share = rng.uniform(0.0, 1.0, 3) * (flaws.missing, flaws.drift_m, flaws.drift_rad)
    in_map = rng.uniform(size=len(frames)) >= share[0]
    drift = np.zeros(6)
    flawed: list[AnyFrame] = []
    for frame, has_it in zip(frames, in_map, strict=True):
        drift = 0.9 * drift + rng.standard_normal(6) * np.repeat(share[1:], 3)
        if has_it and frame.pose is not None:
            T = frame.pose.copy()
            apply_rotation(frame.pose[:3, :3], drift[3:], T[:3, :3])
            T[:3, 3] += drift[:3]
            flawed.append(replace(frame, pose=T))
    return flawed


def signed(
    frames: Sequence[AnyFrame], scene: str, signer: Signer, first: int
) -> tuple[list[AnyFrame], list[SignedFrame], list[Geometry]]:
    """Sign frames of a scene; return the usable frames, their signatures and their geometries.

    The signed frames have consecutive numbers from `first`.
    """
    usable: list[AnyFrame] = []
    members: list[SignedFrame] = []
    geometries: list[Geometry] = []
    for frame in frames:
        try:
            signature, geometry = prepare(frame, signer)
        except UselessFrame:
            continue
        pose = np.eye(4) if frame.pose is None else frame.pose
        number = first + len(members)
        members.append(SignedFrame(number, frame.name, scene, pose, signature.vector))
        geometries.append(geometry)
        usable.append(frame)
    return usable, members, geometries


def prior_about(
    pose: Floats, parent: str, least: float, most: float, rng: np.random.Generator
) -> PosePrior:
    """Return a prior for a pose with a random error of `least` to `most` metres and 0 to 10 deg.

    Its standard deviations are always 30 cm and 10 degrees.
    """
    directions = rng.standard_normal((2, 3))
    shift, axis = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    T = np.eye(4)
    half = np.deg2rad(rng.uniform(0.0, PRIOR_DEG)) / 2
    T[:3, :3] = rotation_of(np.array([*(np.sin(half) * axis), np.cos(half)])) @ pose[:3, :3]
    T[:3, 3] = pose[:3, 3] + shift * rng.uniform(least, most)
    deviations = [PRIOR_M] * 3 + [np.deg2rad(PRIOR_DEG)] * 3
    return PosePrior(parent, T, np.diag(np.square(deviations)))


def kinds_of(model: Model) -> tuple[str, ...]:
    """Return the kinds of sites for the sensor of a model."""
    return SURVEYED_KINDS if _is_of_scans(model) else KINDS + ORDINARY


def _is_of_scans(model: Model) -> bool:
    return bool(model.provenance.get("training", {}).get("scenes") == "sites")


def ask_site(
    signer: Signer, work: tuple[str, int, int], *, seed: int, candidates: int = 10,
    prior: tuple[float, float] | None = None, flaws: MapFlaws | None = None,
    confidence: float | None = None, as_surface: bool = False,
) -> list[SiteAnswer]:  # fmt: skip
    """Create a site and return the answers to all queries at it.

    Parameters
    ----------
    signer : result of `open_signer`, whose model determines the sensor of the site
    work : kind (see `kinds_of`), index and number of queries
    candidates : size of C
    prior : minimum and maximum error of the robot's prior, metres; None for queries without a prior
    flaws : maximum flaws of the map; None for a map with all frames and exact poses
    confidence : minimum confidence of a pose that is found; None selects the default
    as_surface : whether the map consists of views of a surface that is fused from its frames
    """
    kind, index, queries = work
    of_scans = _is_of_scans(signer.model)
    rng = np.random.default_rng([seed, index, kinds_of(signer.model).index(kind)])
    site: LookalikeSite[AnyFrame] = (
        synthesise_lookalike_survey(kind, seed, index, queries=queries)
        if of_scans
        else synthesise_lookalike(kind, seed, index, queries=queries)
    )
    frames: Sequence[AnyFrame] = site.map if flaws is None else with_flaws(site.map, flaws, rng)
    if as_surface:
        frames = _views_of(frames, signer.model, rng)
    shown, database, of_map = signed(frames, site.name, signer, 0)
    # Queries at a place that the map lacks have a separate scene, in which no pose is right.
    scene = site.name if site.same_frame else f"{site.name}, elsewhere"
    sent, queries_signed, of_queries = signed(site.queries, scene, signer, len(database))
    if not database:
        nothing = JudgedAnswer()
        return [SiteAnswer(site.name, kind, n, False, nothing) for n in range(len(queries_signed))]
    priors = [
        None if prior is None else prior_about(query.pose, site.name, *prior, rng)
        for query in queries_signed
    ]
    answers = answers_of(
        signer, database, queries_signed, [*of_map, *of_queries], candidates, priors, confidence,
        as_surface,
    )  # fmt: skip
    able = _answerable(site, shown, sent)
    return [
        SiteAnswer(site.name, kind, number, able[number], answer)
        for number, answer in enumerate(answers)
    ]


def _views_of(
    frames: Sequence[AnyFrame], model: Model, rng: np.random.Generator
) -> Sequence[AnyFrame]:
    """Fuse frames into a surface, and return views of it, as for an imported map."""
    voxel = rng.uniform(*(CLOUD_VOXEL_M if _is_of_scans(model) else MESH_VOXEL_M))
    surface = join_frames(frames, float(voxel), np.array([0.0, 0.0, 1.0]))
    return render_views(surface, replace(view_parameters(model.parameters), most_views=VIEWS))[1]


def answers_of(
    signer: Signer, database: Sequence[SignedFrame], queries: Sequence[SignedFrame],
    geometries: Sequence[Geometry], candidates: int = 10,
    priors: Sequence[PosePrior | None] | None = None, confidence: float | None = None,
    rendered: bool = False,
) -> list[JudgedAnswer]:  # fmt: skip
    """Return the judged answers to queries on a map, in order.

    Parameters
    ----------
    database, queries : results of `signed`, with consecutive numbers from 0
    geometries : geometries of the database frames and of the queries, by number
    candidates : size of C
    priors : prior of each query; None if there are no priors
    confidence : see `ask_site`
    rendered : whether the frames of the map are views rendered from a surface
    """
    model = signer.model
    judge = Judge(
        geometries.__getitem__, "full", 0, model.parameters.validation, database=database,
        answer=model.answer, unrelated_distance=model.unrelated_distance, rendered=rendered,
    )  # fmt: skip
    if confidence is not None:
        judge = replace(judge, confidence=confidence)
    ranked = rank(
        np.stack([query.signature for query in queries]),
        np.stack([frame.signature for frame in database]),
        np.ones((len(queries), len(database)), np.bool_), metric=model.metric,
        candidates=candidates,
    )  # fmt: skip
    rows, answers = np.arange(len(database)), []
    for query, ranking, prior in zip(queries, ranked, priors or [None] * len(queries), strict=True):
        among = tuple(Candidate.of(database[j], j) for j in ranking.selection)
        task = QueryTask(
            query.number, query.scene, query.pose, [], ranking.selection, among, rows,
            ranking.retrieved,
        )  # fmt: skip
        answers.append(answer_of(judge, task, prior))
    return answers


def _answerable(
    site: LookalikeSite[AnyFrame], shown: Sequence[AnyFrame], sent: Sequence[AnyFrame]
) -> list[bool]:
    """Return whether each query is answerable; see SiteAnswer."""
    if not site.present:
        return [False] * len(sent)
    if isinstance(sent[0], Cloud):
        here, there = (np.array([f.pose[:3, 3] for f in frames if f.pose is not None])
                       for frames in (sent, shown))  # fmt: skip
        apart = np.linalg.norm(here[:, None] - there, axis=2)
        return [bool(least < ANSWERABLE_M) for least in apart.min(axis=1)]
    overlap = overlaps([view_of(q) for q in sent], [view_of(d) for d in shown])
    return [bool(most >= ANSWERABLE) for most in overlap.least.max(axis=1)]
