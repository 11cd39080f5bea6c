"""The figures of pairs as lines to read in a terminal.

figures  --pair_table-->  lines
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sceneprint.evaluation.pair_drawing import BINS

_COLUMNS = ("within_5cm_5deg", "right")
_LIMITS = "within 5 cm / right"
_HEAD = f"{'':24}" + "".join(f"{name + ' %':>16}" for name in BINS)


def pair_table(found: dict[str, Any]) -> list[str]:
    """Bins, negatives, statistics and baselines; figures as `pair_report.pair_figures` has them."""
    lines: list[str] = []
    for scene, own in found.get("scenes", {}).items():
        lines += [f"{scene}, alone", *_bins(own), ""]
    if lines:
        lines.append("all scenes")
    lines += [*_bins(found), ""]
    if "baselines" in found:
        lines += [*_baselines(found), ""]
    lines += [*_negatives(found["negatives"]), "", *_statistics(found["roc"]), ""]
    v = found["validation"]
    lines.append(
        f"acceptance    precision {_number(v['precision'])}, recall {_number(v['recall'])}, where "
        f"overlap is 30 % {_number(v['recall_overlap_30'])}; {v['accepted']} of {v['pairs']} pairs "
        f"accepted, {v['accepted_strong']} strong"
    )
    kinds = [one["what"] for one in found["failures"]]
    counts = [f"{kinds.count(kind)} {kind.replace('_', ' ')}" for kind in dict.fromkeys(kinds)]
    lines.append(f"failures      {', '.join(counts) or 'none'}")
    times = found["milliseconds"]
    lines.append(
        f"milliseconds  prepare {_number(times['prepare'], 1)}, validate "
        f"{_number(times['validate'], 1)} (medians)"
    )
    return lines


def _bins(found: dict[str, Any]) -> list[str]:
    of = found["bins"]
    rows: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("pairs", lambda one: str(one["pairs"])),
        (_LIMITS, lambda one: _two(one["success"])),
        ("  from the true pose", lambda one: _two(one["bound"])),
        ("accepted", lambda one: str(one["validation"]["accepted"])),
        ("  precision", lambda one: _number(one["validation"]["precision"])),
        ("  recall", lambda one: _number(one["validation"]["recall"])),
    ]
    lines = [_HEAD]
    for name, cell in rows:
        lines.append(f"{name:24}" + "".join(f"{cell(of[b]):>16}" for b in BINS))
    v = found["validation"]
    if "same_scene" in found:
        same = found["same_scene"]
        lines.append(
            f"with {same['pairs']} pairs of it that see nothing of each other: precision "
            f"{_number(v['precision'])}, recall {_number(v['recall'])}, where overlap is 30 % "
            f"{_number(v['recall_overlap_30'])}"
        )
    return lines


def _baselines(found: dict[str, Any]) -> list[str]:
    of = found["baselines"]
    lines = [f"beside Open3D, {of['pairs']} pairs, {_LIMITS}", _HEAD]
    lines.append(f"{'ours':24}" + "".join(f"{_two(found['bins'][b]['success']):>16}" for b in BINS))
    for method, own in of["methods"].items():
        for step, name in (("start", ""), ("icp", " + ICP"), ("ours", " + ours")):
            cells = [_two(own["bins"][b][step]) for b in BINS]
            lines.append(f"{method + name:24}" + "".join(f"{cell:>16}" for cell in cells))
    times = [
        f"{method} + ICP {_number(own['milliseconds'], 0)} (ours / it {_number(own['time_ratio'])})"
        for method, own in of["methods"].items()
    ]
    lines.append(
        f"milliseconds  ours {_number(of['milliseconds'], 0)}, {', '.join(times)}; medians, one "
        "thread, features of both frames counted"
    )
    return lines


def _negatives(found: dict[str, Any]) -> list[str]:
    names = {
        "same scene, no overlap": found["same_scene"],
        "two scenes": found["cross_scene"],
        "  a frame planar": found["cross_scene_planar"],
        **{f"  {name}": own for name, own in found["by_scenes"].items()},
    }
    lines = [f"{'negatives':36}{'pairs':>8}{'accepted':>10}{'strong':>8}{'at most':>10}"]
    for name, own in names.items():
        if own["pairs"]:
            lines.append(
                f"{name:36}{own['pairs']:>8}{own['accepted']:>10}{own['accepted_strong']:>8}"
                f"{_number(own['upper'], 5):>10}"
            )
    lines.append(
        f"(at most: the rate, with {found['confidence']:.0%} confidence, were pairs independent)"
    )
    return lines


def _statistics(found: dict[str, Any]) -> list[str]:
    lines = [f"{'decides alone':16}{'area':>8}{'right at no wrong':>20}{'at 1 %':>8}{'at 5 %':>8}"]
    for name, own in found.items():
        at = own["right_at"]
        lines.append(
            f"{name:16}{_number(own['area']):>8}{_number(at['0']):>20}{_number(at['0.01']):>8}"
            f"{_number(at['0.05']):>8}"
        )
    return lines


def _two(shares: dict[str, float | None]) -> str:
    return " / ".join(_number(shares[name]) for name in _COLUMNS)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
