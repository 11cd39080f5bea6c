"""The page of the Python client, from its signatures and docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import sceneprint_client
from tools.site.markup import cell, code, fenced, page, plain, table

_SECTION = re.compile(r"^(Parameters|Returns|Raises|Yields)\n-+\n", re.MULTILINE)
_WIDTH = 88


def public_names() -> list[str]:
    """Return the public names of the package without its version."""
    return [name for name in sceneprint_client.__all__ if not name.startswith("_")]


def public_methods(kind: type) -> dict[str, Callable[..., object]]:
    """Return the public methods of a class and its bases, in order of definition."""
    results: dict[str, Callable[..., object]] = {}
    for base in reversed(kind.__mro__):
        if not base.__module__.startswith("sceneprint_client"):
            continue
        for name in vars(base):
            one = getattr(kind, name)
            function = getattr(one, "__func__", one)
            if not name.startswith("_") and inspect.isfunction(function):
                results[name] = function
    return results


def public_properties(kind: type) -> dict[str, str]:
    """Return the properties of a class with their descriptions."""
    return {
        name: inspect.getdoc(value) or ""
        for base in reversed(kind.__mro__)
        for name, value in vars(base).items()
        if isinstance(value, property) and base.__module__.startswith("sceneprint_client")
    }


def client_page() -> str:
    """Return a Markdown description of the public names of `sceneprint_client`."""
    return page(
        "# Python client",
        plain("Everything that `sceneprint_client` offers. Bodies and answers are the "
        "records of `sceneprint_client.api`: ") + "[Records](http/records.md). It raises the "
        "errors of `sceneprint_client.errors`: [Errors](../reference.md#problems).",
        *(_describe(name, getattr(sceneprint_client, name)) for name in public_names()),
    )  # fmt: skip


def _describe(name: str, one: Any) -> str:
    if not inspect.isclass(one):
        if callable(one):
            return page(f"## {name}", fenced(signature(name, one), "python"), markdown_of(one))
        return page(f"## {name}", f"{code(str(one))}")
    methods = {} if one is sceneprint_client.AsyncClient else public_methods(one)
    constructor = getattr(one, "__init__", None)
    shown = signature(name, constructor) if inspect.isfunction(constructor) else f"class {name}"
    properties = table(
        ("property", "meaning"),
        ((code(each), cell(text)) for each, text in public_properties(one).items()),
    )
    return page(
        f"## {name}",
        fenced(shown, "python"),
        markdown_of(one),
        properties,
        *(_method(name, each, function) for each, function in methods.items()),
    )


def _method(owner: str, name: str, function: Callable[..., object]) -> str:
    anchor = f"{owner}-{name}".lower().replace("_", "-")
    return page(
        f"### {name} {{ #{anchor} }}",
        fenced(signature(name, function), "python"),
        markdown_of(function),
    )


def signature(name: str, function: Callable[..., object]) -> str:
    """Return a function's signature, with one parameter per line if it is long."""
    result = inspect.signature(function)
    parts: list[str] = []
    before: inspect._ParameterKind | None = None
    for parameter in result.parameters.values():
        if parameter.name in ("self", "cls"):
            continue
        if parameter.kind is parameter.KEYWORD_ONLY and before not in (
            parameter.VAR_POSITIONAL,
            parameter.KEYWORD_ONLY,
        ):
            parts.append("*")
        before = parameter.kind
        parts.append(_parameter(parameter))
    # The signature of a class omits its return type.
    returned = "" if name[:1].isupper() else f" -> {_annotation(result.return_annotation)}"
    line = f"{name}({', '.join(parts)}){returned}"
    if len(line) <= _WIDTH:
        return line
    return f"{name}(\n" + "".join(f"    {part},\n" for part in parts) + f"){returned}"


def _parameter(one: inspect.Parameter) -> str:
    stars = "*" * (one.kind is one.VAR_POSITIONAL) + "**" * (one.kind is one.VAR_KEYWORD)
    text = stars + one.name
    if one.annotation is not one.empty:
        text += f": {_annotation(one.annotation)}"
    if one.default is one.empty:
        return text
    return f"{text} = {one.default!r}" if ":" in text else f"{text}={one.default!r}"


def _annotation(annotation: Any) -> str:
    """Return an annotation as in the source, including postponed ones."""
    return annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)


def markdown_of(one: object) -> str:
    """Return a docstring as Markdown, with a table for each section of NumPy's style."""
    text, *sections = _SECTION.split(inspect.getdoc(one) or "")
    parts = [_paragraphs(text)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        rows = list(_entries(body))
        if rows:
            parts.append(f"**{title}**\n\n{table(('name', 'meaning'), rows)}")
        else:
            parts.append(f"**{title}**: {plain(' '.join(body.split()))}")
    return page(*parts)


def _paragraphs(text: str) -> str:
    """Return paragraphs as Markdown; indented text is code."""
    blocks = re.split(r"\n\n", text.strip("\n"))
    shown: list[str] = []
    for block in blocks:
        if block.startswith("    "):
            shown.append(fenced(inspect.cleandoc(block), "python"))
        else:
            shown.append(plain(block))
    return page(*shown)


def _entries(body: str) -> Iterator[tuple[str, str]]:
    """Yield names with their descriptions: `name : description`, with indented further lines."""
    for entry in re.split(r"\n(?=\S)", body.strip("\n")):
        name, mark, meaning = entry.partition(" : ")
        if mark:
            yield ", ".join(code(part.strip()) for part in name.split(",")), cell(meaning)
