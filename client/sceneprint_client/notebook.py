"""HTML representation of records in notebooks: a table of their fields, and a plan of poses.

record  --html_of-->  HTML, in which every text of the record is escaped
"""

from __future__ import annotations

from datetime import datetime
from html import escape

from pydantic import BaseModel

from sceneprint_client.api.base import CameraIntrinsics, Transform, Vector
from sceneprint_client.api.query import Alternative, Answer, Localization, Location

#: Fields that the table omits.
_INTERNAL = {
    "base", "content_id", "etag", "exact", "frame", "index_version", "milliseconds", "model_id",
    "seed",
}  # fmt: skip
_COLUMNS = ("rank", "frame", "map", "similarity", "overlap", "validation")
#: Maximum number of entries of a list, and of characters of a text.
_MOST, _LONGEST = 5, 160
#: Width and height of a plan, its margin, and length of the line that shows a heading, pixels.
_SIDE, _MARGIN, _ARROW = 160, 20, 14


def html_of(record: BaseModel) -> str:
    """Return a record as HTML: a plan if it has poses, its fields, and its matches."""
    fields = [[name, text_of(value)] for name, value in record if name not in _INTERNAL]
    parts = [f"<b>{escape(type(record).__name__)}</b>", _table([row for row in fields if row[1]])]
    if isinstance(record, Answer | Localization):
        located = record.location if isinstance(record, Answer) else record
        pose = located.pose if located else None
        parts.append(_plan(pose, [alternative.pose for alternative in record.alternatives]))
    if isinstance(record, Answer) and record.matches:
        rows = [
            [str(match.rank), match.frame_id, match.map, f"{match.similarity:.2f}",
             text_of(match.validation.overlap), match.validation.status]
            for match in record.matches[:_MOST]
        ]  # fmt: skip
        parts.append(_table([list(_COLUMNS), *rows]))
    return "".join(parts)


def text_of(value: object) -> str:
    """Return a value as short text; empty for None and for records without a text form."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, datetime):
        return value.isoformat(" ", "seconds")
    if isinstance(value, Vector):
        return f"{value.x:.2f}, {value.y:.2f}, {value.z:.2f} m"
    if isinstance(value, Transform):
        return f"{text_of(value.translation)} in {value.parent_frame}"
    if isinstance(value, Location | Alternative):
        sure = "" if value.confidence is None else f", confidence {value.confidence:.2f}"
        return text_of(value.pose) + sure
    if isinstance(value, CameraIntrinsics):
        return f"{value.width} x {value.height} pixels"
    if isinstance(value, dict):
        return ", ".join(f"{text_of(count)} {name}" for name, count in value.items())
    if isinstance(value, list):
        texts = [text for item in value[:_MOST] if (text := text_of(item))]
        more = len(value) - _MOST
        return "; ".join(texts) + (f" and {more} more" if texts and more > 0 else "")
    if value is None or isinstance(value, BaseModel):
        return ""
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _table(rows: list[list[str]]) -> str:
    cells = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def _plan(best: Transform | None, others: list[Transform]) -> str:
    """Return a plan of x and y as SVG: `best` as a filled circle, the others as open circles."""
    poses = ([best] if best else []) + others[:_MOST]
    if not poses:
        return ""
    xs, ys = ([pose.matrix[axis][3] for pose in poses] for axis in (0, 1))
    span = max(max(xs) - min(xs), max(ys) - min(ys), 1.0)
    scale = (_SIDE - 2 * _MARGIN) / span
    marks = []
    for x, y, pose in zip(xs, ys, poses, strict=True):
        left = round(_MARGIN + (x - min(xs)) * scale)
        top = round(_SIDE - _MARGIN - (y - min(ys)) * scale)
        forward = 2 if pose.child_frame.endswith(".optical") else 0
        right, up = (round(_ARROW * pose.matrix[axis][forward]) for axis in (0, 1))
        fill = "currentColor" if pose is best else "none"
        marks.append(
            f'<circle cx="{left}" cy="{top}" r="4" fill="{fill}"/>'
            f'<path d="M{left} {top}l{right} {-up}"/>'
        )
    return (
        f'<svg width="{_SIDE}" height="{_SIDE}" stroke="currentColor" role="img">'
        f"<title>x to the right, y up, {span:.1f} m wide</title>{''.join(marks)}</svg>"
    )
