"""What the demo found: the paper's rows with true pose errors, and a picture."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneprint.cli.choosing import Chosen
from sceneprint.cli.demo_map import Asked
from sceneprint.evaluation.answers import Place, answer_rows, judge_answers
from sceneprint.models import read_model
from sceneprint.pictures import save_overlay
from sceneprint.signing import see

_NAMES = {
    "R": "R    nearest frame",
    "VR": "VR   validated of R",
    "DR": "DR   diverse frames",
    "VDR": "VDR  validated of DR",
    "pose_average": "pose average of VDR",
}


def report(known: Mapping[str, Chosen], asked: Sequence[Asked]) -> None:
    """Print the table, where true poses are known, and what a query took."""
    counts = Counter(one.diverse.status for one in asked)
    states = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    print(f"queries: {len(asked)}: {states or 'none could be asked'}")
    truths = [(one, place_of(one.chosen)) for one in asked]
    places = {key: place_of(one) for key, one in known.items()}
    posed = {key: place for key, place in places.items() if place is not None}
    if len(posed) == len(places) and asked and all(truth for _, truth in truths):
        rows = answer_rows(
            [judge_answers(t, one.ranked, one.diverse, posed) for one, t in truths if t is not None]
        )
        print(*table(rows), sep="\n")
    else:
        print("no table: it takes a true pose of every frame")
    if asked:
        stages = asked[0].diverse.milliseconds
        medians = [
            f"{stage} {statistics.median(one.diverse.milliseconds[stage] for one in asked):.0f}"
            for stage in stages
            if stage != "total"
        ]
        whole = 1e3 * statistics.median(one.seconds for one in asked)
        print(f"a query over HTTP: {whole:.0f} ms (median; {', '.join(medians)})")


def table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The rows as lines to read; figures as `answer_rows` gives them."""
    lines = [
        f"{'first answer within':26}{'5cm/5deg':>10}{'10cm/10deg':>12}{'median cm':>11}{'deg':>7}"
        f"{'first five: m from the query':>32}"
    ]
    for row, name in _NAMES.items():
        figures = rows[row]
        metres, degrees = figures["median_translation_m"], figures["median_rotation_deg"]
        line = f"{name:26}{_share(figures['within_5cm_5deg']):>10}"
        line += f"{_share(figures['within_10cm_10deg']):>12}"
        line += f"{'-' if metres is None else f'{100 * metres:.1f}':>11}"
        line += f"{'-' if degrees is None else f'{degrees:.2f}':>7}"
        if figures["spread_mean_m"] is not None:
            spread = f"{figures['spread_mean_m']:.2f} +- {figures['spread_std_m']:.2f}"
            line += f"{spread:>32}"
        lines.append(line)
    return lines


def draw(known: Mapping[str, Chosen], asked: Sequence[Asked], preset: str, out: Path) -> None:
    """Draw the accepted match that turns the query most: there alignment shows."""
    found = [
        (one, match)
        for one in asked
        for match in one.diverse.matches[:1]
        if match.validation.status == "accepted" and match.transform is not None
    ]
    if not found:
        print("no picture: nothing was accepted")
        return
    one, match = min(found, key=lambda pair: abs(_transform(pair[1])[:3, :3].trace() - 2.0))
    p = read_model(preset).parameters
    query, database = one.chosen.reference, known[match.frame_id].reference
    path = out / "overlay.png"
    title = (
        f"{query.name} found in {database.name}: {match.validation.overlap:.0%} of the surfaces "
        f"agree ({match.validation.strength})"
    )
    save_overlay(see(query.read(), p), see(database.read(), p), _transform(match), title, path)
    print(f"picture: {path}")


def _transform(match: Any) -> Any:
    return np.array(match.transform.matrix)


def place_of(one: Chosen) -> Place | None:
    """Where a frame was taken, where that is known."""
    pose = one.reference.pose
    return None if pose is None else Place(one.parent, pose)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
