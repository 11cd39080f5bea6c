"""The figures of an evaluation as lines to read in a terminal.

figures  --table-->  lines
"""

from __future__ import annotations

from typing import Any

from sceneprint.evaluation.recall import FIRST
from sceneprint.evaluation.report import ROWS

_NAMES = {"pose_average": "pose average", "pose_average_vr": "  of VR's views"}
_HEAD = f"{'':18}{'5cm/5deg':>10}{'10cm/10deg':>12}{'median cm':>11}{'deg':>7}"
_OVERLAP_HEAD = f"{'overlap':>10}{'top1 @.5':>10}{'top5 @.5':>10}{'top1 @.3':>10}{'scene':>8}"


def table(found: dict[str, Any]) -> list[str]:
    """The rows and a line for each of the rest; figures as `report.figures` gives them."""
    lines = []
    for scene, figures in found.get("scenes", {}).items():
        lines += [f"{scene}, alone", *_rows(figures), ""]
    if "average" in found:
        lines += ["Average", *_rows(found["average"]), "", "Combine"]
    lines += _rows(found)
    lines += [_chance(found[name], name) for name in ("oracle", "random")]
    baselines = found.get("baselines", {})
    lines += [_accuracy(n, row) + _overlap(row) for n, row in baselines.items() if "recall" in row]
    lines += ["", *_recalls(found), "", *_sentences(found), ""]
    for scene, figures in found.get("by_scene", {}).items():
        lines += [f"queries of {scene}, among all", *_rows(figures), _lost(figures), ""]
    if found["left_out"]:
        lines.append(_left_out(found))
    return [*lines, _times(found)]


def _rows(figures: dict[str, Any]) -> list[str]:
    lines = [_HEAD + _OVERLAP_HEAD]
    lines += [_accuracy(_NAMES.get(r, r), figures[r]) + _overlap(figures[r]) for r in ROWS]
    bounds = figures.get("bound", {})
    names = {"VDR": "bound of VDR", "pose_average": "bound of average"}
    return lines + [_accuracy(names[row], bounds[row]) for row in bounds]


def _accuracy(name: str, row: dict[str, Any]) -> str:
    metres = row["median_translation_m"]
    return (
        f"{name:18}{_share(row['within_5cm_5deg']):>10}{_share(row['within_10cm_10deg']):>12}"
        f"{'-' if metres is None else f'{100 * metres:.1f}':>11}"
        f"{_share(row['median_rotation_deg'], 1):>7}"
    )


def _overlap(row: dict[str, Any]) -> str:
    if "mean_overlap" not in row:
        return ""
    keys = ("mean_overlap", "top1_overlap_50", "top5_overlap_50", "top1_overlap_30")
    return "".join(f"{_share(row[key]):>10}" for key in keys) + (
        f"{_share(row['right_scene']):>8}" if "right_scene" in row else ""
    )


def _recalls(found: dict[str, Any]) -> list[str]:
    """Recall by every way to rank, and what a query costs beside the signature."""
    if "recall" not in found:  # of figures that were kept before there was one
        return []
    within = found["recall"]["within_m"]
    place = "overlap by half" if within is None else f"taken within {within:g} m"
    able = found["recall"]["R"]["queries"]
    lines = [
        f"{f'{able} queries with a frame that is their place ({place}), recall':58}"
        f"{'@1':>10}{'@5':>10}{'@10':>10}{'ms':>10}{'x ours':>8}"
    ]
    lines += [_recall(name, found["recall"][name]) for name in ("R", "DR", "random")]
    for name, row in found.get("baselines", {}).items():
        if "recall" not in row:
            lines.append(f"{name:18}not asked: {row['reason']}")
            continue
        spent = row["milliseconds"]["describe"] + row["milliseconds"]["rank"]
        ratio = f"{spent:>10.1f}{_share(row['ratio'], 2):>8}"
        lines.append(_recall(name, row["recall"]) + ratio)
    return lines


def _recall(name: str, row: dict[str, Any]) -> str:
    return f"{name:58}" + "".join(f"{_share(row.get(f'at_{k}')):>10}" for k in FIRST)


def _chance(row: dict[str, Any], name: str) -> str:
    return f"{name:58}" + _overlap(row)


def _sentences(found: dict[str, Any]) -> list[str]:
    v, d, a = found["validation"], found["diversity"], found["absent"]
    lines = [
        f"acceptance    precision {_share(v['precision'])}, recall {_share(v['recall'])}, where "
        f"overlap is 30 % {_share(v['recall_overlap_30'])}; {v['accepted']} of {v['pairs']} pairs "
        f"accepted, {v['accepted_strong']} strong",
    ]
    if v["pairs_of_other_scenes"]:
        lines.append(
            f"other scenes  {v['accepted_of_other_scenes']} of {v['pairs_of_other_scenes']} pairs "
            f"accepted, {v['accepted_strong_of_other_scenes']} strong"
        )
    spread = ", ".join(
        f"{row} {_share(of['mean_m'])} +- {_share(of['std_m'])}"
        for row, of in d["translation"].items()
    )
    lines.append(f"translation   {spread} m")
    if d["coverage"]["VR"] is not None:
        c = d["coverage"]
        lines.append(
            f"coverage      VR {c['VR']:.0f}, VDR {c['VDR']:.0f} voxels of 2 cm: x "
            f"{c['ratio_of_means']:.2f} (mean of ratios {c['mean_ratio']:.2f})"
        )
    lines.append(_lost(found))
    if a["queries"]:
        lines.append(
            f"absent        {a['queries']} queries whose scene is not in the database: "
            f"{_share(a['accepted_strong'])} accepted strong, {_share(a['accepted_weak'])} weak"
        )
    return lines


def _lost(figures: dict[str, Any]) -> str:
    counts = [f"{n} {place.replace('_', ' ')}" for place, n in figures["lost"].items() if n]
    return f"queries       {', '.join(counts)}"


def _left_out(found: dict[str, Any]) -> str:
    first = found["left_out"][0]
    more = len(found["left_out"]) - 1
    name = first["name"] if first["name"].isprintable() else ascii(first["name"])
    reason = first["reason"] if first["reason"].isprintable() else ascii(first["reason"])
    rest = f"; and {more} more (all are named in --json)" if more else ""
    return f"left out      {name}: {reason}{rest}"


def _times(found: dict[str, Any]) -> str:
    times = [
        f"{stage.replace('_', ' ')} {ms:.1f}"
        for stage, ms in found["milliseconds"].items()
        if ms is not None
    ]
    return f"milliseconds  {', '.join(times)} (medians; validate: of one pair)"


def _share(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
