"""Reports of evaluations, as JSON and as text for a terminal.

Evaluation  --figures-->  dict  --to_json-->  bytes        dict  --table-->  lines
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneprint.geometry.rigid import inverse
from sceneprint.types import AnyFrame, Floats
from sceneprint_client.api import Answer, Match
from sceneprint_lab.evaluation.measures import (
    FIRST,
    Figures,
    absent,
    accuracy,
    answers,
    bound,
    diversity,
    lost,
    oracle_and_random,
    overlap_figures,
    place_of,
    recall,
    rows,
    validation,
)
from sceneprint_lab.evaluation.protocol import VIEWS, Error, QueryOutcome, ValidatedPair, pose_error
from sceneprint_lab.evaluation.run import Evaluation


def recalls(evaluation: Evaluation) -> dict[str, Any]:
    """Return the recall of R, of C and of random frames; see `recall`.

    `within_m` is the maximum distance of a frame that shows the query's place, metres; if null, an
    overlap of half is required instead.
    """
    relevant, allowed = evaluation.relevant, evaluation.allowed
    good, n = (relevant & allowed).sum(axis=1), allowed.sum(axis=1)
    shares = good[good > 0] / n[good > 0]
    return {
        "within_m": evaluation.within_m,
        "R": recall(relevant, allowed, [o.ranking for o in evaluation.outcomes]),
        "DR": recall(relevant, allowed, [o.selection for o in evaluation.outcomes]),
        "random": {"queries": len(shares), "at_1": float(shares.mean()) if len(shares) else None},
    }


def baseline_rows(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """Return the figures of each baseline, by name: those of row R except `right_scene`, and more.

    `recall`: see `recall`. `milliseconds`: see Compared. `ratio`: time to describe a query and to
    rank the database, divided by the time for these with the signature. A baseline that cannot be
    used has only a `reason`.
    """
    outcomes = evaluation.outcomes
    ours = float(np.median([o.milliseconds["rank"] for o in outcomes]))
    here = [i for i, o in enumerate(outcomes) if o.present]
    report: dict[str, dict[str, Any]] = {}
    for baseline in evaluation.compared:
        if baseline.reason:
            report[baseline.name] = {"reason": baseline.reason}
            continue
        firsts = [baseline.first[i] for i in here]
        five = [
            [outcomes[i].overlap_of(match) for match in baseline.rankings[i][: FIRST[1]]]
            for i in here
        ]
        ms = baseline.milliseconds
        report[baseline.name] = {
            **accuracy([Error() if pair is None else pair.error for pair in firsts]),
            **overlap_figures(five),
            "recall": recall(evaluation.relevant, evaluation.allowed, baseline.rankings),
            "milliseconds": ms,
            "ratio": (ms["describe"] + ms["rank"]) / (ms["sign"] + ours),
        }
    return report


@dataclass(frozen=True, eq=False)
class FramePlace:
    """The parent frame and the pose T_parent_sensor (4, 4) of a frame."""

    parent: str
    pose: Floats


@dataclass(frozen=True, eq=False)
class Judgement:
    """The errors of the answers to a query.

    Parameters
    ----------
    first : error of each row's first match, and of `pose_average`; infinite if there is no pose
    spread : mean and standard deviation of the distances between the query and each row's first
        five frames, metres; None if fewer than two of them are in the query's parent frame
    """

    first: Mapping[str, Error]
    spread: Mapping[str, tuple[float, float] | None]


def judge_answers(
    truth: FramePlace, ranked: Answer, diverse: Answer, places: Mapping[str, FramePlace]
) -> Judgement:
    """Return the errors of two answers to the same query.

    Parameters
    ----------
    truth : reference pose of the query
    ranked : answer without diversification, with all validated matches
    diverse : answer of all stages, with all validated matches
    places : reference poses of the database frames by id
    """
    rows: dict[str, list[Match]] = {}
    for answer, names in ((ranked, ("R", "VR")), (diverse, ("DR", "VDR"))):
        rows[names[0]] = sorted(answer.matches, key=lambda match: match.rank)
        rows[names[1]] = [m for m in answer.matches if m.validation.status == "accepted"]
    first = {row: _first(matches, truth, places) for row, matches in rows.items()}
    first["pose_average"] = Error()
    if diverse.location is not None and diverse.location.pose.parent_frame == truth.parent:
        T = np.array(diverse.location.pose.matrix)
        first["pose_average"] = pose_error(T, truth.pose)
    spread = {row: _spread(matches, truth, places) for row, matches in rows.items()}
    return Judgement(first, spread)


def answer_rows(judged: Sequence[Judgement]) -> dict[str, Figures]:
    """Return the figures of each row over all queries; see `measures.rows`.

    `spread_mean_m` and `spread_std_m`: means of `Judgement.spread` over the queries that have one.
    """
    rows: dict[str, Figures] = {}
    for row in ("R", "VR", "DR", "VDR", "pose_average"):
        spreads = [spread for j in judged if (spread := j.spread.get(row)) is not None]
        mean = np.mean(spreads, axis=0).tolist() if spreads else (None, None)
        rows[row] = accuracy([judgement.first[row] for judgement in judged])
        rows[row] |= {"spread_mean_m": mean[0], "spread_std_m": mean[1]}
    return rows


def _first(matches: Sequence[Match], truth: FramePlace, places: Mapping[str, FramePlace]) -> Error:
    """Return the error of the first match; infinite if no match is in the query's parent frame."""
    for match in matches[:1]:
        place = places[match.frame_id]
        if match.transform is not None and place.parent == truth.parent:
            return pose_error(np.array(match.transform.matrix), inverse(place.pose) @ truth.pose)
    return Error()


def _spread(
    matches: Sequence[Match], truth: FramePlace, places: Mapping[str, FramePlace]
) -> tuple[float, float] | None:
    """Return mean and standard deviation of the distances to the first matches; see Judgement."""
    near = [places[match.frame_id] for match in matches[:VIEWS]]
    metres = [
        float(np.linalg.norm(place.pose[:3, 3] - truth.pose[:3, 3]))
        for place in near
        if place.parent == truth.parent
    ]
    return (float(np.mean(metres)), float(np.std(metres))) if len(metres) >= 2 else None


#: Version of the JSON; it increases when the meaning of a key changes.
SCHEMA_VERSION = 1

ROWS = ("R", "VR", "DR", "VDR", "pose_average", "pose_average_vr")


def figures(
    evaluation: Evaluation, database: Callable[[int], AnyFrame], settings: dict[str, Any]
) -> dict[str, Any]:
    """Return all figures of an evaluation as JSON values.

    The top level contains the figures for all queries and the whole database (`Combine` in the
    paper). If there are several scenes, `by_scene` contains the figures for the queries of each.
    For a 7-Scenes table, `scenes` contains the figures of each scene with a separate database, and
    `average` the means of their rows. For `recall` and `baselines`, see `recalls` and
    `baseline_rows`.

    Parameters
    ----------
    database : function that returns the frame of a database index, with its pose
    settings : all settings with which the evaluation can be repeated
    """
    prepared, outcomes = evaluation.prepared, evaluation.outcomes
    poses = [member.pose for member in prepared.database]
    names = [member.name for member in prepared.database]

    def of(some: Sequence[QueryOutcome]) -> dict[str, Any]:
        return measured(some, poses, database)

    report: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "settings": settings}
    report["counts"] = {
        "queries": len(prepared.queries), "database": len(prepared.database),
        "left_out": len(prepared.left_out),
    }  # fmt: skip
    report["left_out"] = [{"name": n, "reason": why} for n, why in prepared.left_out]
    report |= of(outcomes)
    report["recall"] = recalls(evaluation)
    if evaluation.compared:
        report["baselines"] = baseline_rows(evaluation)
    scenes = list(dict.fromkeys(o.scene for o in outcomes))
    if len(scenes) > 1:
        report["by_scene"] = {s: of([o for o in outcomes if o.scene == s]) for s in scenes}
    if evaluation.alone:
        report["scenes"] = {scene: of(some) for scene, some in evaluation.alone.items()}
        report["average"] = average(list(report["scenes"].values()))
    report["milliseconds"] = {"prepare": prepared.milliseconds, **milliseconds(outcomes)}
    report["per_query"] = [per_query(outcome, names) for outcome in outcomes]
    report["mistakes"] = mistakes(outcomes, names)
    cleaned: dict[str, Any] = without_infinities(report)
    return cleaned


def measured(
    outcomes: Sequence[QueryOutcome], poses: Sequence[Floats], database: Callable[[int], AnyFrame]
) -> dict[str, Any]:
    """Return all figures for a set of queries; for the parameters, see `diversity`."""
    return {
        **rows(outcomes), "bound": bound(outcomes), **oracle_and_random(outcomes),
        "validation": validation(outcomes), "diversity": diversity(outcomes, poses, database),
        "lost": lost(outcomes), "absent": absent(outcomes),
        "answers": answers([outcome.answer for outcome in outcomes]),
    }  # fmt: skip


def average(scenes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean over scenes of each figure of each row; null if a scene lacks the figure."""
    result: dict[str, Any] = {}
    for row in ROWS:
        columns = {key: [scene[row][key] for scene in scenes] for key in scenes[0][row]}
        result[row] = {
            key: None if None in values else float(np.mean(values))
            for key, values in columns.items()
        }
    return result


def milliseconds(outcomes: Sequence[QueryOutcome]) -> dict[str, float | None]:
    """Return the median time of each stage per query, or, for `validate`, per pair."""
    stages: dict[str, list[float]] = {
        stage: [o.milliseconds[stage] for o in outcomes if stage in o.milliseconds]
        for stage in ("rank", "compare_ranking", "diversify", "average", "answer")
    }
    stages["validate"] = [pair.milliseconds for o in outcomes for pair in o.pairs.values()]
    return {stage: float(np.median(ms)) if ms else None for stage, ms in stages.items()}


def per_query(outcome: QueryOutcome, names: Sequence[str]) -> dict[str, Any]:
    """Return the results of a query for the JSON report.

    `ranking` contains the first members of R, `selection` all of C, and `matches` all pairs of C,
    accepted pairs first.
    """
    answers = outcome.views("VDR")
    overlaps = outcome.overlap_mean
    return {
        "name": outcome.name,
        "lost": place_of(outcome),
        "best_overlap": float(overlaps.max()) if len(overlaps) else None,
        "R": _answer(outcome, outcome.ranking[:1], names),
        "VDR": _answer(outcome, [pair.match for pair in answers[:1]], names),
        "accepted": len(answers),
        "pose_average": error_figures(outcome.average),
        "answer": {
            "status": outcome.answer.status, "strength": outcome.answer.strength,
            **error_figures(outcome.answer.error),
        },
        "ranking": [names[match] for match in outcome.ranking[: outcome.candidates]],
        "selection": [names[match] for match in outcome.selection],
        "matches": _matches(outcome, names),
    }  # fmt: skip


def _matches(outcome: QueryOutcome, names: Sequence[str]) -> list[dict[str, Any]]:
    distance = dict(zip(outcome.ranking, outcome.distances.tolist(), strict=True))
    return [
        {
            "match": names[pair.match],
            "distance": distance[pair.match],
            "status": pair.validation.status,
            "strength": pair.validation.strength,
            "T_match_query": None if (T := pair.validation.T_match_query) is None else T.tolist(),
        }
        for pair in outcome.tried()
    ]


def mistakes(outcomes: Sequence[QueryOutcome], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the accepted pairs with wrong and the refused pairs with right transforms."""
    return [
        {
            "query": outcome.name,
            "same_scene": pair.same_scene,
            "overlap_least": pair.overlap_least,
            "residual_m": pair.validation.residual_m,
            "residual_rad": pair.validation.residual_rad,
            "agreement": pair.validation.overlap,
            "plane_agreement": pair.validation.plane_overlap,
            "violations": pair.validation.violations,
            **_described(pair, names),
        }
        for outcome in outcomes
        for pair in outcome.pairs.values()
        if pair.accepted != pair.right
    ]


def _answer(outcome: QueryOutcome, first: list[int], names: Sequence[str]) -> dict[str, Any] | None:
    if not first:
        return None
    return _described(outcome.pairs[first[0]], names)


def _described(pair: ValidatedPair, names: Sequence[str]) -> dict[str, Any]:
    v = pair.validation
    return {
        "match": names[pair.match],
        "overlap": pair.overlap_mean,
        "status": v.status,
        "strength": v.strength,
        "reason": v.reason,
        "ambiguity": v.ambiguity,
        **error_figures(pair.error),
    }


def error_figures(error: Error) -> dict[str, float]:
    """Return an error as JSON values, in metres and degrees."""
    return {"translation_m": error.metres, "rotation_deg": math.degrees(error.radians)}


def without_infinities(value: Any) -> Any:
    """Return a JSON value in which None replaces infinite numbers and NaN."""
    if isinstance(value, dict):
        return {key: without_infinities(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinities(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_json(report: dict[str, Any]) -> bytes:
    """Return a report as the bytes of a JSON file."""
    return (json.dumps(report, indent=1, allow_nan=False) + "\n").encode()


_NAMES = {"pose_average": "pose average", "pose_average_vr": "  of VR's views"}
_HEAD = f"{'':18}{'5cm/5deg':>10}{'10cm/10deg':>12}{'median cm':>11}{'deg':>7}"
_OVERLAP_HEAD = f"{'overlap':>10}{'top1 @.5':>10}{'top5 @.5':>10}{'top1 @.3':>10}{'scene':>8}"


def table(report: dict[str, Any]) -> list[str]:
    """Return the result of `figures` as lines of text."""
    lines = []
    for scene, figures in report.get("scenes", {}).items():
        lines += [f"{scene}, alone", *_rows(figures), ""]
    if "average" in report:
        lines += ["Average", *_rows(report["average"]), "", "Combine"]
    lines += _rows(report)
    lines += [_chance(report[name], name) for name in ("oracle", "random")]
    baselines = report.get("baselines", {})
    lines += [_accuracy(n, row) + _overlap(row) for n, row in baselines.items() if "recall" in row]
    lines += ["", *_recalls(report), "", *_answers(report), "", *_sentences(report), ""]
    for scene, figures in report.get("by_scene", {}).items():
        lines += [
            f"queries of {scene}, among all", *_rows(figures), *_answers(figures), _lost(figures),
            "",
        ]  # fmt: skip
    if report["left_out"]:
        lines.append(_left_out(report))
    return [*lines, _times(report)]


#: Percentages of queries within 5 cm and 5 degrees for R and for VDR, from the paper's table.
PAPER = {
    "chess": (97.3, 99.5), "fire": (92.3, 97.8), "heads": (93.5, 98.9), "office": (89.7, 98.4),
    "pumpkin": (78.3, 82.8), "redkitchen": (87.9, 93.7), "stairs": (54.8, 61.0),
}  # fmt: skip
PAPER_OVERALL = {"average": (84.8, 90.3), "combine": (84.8, 90.4)}


def seven_scenes_table(report: dict[str, Any], scene: str) -> list[str]:
    """Return a table of the percentages of queries within 5 cm and 5 degrees, beside the paper's.

    Average and Combine cover the scenes of the evaluation. The paper has no figures for DR, because
    R has the same first match.

    Parameters
    ----------
    report : result of `figures`
    scene : name of the scene if the figures are those of a single scene
    """
    rows = ("R", "DR", "VDR", "pose_average")
    lines = [
        "7-Scenes, queries within 5 cm and 5 deg, %",
        f"{'':12}{'R':>7}{'DR':>7}{'VDR':>7}{'average':>9}{'R, paper':>10}{'VDR, paper':>12}",
    ]
    alone = report.get("scenes", {scene: report})
    several = {"average": report["average"], "combine": report} if "average" in report else {}
    for name, figures in {**alone, **several}.items():
        own = [_percent(figures[row]["within_5cm_5deg"]) for row in rows]
        r, vdr = (PAPER | PAPER_OVERALL)[name]
        lines.append(f"{name:12}{own[0]:>7}{own[1]:>7}{own[2]:>7}{own[3]:>9}{r:>10}{vdr:>12}")
    return lines


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def _rows(figures: dict[str, Any]) -> list[str]:
    lines = [_HEAD + _OVERLAP_HEAD]
    lines += [_accuracy(_NAMES.get(r, r), figures[r]) + _overlap(figures[r]) for r in ROWS]
    bounds = figures.get("bound", {})
    names = {"VDR": "bound of VDR", "pose_average": "bound of average"}
    return lines + [_accuracy(names[row], bounds[row]) for row in bounds]


def _accuracy(name: str, row: dict[str, Any]) -> str:
    metres = row["median_translation_m"]
    return (
        f"{name:18}{decimal(row['within_5cm_5deg']):>10}{decimal(row['within_10cm_10deg']):>12}"
        f"{'-' if metres is None else f'{100 * metres:.1f}':>11}"
        f"{decimal(row['median_rotation_deg'], 1):>7}"
    )


def _overlap(row: dict[str, Any]) -> str:
    if "mean_overlap" not in row:
        return ""
    keys = ("mean_overlap", "top1_overlap_50", "top5_overlap_50", "top1_overlap_30")
    return "".join(f"{decimal(row[key]):>10}" for key in keys) + (
        f"{decimal(row['right_scene']):>8}" if "right_scene" in row else ""
    )


def _recalls(report: dict[str, Any]) -> list[str]:
    """Return lines of text about the recall and the times of all rankings."""
    within = report["recall"]["within_m"]
    place = "overlap by half" if within is None else f"taken within {within:g} m"
    able = report["recall"]["R"]["queries"]
    lines = [
        f"{f'{able} queries with a frame that is their place ({place}), recall':58}"
        f"{'@1':>10}{'@5':>10}{'@10':>10}{'ms':>10}{'x ours':>8}"
    ]
    lines += [_recall(name, report["recall"][name]) for name in ("R", "DR", "random")]
    for name, row in report.get("baselines", {}).items():
        if "recall" not in row:
            lines.append(f"{name:18}not used: {row['reason']}")
            continue
        spent = row["milliseconds"]["describe"] + row["milliseconds"]["rank"]
        ratio = f"{spent:>10.1f}{decimal(row['ratio'], 2):>8}"
        lines.append(_recall(name, row["recall"]) + ratio)
    return lines


def _recall(name: str, row: dict[str, Any]) -> str:
    return f"{name:58}" + "".join(f"{decimal(row.get(f'at_{k}')):>10}" for k in FIRST)


def _chance(row: dict[str, Any], name: str) -> str:
    return f"{name:58}" + _overlap(row)


_ANSWERS = {
    "found_right": "found and right",
    "found_wrong": "found and wrong",
    "ambiguous": "ambiguous",
    "not_found": "not found",
}


def _answers(report: dict[str, Any]) -> list[str]:
    """Return lines of text about the answers."""
    shares = report["answers"]
    lines = [f"{'answers':18}{'share':>10}"]
    lines += [f"{name:18}{decimal(shares[key]):>10}" for key, name in _ANSWERS.items()]
    lines[2] += (
        f"   beyond 50 cm or 15 deg {decimal(shares['grossly_wrong'])}, at most "
        f"{decimal(shares['grossly_wrong_at_most'])}; called strong "
        f"{decimal(shares['found_strong_wrong'])}; share of the found answers "
        f"{decimal(shares['wrong_of_found'])}"
    )
    lines.append(
        f"confidence    calibration error {decimal(shares['calibration_error'])}, of the most "
        "likely pose of each query"
    )
    return lines


def _sentences(report: dict[str, Any]) -> list[str]:
    v, d, a = report["validation"], report["diversity"], report["absent"]
    lines = [
        f"acceptance    precision {decimal(v['precision'])}, recall {decimal(v['recall'])}, where "
        f"overlap is 30 % {decimal(v['recall_overlap_30'])}; {v['accepted']} of {v['pairs']} pairs "
        f"accepted, {v['accepted_strong']} strong",
    ]
    if v["pairs_of_other_scenes"]:
        lines.append(
            f"other scenes  {v['accepted_of_other_scenes']} of {v['pairs_of_other_scenes']} pairs "
            f"accepted, {v['accepted_strong_of_other_scenes']} strong"
        )
    spread = ", ".join(
        f"{row} {decimal(of['mean_m'])} +- {decimal(of['std_m'])}"
        for row, of in d["translation"].items()
    )
    lines.append(f"translation   {spread} m")
    if d["coverage"]["VR"] is not None:
        c = d["coverage"]
        lines.append(
            f"coverage      VR {c['VR']:.0f}, VDR {c['VDR']:.0f} voxels of 2 cm: x "
            f"{c['ratio_of_means']:.2f} (mean of ratios {c['mean_ratio']:.2f})"
        )
    lines.append(_lost(report))
    if a["queries"]:
        lines.append(
            f"absent        {a['queries']} queries whose scene is not in the database: "
            f"{decimal(a['accepted_strong'])} accepted strong, {decimal(a['accepted_weak'])} weak"
        )
    return lines


def _lost(figures: dict[str, Any]) -> str:
    counts = [f"{n} {place.replace('_', ' ')}" for place, n in figures["lost"].items() if n]
    return f"queries       {', '.join(counts)}"


def _left_out(report: dict[str, Any]) -> str:
    first = report["left_out"][0]
    more = len(report["left_out"]) - 1
    name = first["name"] if first["name"].isprintable() else ascii(first["name"])
    reason = first["reason"] if first["reason"].isprintable() else ascii(first["reason"])
    rest = f"; and {more} more (--json lists all)" if more else ""
    return f"left out      {name}: {reason}{rest}"


def _times(report: dict[str, Any]) -> str:
    times = [
        f"{stage.replace('_', ' ')} {ms:.1f}"
        for stage, ms in report["milliseconds"].items()
        if ms is not None
    ]
    return f"milliseconds  {', '.join(times)} (medians; validate: of one pair)"


def decimal(value: float | None, digits: int = 3) -> str:
    """Format a number for a table; None is "-"."""
    return "-" if value is None else f"{value:.{digits}f}"
