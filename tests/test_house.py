"""Tests of the project's rules: names, lengths of functions and files, and import cycles."""

import ast
import re
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sceneprint", "service", "worker", "client", "lab", "viewers", "ros2", "tools/site")
MOST_LINES = 60


@cache
def modules():
    """Syntax trees of all product modules, by path; not of copies that builds leave behind."""
    built = {"build", "install", "log"}
    paths = (
        path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))
        if built.isdisjoint(path.relative_to(ROOT / package).parts[:-1])
    )  # fmt: skip
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in paths}


def definitions(tree):
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node


def code_lines(node):
    """Lines of a function but for its docstring, which may be as long as it is useful."""
    first = node.body[0]
    docstring_lines = 0
    if ast.get_docstring(node) is not None:
        docstring_lines = (first.end_lineno or 0) - first.lineno + 1
    return (node.end_lineno or 0) - node.lineno + 1 - docstring_lines


def test_a_long_function_says_why():
    functions = [
        (path, node)
        for path, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert len(functions) > 2_000
    result = [
        f"{path}:{node.name} {code_lines(node)}"
        for path, node in functions
        if code_lines(node) > MOST_LINES
        and not re.search(r"^\s*Length: \S", ast.get_docstring(node) or "", re.MULTILINE)
    ]
    assert result == []


def imports(tree, known):
    """Which of the known modules a module imports when it is loaded.

    `from a import b` is a.b where that is a module, and else a.
    """
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            whole = (f"{node.module}.{name.name}" for name in node.names)
            yield from (one if one in known else node.module for one in whole)


def test_no_modules_import_each_other_in_a_circle():
    names = {
        path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): tree
        for path, tree in modules().items()
    }
    graph = {name: set(imports(tree, names)) - {name} for name, tree in names.items()}
    assert len(graph) > 200
    order = TopologicalSorter(graph).static_order()  # CycleError names a circle
    assert set(order) == set(graph)
