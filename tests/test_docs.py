"""Tests of the documentation against the code: functions, equations and commands."""

import ast
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks.waiting import free_port
from sceneprint.cli import parser

ROOT = Path(__file__).resolve().parent.parent
PAPER = (ROOT / "docs/paper.md").read_text()
README = (ROOT / "README.md").read_text()
STARTED = (ROOT / "docs/getting_started.md").read_text()
LIBRARY = (ROOT / "docs/library.md").read_text()
PAGES = [
    *map(ROOT.joinpath, ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *map(ROOT.joinpath, ("client/README.md", "ros2/sceneprint_ros/README.md")),
]
GEOMETRY = sorted((ROOT / "sceneprint/geometry").rglob("*.py"))
ROWS = re.findall(r"^\| ((?:Eq\.|Sec\.)[^|]+) \| `([^`:]+):(\w+)`", PAPER, re.MULTILINE)


def function_of(path, name):
    module = import_module(path.removesuffix(".py").replace("/", "."))
    return getattr(module, name)


@pytest.mark.parametrize(("what", "path", "name"), ROWS)
def test_every_row_names_a_function_that_names_its_source(what, path, name):
    function = function_of(path, name)
    text = (inspect.getdoc(function) or "") + (ROOT / path).read_text().split('"""')[1]
    source = re.match(r"(Eq\. \(\d+)|(Sec\. III(?:-[A-F])?)", what)
    named = source[0] if source[2] else source[1]
    assert named in text or (named == "Sec. III" and "Sec. III" in text)


def test_every_equation_in_the_code_has_a_row():
    marked = {
        (mark, str(path.relative_to(ROOT)))
        for path in GEOMETRY
        for mark in re.findall(r"# (Eq\. \(\d+\w?\))", path.read_text())
    }
    assert len(marked) >= 5
    assert marked <= {(what, path) for what, path, _ in ROWS}


def test_every_reading_that_code_cites_is_explained():
    cited = {
        number
        for path in GEOMETRY
        for number in re.findall(r"\bR(\d+)\b(?=[ ,)(-])", path.read_text())
    }
    assert cited
    explained = set(re.findall(r"^\| R(\d+) \|", PAPER, re.MULTILINE))
    assert cited <= explained


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        name, _, heading = target.partition("#")
        path = page.parent / name if name else page
        assert path.exists(), target
        if heading:
            titles = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
            marks = {re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles}
            assert heading in marks, target


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands_of(text):
    return [line for block in blocks(text, "sh") for line in block.strip().splitlines()]


def test_readme_has_two_commands_one_example_and_at_most_700_words():
    assert commands_of(README) == ["make demo", ".venv/bin/sceneprint serve"]
    assert len(blocks(README, "python")) == 1
    assert len(README.split()) <= 700


def test_the_index_of_the_documentation_names_every_page():
    docs = ROOT / "docs"
    linked = set(re.findall(r"\]\(([\w/]+\.md)\)", (docs / "README.md").read_text()))
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}
    assert linked == pages - {"README.md"}


def test_documented_commands_are_known():
    commands, docs = parser(), ROOT / "docs"
    names = ("getting_started.md", "library.md", "troubleshooting.md")
    for page in (*map(docs.joinpath, names), *(docs / "sensors").glob("*.md")):
        text = page.read_text()
        lines = commands_of(text)
        if page.name not in names[:2]:
            lines += re.findall(r"`(sceneprint (?!bag)[^`]+)`", text.replace("\n", " "))
        own = [line for line in lines if re.match(r"(\.venv/bin/)?sceneprint ", line)]
        assert own, page
        for line in own:
            arguments = shlex.split(line, comments=True)[1:]
            assert commands.parse_args(arguments).command == arguments[0]


def test_architecture_names_what_exists():
    folders = "client|sceneprint|lab|viewers|service|worker|migrations|benchmarks|tests|ros2"
    paths = re.findall(rf"`((?:{folders})/[\w/.]*)", (ROOT / "docs/architecture.md").read_text())
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_troubleshooting_quotes_messages_of_the_code():
    """Messages are block quotes, and code with blanks in tables; an ellipsis stands for names."""
    page = (ROOT / "docs/troubleshooting.md").read_text()
    quoted = re.findall(r"^> (.*)$", page, re.MULTILINE)
    rows = "\n".join(re.findall(r"^\|.*", page, re.MULTILINE))
    quoted += re.findall(r"\| `([^`|]* [^`|]*)` (?=\|)", rows)
    assert len(quoted) > 30
    printed = "\n".join(messages_of_the_code())
    unknown = [
        message
        for message in quoted
        if not re.search(".*".join(map(re.escape, re.split(r" *… *", message))), printed)
    ]
    assert unknown == []


def messages_of_the_code():
    """Texts of string literals, a line each; what is put into one at run time is left out."""
    for folder in ("sceneprint", "service", "client/sceneprint_client"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                parts = node.values if isinstance(node, ast.JoinedStr) else [node]
                text = "".join(
                    str(part.value) if isinstance(part, ast.Constant) else " " for part in parts
                )
                yield " ".join(text.split())


@pytest.mark.thorough
def test_documented_commands_and_examples_run(tmp_path):
    """README, Getting started and Library, except for `make`, under which the tests run."""
    serve, *rest = commands_of(STARTED + LIBRARY)
    assert serve == commands_of(README)[1] == ".venv/bin/sceneprint serve"
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    environment = {
        **os.environ, "SCENEPRINT_PORT": str(port), "SCENEPRINT_URL": url,
        "SCENEPRINT_DATA_DIR": str(tmp_path / "data"), "SCENEPRINT_WORKERS": "1",
    }  # fmt: skip
    program = [sys.executable, "-m", "sceneprint"]

    def run(*command, env=None):
        return subprocess.run(
            command, check=True, cwd=tmp_path, text=True, stdout=subprocess.PIPE, env=env
        ).stdout

    service = subprocess.Popen(
        [*program, "serve"], cwd=tmp_path, text=True, stdout=subprocess.PIPE, env=environment
    )
    try:
        assert service.stdout.readline() == f"sceneprint: serving {url}\n"
        commands = [line.split()[1:] for line in rest]
        printed = {words[0]: run(*program, *words, env=environment) for words in commands}
    finally:
        service.terminate()
        out, _ = service.communicate()
    assert (service.returncode, out) == (0, f"sceneprint: dashboard {url}/dashboard\n")
    assert "6 indexed" in printed["upload"]
    assert re.search(r": found [0-9.]+ % \(strong\); ", printed["localize"])
    assert "EDGE_SE3:QUAT" in (tmp_path / "loops.g2o").read_text()
    index = json.loads((tmp_path / "signatures/signatures.json").read_text())
    assert [entry["signed"] for entry in index["frames"]] == [True] * 12
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["counts"]["queries"] == 3
    (client,) = blocks(README, "python")
    library, place = blocks(LIBRARY, "python")
    assert re.match(r"found x=\S+ y=\S+ z=\S+$", run(sys.executable, "-c", client).strip())
    assert len([line for line in library.splitlines() if line]) <= 10
    # the first frame of room 0 is found in other frames of room 0, and in none of room 1
    *lines, located = run(sys.executable, "-c", library + place).splitlines()
    assert re.match(r"\('(found|ambiguous)', '", located)
    accepted = [line.split()[0] for line in lines if line.split()[2] == "accepted"]
    assert accepted
    assert all(name.startswith("room-000/") for name in accepted)


def test_make_has_the_verbs_the_docs_name():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = "".join(page.read_text() for page in PAGES)
    named = set(re.findall(r"(?:`|\n)make ([\w-]+)", pages))
    assert named <= targets
