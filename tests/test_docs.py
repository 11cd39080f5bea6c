"""Tests of the documentation against the code: functions, equations and commands."""

import ast
import inspect
import json
import os
import re
import shlex
import socket
import subprocess
import sys
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

import pytest

from sceneprint.cli import parser
from sceneprint.models import PRESETS, read_model

ROOT = Path(__file__).resolve().parent.parent
PAPER = (ROOT / "docs/paper.md").read_text()
README = (ROOT / "README.md").read_text()
STARTED = (ROOT / "docs/getting_started.md").read_text()
LIBRARY = (ROOT / "docs/library.md").read_text()
ARCHITECTURE = (ROOT / "docs/architecture.md").read_text()
MODEL = (ROOT / "docs/model.md").read_text()
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


def test_there_are_rows():
    assert len(ROWS) >= 14
    assert len(set(ROWS)) == len(ROWS)


@pytest.mark.parametrize(("what", "path", "name"), ROWS)
def test_every_row_names_a_function_that_names_its_source(what, path, name):
    function = function_of(path, name)
    text = (inspect.getdoc(function) or "") + (ROOT / path).read_text().split('"""')[1]
    source = re.match(r"(Eq\. \(\d+)|(Sec\. III(?:-[A-F])?)", what)
    named = source[0] if source[2] else source[1]
    assert named in text or (named == "Sec. III" and "Sec. III" in text)


def test_every_function_named_in_passing_is_where_it_is_said_to_be():
    named = re.findall(r"`(\w+)` in\s+`(sceneprint/[\w/]+\.py)`", PAPER)
    assert named
    for name, path in named:
        assert inspect.getsourcefile(function_of(path, name)) == str(ROOT / path)


def test_every_equation_in_the_code_has_a_row():
    marked = {
        (mark, str(path.relative_to(ROOT)))
        for path in GEOMETRY
        for mark in re.findall(r"# (Eq\. \(\d+\w?\))", path.read_text())
    }
    assert {mark for mark, _ in marked} == {
        "Eq. (1)",
        "Eq. (2a)",
        "Eq. (2b)",
        "Eq. (2c)",
        "Eq. (3)",
    }
    assert marked <= {(what, path) for what, path, _ in ROWS}


def test_every_reading_that_code_cites_is_explained():
    cited = {
        number
        for path in GEOMETRY
        for number in re.findall(r"\bR(\d+)\b(?=[ ,)(-])", path.read_text())
    }
    assert {"1", "2", "7", "11"} <= cited
    explained = set(re.findall(r"^\| R(\d+) \|", PAPER, re.MULTILINE))
    assert cited <= explained


def test_docs_name_the_shipped_models_as_they_are():
    """Ids and figures of docs/model.md are those of the files in the package."""
    for preset in PRESETS:
        model = read_model(preset)
        assert f"`{model.id[:12]}`" in MODEL
        assert f"{model.signature_bytes:,}" in MODEL
        assert model.provenance["own_frames"] == 0
        assert f"{model.provenance['training']['rooms']} rooms" in MODEL
        assert f"{model.provenance['pairs_used']:,} pairs" in MODEL


def test_no_blank_is_left_to_fill_in():
    assert [page.name for page in PAGES if "@@" in page.read_text()] == []


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
            marks = {re.sub(r"[^\w -]", "", one).lower().replace(" ", "-") for one in titles}
            assert heading in marks, target


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@contextmanager
def served(line, folder, environment):
    """The documented service, running."""
    program, *arguments = line.split()
    assert (program, arguments) == (".venv/bin/sceneprint", ["serve"])
    process = subprocess.Popen(
        [sys.executable, "-m", "sceneprint", *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        url = process.stdout.readline().removeprefix("sceneprint: serving ").strip()
        assert url.startswith("http://127.0.0.1:")
        yield
    finally:
        process.terminate()
        out, _ = process.communicate()
        assert (process.returncode, out) == (0, f"sceneprint: dashboard {url}/dashboard\n")


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
    lines = commands_of(STARTED + LIBRARY)
    commands = [line.split()[1:] for line in lines if line.startswith(".venv/bin/sceneprint ")]
    assert len(commands) == len(lines) == 17
    known = parser()
    for command in commands:
        assert known.parse_args(command).command == command[0]


def test_commands_of_sensors_and_of_troubleshooting_are_known():
    pages = [ROOT / "docs/troubleshooting.md", *sorted((ROOT / "docs/sensors").glob("*.md"))]
    known = parser()
    for page in pages:
        text = page.read_text()
        lines = [
            *commands_of(text),
            *re.findall(r"`(sceneprint (?!bag)[^`]+)`", text.replace("\n", " ")),
        ]
        own = [shlex.split(line, comments=True)[1:] for line in lines if line[:11] == "sceneprint "]
        assert own, page
        for arguments in own:
            assert known.parse_args(arguments).command == arguments[0]


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
                    str(one.value) if isinstance(one, ast.Constant) else " " for one in parts
                )
                yield " ".join(text.split())


@pytest.mark.thorough
def test_documented_commands_and_examples_run(tmp_path):
    """README, Getting started and Library, but for `make`, which the tests themselves run under."""
    serve, *rest = commands_of(STARTED + LIBRARY)
    assert serve == commands_of(README)[1]
    assert len(rest) == 16
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "SCENEPRINT_PORT": str(port),
        "SCENEPRINT_URL": f"http://127.0.0.1:{port}",
        "SCENEPRINT_DATA_DIR": str(tmp_path / "data"),
        "SCENEPRINT_WORKERS": "1",
    }
    printed = {}
    with served(serve, tmp_path, environment):
        for line in rest:
            program, *arguments = line.split()
            assert program == ".venv/bin/sceneprint"
            done = subprocess.run(
                [sys.executable, "-m", "sceneprint", *arguments],
                cwd=tmp_path,
                env=environment,
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            printed[arguments[0]] = done.stdout
    assert "6 indexed" in printed["upload"]
    assert "found" in printed["query"]
    assert re.search(r": found [0-9.]+ % \(strong\); ", printed["localize"])
    assert "EDGE_SE3:QUAT" in (tmp_path / "loops.g2o").read_text()
    assert "room-000/seq-01" in printed["sessions"]
    assert "building" in printed["maps"]
    assert (tmp_path / "restored/sceneprint.db").stat().st_size > 3_000_000  # the model is in it
    assert "building" in printed["reencode"]
    index = json.loads((tmp_path / "signatures/signatures.json").read_text())
    assert [entry["signed"] for entry in index["frames"]] == [True] * 12
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["counts"]["queries"] == 3
    pairs = json.loads((tmp_path / "pairs.json").read_text())
    assert set(pairs["validation"]) >= {"precision", "recall", "accepted"}
    (client,) = blocks(README, "python")
    library, place = blocks(LIBRARY, "python")
    assert re.match(r"found x=\S+ y=\S+ z=\S+$", run_example(client, tmp_path).strip())
    assert len([line for line in library.splitlines() if line]) <= 10
    # the first frame of room 0 is found in other frames of room 0, and in none of room 1
    *lines, located = run_example(library + place, tmp_path).splitlines()
    assert re.match(r"\('(found|ambiguous)', '", located)
    accepted = [line.split()[0] for line in lines if line.split()[2] == "accepted"]
    assert accepted
    assert all(name.startswith("room-000/") for name in accepted)


def run_example(code, folder):
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, check=True, stdout=subprocess.PIPE, text=True
    )
    return done.stdout


PLACES = re.findall(
    r"`((?:client|sceneprint|lab|viewers|service|worker|migrations|benchmarks|tests|ros2)/[\w/.]*)(?::([\w.]+))?`",
    ARCHITECTURE,
)


@pytest.mark.parametrize(("path", "name"), sorted(set(PLACES)))
def test_architecture_names_what_exists(path, name):
    assert (ROOT / path).exists()
    if name:
        assert name in definitions(ROOT / path)


def definitions(path):
    """Functions and classes of a module, and methods as `Class.method`."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            inner = [
                one for one in node.body if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
            ]
            found |= {f"{node.name}.{one.name}" for one in inner}
    return found


def test_documented_camera_is_valid_json():
    from sceneprint.formats.dataset import Camera
    from sceneprint.types import Intrinsics

    (example,) = blocks(STARTED, "json")
    fields = json.loads(example)
    scale = fields.pop("depth_scale")
    assert Camera(Intrinsics(**fields), scale).depth_scale == 1000


def test_make_has_the_verbs_the_docs_name():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    pages = "".join(page.read_text() for page in PAGES)
    named = set(re.findall(r"(?:`|\n)make ([\w-]+)", pages))
    assert {"demo", "test", "bench", "soak", "siege", "models"} <= named
    assert named <= targets
    assert "make test" in (ROOT / ".ci/run").read_text()
