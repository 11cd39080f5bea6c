"""Tests of the project's rules: names, lengths of functions and files, and import cycles."""

import ast
import re
from collections import Counter, defaultdict
from functools import cache
from graphlib import TopologicalSorter
from itertools import combinations
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("sceneprint", "service", "worker", "client", "lab", "viewers", "ros2", "tools/site")
MOST_LINES = 60
#: Words that an engineer of the field would not know, and the standard term.
RETIRED = {
    "standing": "duplicate check", "bell": "wakeup", "notices": "wakeup",
    "telling": "serialize, response", "deaths": "dead letter", "bury": "dead letter",
    "wire": "serializers", "looking": "read-only", "sealed": "read-only", "made": "derived file",
    "marks": "bucket owner", "kept": "stored result", "keeping": "stored result",
    "former": "tombstone", "again": "rerun", "parts": "job output", "shown": "result validity",
    "seals": "opaque id", "sides": "association plan", "concluding": "association result",
    "endings": "job outcome",
    "truth": "database check", "accepting": "compatibility", "happenings": "event cursor",
    "belonging": "patch lookup", "growing": "append buffer", "rivals": "ambiguity",
    "switches": "reencoding", "agreement": "overlap", "choosing": "search routing",
    "surroundings": "patch descriptors", "once": "idempotency",
    "remembered": "signature cache", "slowness": "body timeout", "healing": "repair",
    "raw": "binary body", "sweeping": "blob garbage collection", "Around": "RequestMiddleware",
    "retiring": "retention", "members": "archive entries", "replaying": "idempotent replay",
    "asked": "query",
}  # fmt: skip


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


def test_no_file_and_no_definition_has_a_retired_name():
    tests = (path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))
    found = [
        path for path in (*modules(), *tests) if Path(path).stem.removeprefix("test_") in RETIRED
    ]
    for path, tree in modules().items():
        found += [f"{path}:{one.name}" for one in definitions(tree) if one.name in RETIRED]
    furniture = "lab/sceneprint_lab/synth/furniture.py:shelf"  # a shelf, for once
    assert [one for one in found if one != furniture] == []


def distance(a, b):
    """Steps from folder to folder."""
    common = 0
    for x, y in zip(a.parts, b.parts, strict=False):
        if x != y:
            break
        common += 1
    return len(a.parts) + len(b.parts) - 2 * common


def test_no_two_files_near_each_other_have_one_name():
    by_name = defaultdict(list)
    for path in modules():
        if not Path(path).stem.startswith("__"):
            by_name[Path(path).name].append(Path(path))
    near = [
        f"{a} {b}"
        for same in by_name.values()
        for a, b in combinations(same, 2)
        if distance(a.parent, b.parent) <= 2
    ]
    assert near == []


def test_no_class_name_is_there_twice():
    names = Counter(
        one.name
        for path, tree in modules().items()
        for one in definitions(tree)
        if isinstance(one, ast.ClassDef) and not one.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


def code_lines(node):
    """Lines of a function but for its docstring, which may be as long as it is useful."""
    first = node.body[0]
    told = 0
    if ast.get_docstring(node) is not None:
        told = (first.end_lineno or 0) - first.lineno + 1
    return (node.end_lineno or 0) - node.lineno + 1 - told


def test_a_long_function_says_why():
    functions = [
        (path, node)
        for path, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    assert len(functions) > 2_000
    found = [
        f"{path}:{node.name} {code_lines(node)}"
        for path, node in functions
        if code_lines(node) > MOST_LINES
        and not re.search(r"^\s*Length: \S", ast.get_docstring(node) or "", re.MULTILINE)
    ]
    assert found == []


def imports(tree, known):
    """Which of the known modules a module imports when it is loaded.

    `from a import b` is a.b where that is a module, and else a.
    """
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names if one.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            whole = (f"{node.module}.{one.name}" for one in node.names)
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
