"""Reports of pair evaluations, as JSON and as text.

PairEvaluation  --pair_figures-->  dict  --pair_table-->  lines
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np

from sceneprint.geometry.validation.acceptance import AcceptanceParameters, Evidence
from sceneprint.geometry.validation.map_verification import at_place, distinct_viewpoints
from sceneprint.geometry.validation.validation import PairValidation
from sceneprint.types import Floats
from sceneprint_lab.evaluation.measures import (
    CONFIDENCE,
    Figures,
    accuracy,
    roc,
    upper_bound,
    validation_of,
)
from sceneprint_lab.evaluation.pair_run import BINS, METHODS, PairEvaluation, Tried
from sceneprint_lab.evaluation.protocol import Error, ValidatedPair
from sceneprint_lab.evaluation.report import decimal, error_figures, without_infinities
from sceneprint_lab.evaluation.run import PLANAR

_COLUMNS = ("within_5cm_5deg", "right")
_LIMITS = "within 5 cm / right"
_HEAD = f"{'':24}" + "".join(f"{name + ' %':>16}" for name in BINS)


def pair_table(report: dict[str, Any]) -> list[str]:
    """Return the result of `pair_figures` as lines of text."""
    lines: list[str] = []
    for scene, own in report.get("scenes", {}).items():
        lines += [f"{scene}, alone", *_bins(own), ""]
    if lines:
        lines.append("all scenes")
    lines += [*_bins(report), ""]
    if "baselines" in report:
        lines += [*_baselines(report), ""]
    lines += [*_negatives(report["negatives"]), "", *_statistics(report["roc"]), ""]
    v = report["validation"]
    lines.append(
        f"acceptance    precision {decimal(v['precision'])}, recall {decimal(v['recall'])}, where "
        f"overlap is 30 % {decimal(v['recall_overlap_30'])}; {v['accepted']} of {v['pairs']} pairs "
        f"accepted, {v['accepted_strong']} strong"
    )
    s = report["support"]
    lines.append(
        f"second pair   {s['supported']} accepted pairs agree with a second pair: precision "
        f"{decimal(s['precision'])}; {s['contradicted']} disagree with all others: "
        f"{decimal(s['precision_contradicted'])}; {s['alone']} have no second pair: "
        f"{decimal(s['precision_alone'])}"
    )
    kinds = [failure["what"] for failure in report["failures"]]
    counts = [f"{kinds.count(kind)} {kind.replace('_', ' ')}" for kind in dict.fromkeys(kinds)]
    lines.append(f"failures      {', '.join(counts) or 'none'}")
    times = report["milliseconds"]
    lines.append(
        f"milliseconds  prepare {decimal(times['prepare'], 1)}, validate "
        f"{decimal(times['validate'], 1)} (medians)"
    )
    return lines


def _bins(report: dict[str, Any]) -> list[str]:
    of = report["bins"]
    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("pairs", lambda figures: str(figures["pairs"])),
        (_LIMITS, lambda figures: _two(figures["success"])),
        ("  from the true pose", lambda figures: _two(figures["bound"])),
        ("accepted", lambda figures: str(figures["validation"]["accepted"])),
        ("  precision", lambda figures: decimal(figures["validation"]["precision"])),
        ("  recall", lambda figures: decimal(figures["validation"]["recall"])),
        ("with a second pair", lambda figures: str(figures["support"]["supported"])),
        ("  precision", lambda figures: decimal(figures["support"]["precision"])),
    ]
    lines = [_HEAD]
    for name, cell in rows:
        lines.append(f"{name:24}" + "".join(f"{cell(of[b]):>16}" for b in BINS))
    v = report["validation"]
    if "same_scene" in report:
        same = report["same_scene"]
        lines.append(
            f"including {same['pairs']} pairs of the scene without overlap: precision "
            f"{decimal(v['precision'])}, recall {decimal(v['recall'])}, where overlap is 30 % "
            f"{decimal(v['recall_overlap_30'])}"
        )
    return lines


def _baselines(report: dict[str, Any]) -> list[str]:
    of = report["baselines"]
    lines = [f"beside Open3D, {of['pairs']} pairs, {_LIMITS}", _HEAD]
    ours = (f"{_two(report['bins'][name]['success']):>16}" for name in BINS)
    lines.append(f"{'ours':24}" + "".join(ours))
    for method, own in of["methods"].items():
        for step, name in (("start", ""), ("icp", " + ICP"), ("ours", " + ours")):
            cells = [_two(own["bins"][b][step]) for b in BINS]
            lines.append(f"{method + name:24}" + "".join(f"{cell:>16}" for cell in cells))
    times = [
        f"{method} + ICP {decimal(own['milliseconds'], 0)} (ours / it {decimal(own['time_ratio'])})"
        for method, own in of["methods"].items()
    ]
    lines.append(
        f"milliseconds  ours {decimal(of['milliseconds'], 0)}, {', '.join(times)}; medians, one "
        "thread, features of both frames counted"
    )
    return lines


def _negatives(report: dict[str, Any]) -> list[str]:
    names = {
        "same scene, no overlap": report["same_scene"],
        "two scenes": report["cross_scene"],
        "  a frame planar": report["cross_scene_planar"],
        **{f"  {name}": own for name, own in report["by_scenes"].items()},
    }
    lines = [f"{'negatives':36}{'pairs':>8}{'accepted':>10}{'strong':>8}{'at most':>10}"]
    for name, own in names.items():
        if own["pairs"]:
            lines.append(
                f"{name:36}{own['pairs']:>8}{own['accepted']:>10}{own['accepted_strong']:>8}"
                f"{decimal(own['upper'], 5):>10}"
            )
    lines.append(
        f"(at most: the rate, with {report['confidence']:.0%} confidence, were pairs independent)"
    )
    return lines


def _statistics(report: dict[str, Any]) -> list[str]:
    lines = [f"{'decides alone':16}{'area':>8}{'right at no wrong':>20}{'at 1 %':>8}{'at 5 %':>8}"]
    for name, own in report.items():
        at = own["right_at"]
        lines.append(
            f"{name:16}{decimal(own['area']):>8}{decimal(at['0']):>20}{decimal(at['0.01']):>8}"
            f"{decimal(at['0.05']):>8}"
        )
    return lines


def _two(shares: dict[str, float | None]) -> str:
    return " / ".join(decimal(shares[name]) for name in _COLUMNS)


#: False rates at which curves are evaluated.
FALSE_RATES = (0.0, 0.01, 0.05)


def evidence(v: PairValidation, p: AcceptanceParameters) -> float:
    """Return the evidence for acceptance, with infinite stiffness."""
    e = Evidence(v.residual_m, v.residual_rad, v.overlap, v.plane_overlap, v.violations, math.inf)
    return e.total(p)


def residual(v: PairValidation, p: AcceptanceParameters) -> float:
    """Return the residual of the two search directions as a multiple of its limit."""
    return max(v.residual_m / p.residual_m, v.residual_rad / p.residual_rad)


#: Statistics of a transform, all higher for right transforms; None if unknown.
STATISTICS: dict[str, Callable[[PairValidation, AcceptanceParameters], float | None]] = {
    "residual": lambda v, p: -residual(v, p),
    "overlap": lambda v, _: v.overlap,
    "plane_overlap": lambda v, _: v.plane_overlap,
    "violations": lambda v, _: None if v.violations is None else -v.violations,
    "evidence": evidence,
    "ambiguity": lambda v, _: -v.ambiguity,
    "inliers": lambda v, _: v.inliers,
}


def curves(pairs: Sequence[ValidatedPair], p: AcceptanceParameters) -> dict[str, Any]:
    """Return the receiver operating characteristic of each statistic as the sole criterion.

    A pair is right if its transform is right, accepted or not. A pair without a transform or
    without the statistic has no evidence. For `ambiguity`, only pairs with a search for rivals
    count. `curve` contains (false rate, true rate, threshold); thresholds of statistics that are
    lower for right transforms are negated.
    """
    report = {}
    for name, statistic in STATISTICS.items():
        own = [pair for pair in pairs if name != "ambiguity" or _ambiguity_was_tested(pair)]
        values = [
            statistic(pair.validation, p) if pair.validation.T_match_query is not None else None
            for pair in own
        ]
        right = np.array([pair.right for pair in own], bool)
        curve = roc(np.array([-math.inf if v is None else v for v in values], float), right)
        report[name] = {
            "right": int(right.sum()),
            "wrong": int((~right).sum()),
            "area": None if curve is None else curve.area,
            "right_at": {
                f"{share:g}": None if curve is None else curve.true_at(share)
                for share in FALSE_RATES
            },
            "curve": [] if curve is None else curve.thinned(),
        }
    return report


def _ambiguity_was_tested(pair: ValidatedPair) -> bool:
    return pair.accepted or pair.validation.ambiguity > 0


#: Version of the JSON; it increases when the meaning of a key changes.
SCHEMA_VERSION = 1


def pair_figures(evaluation: PairEvaluation, settings: dict[str, Any]) -> dict[str, Any]:
    """Return all figures of an evaluation of pairs.

    `settings`: all settings with which the evaluation can be repeated.
    """
    members, tried = evaluation.members, evaluation.tried
    scenes = list(dict.fromkeys(member.scene for member in members))
    scene_of = [member.scene for member in members]
    report: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "settings": settings}
    report["counts"] = {
        "frames": {scene: scene_of.count(scene) for scene in scenes},
        "planar": {
            scene: sum(
                own == scene and bool(share >= PLANAR)
                for own, share in zip(scene_of, evaluation.planes, strict=True)
            )
            for scene in scenes
        },
        "left_out": len(evaluation.left_out),
        "pairs": len(tried),
    }
    report["left_out"] = [{"name": n, "reason": why} for n, why in evaluation.left_out]
    limits = evaluation.limits
    seconds = second_pairs(evaluation)
    report["bins"] = bins(tried, seconds, limits)
    report["negatives"] = negatives(evaluation)
    report["validation"] = validation_of([trial.pair for trial in tried])
    report["support"] = support(tried, seconds)

    def within(scene: str) -> list[int]:
        return [
            i
            for i, trial in enumerate(tried)
            if scene_of[trial.drawn.query] == scene_of[trial.drawn.match] == scene
        ]

    if len(scenes) > 1:
        report["scenes"] = {
            scene: _of_scene(within(scene), tried, seconds, limits) for scene in scenes
        }
    report["roc"] = curves([trial.pair for trial in tried], evaluation.acceptance)
    report["milliseconds"] = {
        "prepare": evaluation.prepare_ms,
        "validate": _median([trial.pair.milliseconds for trial in tried]),
    }
    if any(trial.others is not None for trial in tried):
        report["baselines"] = baselines(tried, limits)
    report["failures"] = failures(evaluation)
    cleaned: dict[str, Any] = without_infinities(report)
    return cleaned


def _of_scene(
    own: Sequence[int], tried: Sequence[Tried], seconds: Sequence[Second | None],
    limits: tuple[float, float],
) -> dict[str, Any]:  # fmt: skip
    """Return `bins`, `same_scene`, `validation` and `support` for the pairs of one scene."""
    pairs, theirs = [tried[i] for i in own], [seconds[i] for i in own]
    return {
        "bins": bins(pairs, theirs, limits),
        "same_scene": rate([trial for trial in pairs if trial.drawn.kind == "same_scene"]),
        "validation": validation_of([trial.pair for trial in pairs]),
        "support": support(pairs, theirs),
    }


#: Relation of an accepted pair to the other accepted pairs of the same query.
Second = Literal["supported", "contradicted", "alone"]


def second_pairs(evaluation: PairEvaluation) -> list[Second | None]:
    """Return the relation of each accepted pair to others; None for pairs that are not accepted.

    An accepted pair implies a pose of its query, given the reference pose of its match. A pair is
    supported if another accepted pair of the same query, with a match from a different viewpoint,
    implies a pose at the same place. It is contradicted if all such pairs imply poses at other
    places or in other scenes, and alone if there is no such pair.
    """
    members, p = evaluation.members, evaluation.map
    of_query: dict[int, list[int]] = {}
    poses: dict[int, Floats] = {}
    for i, trial in enumerate(evaluation.tried):
        T = trial.pair.validation.T_match_query
        if trial.pair.accepted and T is not None:
            of_query.setdefault(trial.drawn.query, []).append(i)
            poses[i] = members[trial.drawn.match].pose @ T
    relations: list[Second | None] = [None] * len(evaluation.tried)
    for own in of_query.values():
        for i in own:
            match = members[evaluation.tried[i].drawn.match]
            agree = []
            for j in own:
                other = members[evaluation.tried[j].drawn.match]
                views = np.stack([match.pose, other.pose])
                if match.scene != other.scene:
                    agree.append(False)
                elif len(distinct_viewpoints(views, p)) > 1:
                    agree.append(bool(at_place(poses[j][None], poses[i], p)[0]))
            relations[i] = "supported" if any(agree) else "contradicted" if agree else "alone"
    return relations


def support(tried: Sequence[Tried], seconds: Sequence[Second | None]) -> dict[str, Any]:
    """Return the number and the precision of the accepted pairs with each relation of Second."""
    report: dict[str, Any] = {}
    kinds: tuple[Second, ...] = get_args(Second)
    for kind in kinds:
        right = [t.pair.right for t, second in zip(tried, seconds, strict=True) if second == kind]
        report[kind] = len(right)
        name = "precision" if kind == "supported" else f"precision_{kind}"
        report[name] = sum(right) / len(right) if right else None
    return report


def bins(
    tried: Sequence[Tried], seconds: Sequence[Second | None], limits: tuple[float, float]
) -> dict[str, dict[str, Any]]:
    """Return the rates of right and of accepted transforms for each bin of true overlap.

    `success`: shares of right transforms; `right` uses the limits of the evaluation. `bound`: the
    same after refinement from the reference pose. A pair without a transform is a failure.
    `validation`: see `measures.validation`. `support`: see `support`.
    """
    report = {}
    for name in BINS:
        chosen = [i for i, trial in enumerate(tried) if trial.drawn.bin == name]
        own = [tried[i].pair for i in chosen]
        report[name] = {
            "pairs": len(own),
            "success": _shares([pair.error for pair in own], limits),
            "bound": _shares([pair.bound or Error() for pair in own], limits),
            "validation": validation_of(own),
            "support": support([tried[i] for i in chosen], [seconds[i] for i in chosen]),
        }
    return report


def _shares(errors: Sequence[Error], limits: tuple[float, float]) -> Figures:
    """Return the shares of errors within 5 cm and 5 deg, 10 cm and 10 deg, and `limits`."""
    figures = accuracy(errors)
    right = sum(e.within(*limits) for e in errors) / len(errors) if errors else None
    return {
        "within_5cm_5deg": figures["within_5cm_5deg"],
        "within_10cm_10deg": figures["within_10cm_10deg"],
        "right": right,
    }


def negatives(evaluation: PairEvaluation) -> dict[str, Any]:
    """Return the rates at which pairs without overlap are accepted, and upper bounds on the rates.

    `cross_scene_planar`: pairs with a planar frame. `by_scenes`: rates for each pair of scenes.
    """
    tried, members = evaluation.tried, evaluation.members
    same = [trial for trial in tried if trial.drawn.kind == "same_scene"]
    cross = [trial for trial in tried if trial.drawn.kind == "cross_scene"]
    couples: dict[str, list[Tried]] = {}
    for trial in cross:
        a, b = members[trial.drawn.query].scene, members[trial.drawn.match].scene
        couples.setdefault(f"{a} | {b}", []).append(trial)
    return {
        "same_scene": rate(same),
        "cross_scene": rate(cross),
        "cross_scene_planar": rate([trial for trial in cross if trial.drawn.planar]),
        "by_scenes": {name: rate(own) for name, own in couples.items()},
        "confidence": CONFIDENCE,
    }


def rate(tried: Sequence[Tried]) -> dict[str, float | int | None]:
    """Return counts and the accepted share of pairs without overlap; `upper`: see `upper_bound`."""
    accepted = [trial.pair for trial in tried if trial.pair.accepted]
    return {
        "pairs": len(tried),
        "planar": sum(trial.drawn.planar for trial in tried),
        "accepted": len(accepted),
        "accepted_strong": sum(pair.validation.strength == "strong" for pair in accepted),
        "upper": upper_bound(len(accepted), len(tried)),
    }


def baselines(tried: Sequence[Tried], limits: tuple[float, float]) -> dict[str, Any]:
    """Return the success of the baselines on the same pairs, by bin, and the time ratios.

    `start`: before refinement; `icp`: after the baseline's ICP; `ours`: after our refinement
    instead. `time_ratio`: median over pairs of our time divided by the baseline's, with features.
    """
    beside = [trial for trial in tried if trial.others is not None]
    report: dict[str, Any] = {"pairs": len(beside), "methods": {}}
    report["milliseconds"] = _median([trial.milliseconds for trial in beside if trial.milliseconds])
    for method in METHODS:
        by_bin = {}
        for name in BINS:
            own = [(trial.others or {}).get(method) for trial in beside if trial.drawn.bin == name]
            by_bin[name] = {
                "start": _shares([other.start if other else Error() for other in own], limits),
                "icp": _shares([other.icp if other else Error() for other in own], limits),
                "ours": _shares([other.ours if other else Error() for other in own], limits),
            }
        both = [
            (trial.milliseconds, trial.others[method].milliseconds)
            for trial in beside
            if trial.milliseconds and trial.others and method in trial.others
        ]
        report["methods"][method] = {
            "bins": by_bin,
            "milliseconds": _median([theirs for _, theirs in both]),
            "time_ratio": _median([ours / theirs for ours, theirs in both]),
        }
    return report


def why(trial: Tried) -> str | None:
    """Return the kind of failure of a pair; None if it is not a failure.

    `wrongly_accepted`: a wrong transform was accepted. If the pair was not accepted:
    `not_believed`, the transform was right; `near`, its error was up to twice the limits;
    `not_found`, the error was larger or there was no transform, although the frames overlap.
    """
    pair = trial.pair
    if pair.accepted:
        return None if pair.right else "wrongly_accepted"
    if pair.right:
        return "not_believed"
    if trial.drawn.kind != "overlapping":
        return None
    metres, degrees = pair.limits
    return "near" if pair.error.within(2 * metres, 2 * degrees) else "not_found"


def failures(evaluation: PairEvaluation) -> list[dict[str, Any]]:
    """Return all failed pairs with their validations, worst kind first."""
    order = ("wrongly_accepted", "not_believed", "near", "not_found")
    listed = [(why(trial), number, trial) for number, trial in enumerate(evaluation.tried)]
    wrong = [(kind, number, trial) for kind, number, trial in listed if kind is not None]
    wrong.sort(key=lambda entry: (order.index(entry[0]), entry[1]))
    return [
        {
            "number": number,
            "what": kind,
            "query": evaluation.members[trial.drawn.query].name,
            "match": evaluation.members[trial.drawn.match].name,
            "kind": trial.drawn.kind,
            "planar": trial.drawn.planar,
            "true_overlap": trial.drawn.overlap_least,
            **_pair_record(trial.pair, evaluation.acceptance),
            "bound": None if trial.pair.bound is None else error_figures(trial.pair.bound),
        }
        for kind, number, trial in wrong
    ]


def _pair_record(pair: ValidatedPair, p: AcceptanceParameters) -> dict[str, Any]:
    v = pair.validation
    return {
        **error_figures(pair.error),
        "status": v.status,
        "strength": v.strength,
        "reason": v.reason,
        "residual_m": v.residual_m,
        "residual_deg": math.degrees(v.residual_rad),
        "overlap": v.overlap,
        "plane_overlap": v.plane_overlap,
        "violations": v.violations,
        "evidence": evidence(v, p),
        "ambiguity": v.ambiguity,
        "inliers": v.inliers,
    }


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None
