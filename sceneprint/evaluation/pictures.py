"""Every picture of an evaluation, into a folder.

Evaluation  --save_pictures-->  PNG and PLY files
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.evaluation.clouds import cloud_figure, merged, to_ply
from sceneprint.evaluation.contact import contact_sheet
from sceneprint.evaluation.diversity import coverage, equal_views
from sceneprint.evaluation.frames import Store
from sceneprint.evaluation.plots import (
    acceptance_figure,
    accuracy_figure,
    diversity_figure,
    save_figure,
)
from sceneprint.evaluation.records import VIEWS
from sceneprint.evaluation.run import Evaluation
from sceneprint.models import Model
from sceneprint.types import AnyFrame, Frame
from sceneprint.writing import write_whole


def save_pictures(
    folder: Path, evaluation: Evaluation, figures: dict[str, Any], store: Store, model: Model
) -> list[Path]:
    """Draw curves, bars, the contact sheet and one query's merged clouds.

    Parameters
    ----------
    folder : must exist
    evaluation : see Evaluation
    figures : as `report.figures` gives them
    store : of the evaluation's frames
    model : that signed them

    Returns
    -------
    paths : of the files written; the clouds are missing where no query has two validated views,
        or those see nothing nearer than `FARTHEST`
    """
    outcomes, prepared = evaluation.outcomes, evaluation.prepared
    used = figures["settings"]
    share = (used["levels"] or len(model.levels)) / len(model.levels)
    d0 = model.unrelated_distance * share if used["metric"] == model.metric else None

    def query(number: int) -> AnyFrame:
        return store.frame(prepared.queries[number])

    def database(match: int) -> AnyFrame:
        return store.frame(prepared.database[match])

    drawn = {
        "accuracy.png": accuracy_figure(outcomes),
        "acceptance.png": acceptance_figure(outcomes),
        "diversity.png": diversity_figure(figures),
        "contact.png": contact_sheet(outcomes, query, database, d0),
    }
    paths = []
    # of depth images alone: what a scanner sees fills no picture of this kind
    depth = all(map(store.is_depth, (*prepared.queries, *prepared.database)))
    chosen = _typical(evaluation, database) if depth else None
    if chosen is not None:
        number, ratio = chosen
        ranked, diverse = (
            merged(_depth(query(number)), pairs[:VIEWS], lambda match: _depth(database(match)))
            for pairs in equal_views(outcomes[number])
        )
        if len(ranked.points) + len(diverse.points):
            drawn["cloud.png"] = cloud_figure(outcomes[number].name, ranked, diverse, ratio)
            for name, cloud in (("cloud-vr.ply", ranked), ("cloud-vdr.ply", diverse)):
                write_whole(folder / name, to_ply(cloud))
                paths.append(folder / name)
    for name, figure in drawn.items():
        save_figure(figure, folder / name)
    return [folder / name for name in drawn] + paths


def _depth(frame: AnyFrame) -> Frame:
    if not isinstance(frame, Frame):
        raise TypeError(f"{frame.name} is no depth image")
    return frame


def _typical(evaluation: Evaluation, database: Any) -> tuple[int, float] | None:
    """The query whose gain in coverage is the median, of those with most views; and the gain."""
    outcomes = evaluation.outcomes
    views = [len(equal_views(outcome)[0]) for outcome in outcomes]
    most = max(views, default=0)
    if most < 2:
        return None
    numbers = [i for i, n in enumerate(views) if n == most]
    covered = coverage([outcomes[i] for i in numbers], database)
    ratios = [pair[1] / pair[0] if pair and pair[0] else 0.0 for pair in covered]
    middle = int(np.argsort(ratios, kind="stable")[len(ratios) // 2])
    return numbers[middle], ratios[middle]
