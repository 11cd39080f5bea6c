"""The table of file formats as a page of the documentation and as a module of the dashboard."""

from __future__ import annotations

import json

from sceneprint_client.formats import Kind, formats_of
from tools.site.markup import code, page, table

_TITLES: dict[Kind, str] = {
    "depth": "Depth images",
    "cloud": "Point clouds",
    "map": "Whole maps",
    "archive": "Archives",
    "recording": "Recordings of ROS",
    "capture": "Files of other systems",
}
#: Kinds of files that the dashboard accepts, in the order of its checks: an array is rather a cloud
#: than an image, and a cloud rather a frame than a whole map.
_DASHBOARD: tuple[Kind, ...] = ("cloud", "depth", "map", "archive", "recording")


def formats_page() -> str:
    """Return Markdown with a table of the formats of each kind."""
    return page(
        "# File formats",
        "This page lists every supported format, and the data that is read from it. "
        "Files are recognised by their first bytes, except where the table says *by name*.",
        *(f"## {title}\n\n{_rows(kind)}" for kind, title in _TITLES.items()),
        "See also [point clouds](clouds.md), [recordings](recordings.md), [captures](exports.md).",
    )


def _rows(kind: Kind) -> str:
    return table(
        ("format", "names", "what is read", "media type"),
        (
            (
                one.title,
                ", ".join(map(code, one.suffixes)) + ("" if one.signature else ", by name"),
                one.content,
                code(one.media_type),
            )
            for one in formats_of(kind)
        ),
    )


def formats_module() -> str:
    """Return JavaScript with the formats that the dashboard accepts."""
    clouds = {one.name for one in formats_of("cloud")}  # the user may mark any of them as a map
    rows = "".join(
        f"  {json.dumps(row)},\n"
        for kind in _DASHBOARD
        for file_format in formats_of(kind)
        if kind != "map" or file_format.name not in clouds
        for row in [{"kind": kind, "name": file_format.name, "title": file_format.title,
                     "suffixes": file_format.suffixes, "signature": file_format.signature}]
    )  # fmt: skip
    return (
        "// The formats of files, written by `make goldens` from sceneprint_client/formats.py.\n"
        '\n/** @typedef {"depth"|"cloud"|"map"|"archive"|"recording"} FileKind */\n'
        "/** @type {{kind: FileKind, name: string, title: string, suffixes: string[], "
        "signature: string}[]} */\n"
        f"export const FORMATS = [\n{rows}];\n"
    )
