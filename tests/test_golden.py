"""Tests against recorded behaviour in tests/golden: API, command help, signatures and an answer.

Moving or renaming code must not change it. After an intended change, update the files with `make
goldens`, read their diff, and describe the change in CHANGELOG.md.
"""

import argparse
import json
import os
from collections import Counter
from copy import deepcopy
from difflib import unified_diff
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from sceneprint import pipeline
from sceneprint.cli import all_commands, parser
from sceneprint.formats.dataset import make_frame
from sceneprint.settings import Settings
from sceneprint.types import Intrinsics
from service.app import create_app
from tools.site.format_pages import formats_module, formats_page

GOLDEN = Path(__file__).parent / "golden"
UPDATE = os.environ.get("SCENEPRINT_UPDATE_GOLDEN") == "1"

#: Parts of an OpenAPI document of which each member has a line of its own.
LISTED = {"shared", "paths", "parameters", "responses", "schemas", "properties"}
#: Characters up to which a part stays on one line.
LINE = 400

#: Lower and upper corners of boxes in a room of 6 x 5 x 2.7 m, metres; z is up.
BOXES = (
    ((0.0, 1.0, 0.0), (0.6, 2.6, 0.75)),
    ((0.0, 3.2, 0.0), (0.5, 4.2, 2.0)),
    ((2.0, 4.4, 0.0), (3.8, 5.0, 0.9)),
    ((4.9, 0.8, 0.0), (6.0, 2.4, 0.45)),
    ((2.4, 2.0, 0.0), (3.3, 2.9, 0.7)),
    ((5.6, 3.4, 0.0), (6.0, 4.4, 1.4)),
)
ROOM = ((0.0, 0.0, 0.0), (6.0, 5.0, 2.7))
#: Position and yaw: two that see one place, and one of the opposite corner.
VIEWS = {
    "window": (3.4, 1.2, 1.5, 2.2),
    "window again": (3.7, 1.4, 1.45, 2.35),
    "door": (1.2, 3.9, 1.5, -0.7),
}
PRESETS = ("depth", "lidar", "paper")
#: Bytes of a signature that are frozen: all of `depth` and `lidar`, the first of `paper`.
FROZEN = 2048
#: Bytes of a signature on one line.
ROW = 64


def golden(name, lines):
    """Return the lines of a file of tests/golden, after writing them if an update is wanted."""
    path = GOLDEN / name
    if UPDATE:
        path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return path.read_text(encoding="utf-8").splitlines()


def assert_golden(name, lines):
    """Assert that a file of tests/golden has exactly these lines."""
    kept = golden(name, lines)
    assert kept == lines, "\n".join(unified_diff(kept, lines, name, "now", n=0, lineterm=""))


def test_formats_of_docs_and_dashboard():
    assert_golden("../../docs/formats.md", formats_page().splitlines())
    module = "../../service/dashboard/pages/frames/formats.js"
    assert_golden(module, formats_module().splitlines())


def shortened(document):
    """Return a document in which parameters and responses that operations share stand once.

    An operation names a shared parameter in place of describing it, and lists the statuses of its
    shared responses under `shared`.
    """
    document = deepcopy(document)
    operations = [method for methods in document["paths"].values() for method in methods.values()]
    shared = {"parameters": {}, "responses": {}}
    parameters = Counter(
        (parameter["name"], json.dumps(parameter, sort_keys=True))
        for operation in operations
        for parameter in operation.get("parameters", ())
    )
    responses = Counter(
        (status, json.dumps(response, sort_keys=True))
        for operation in operations
        for status, response in operation["responses"].items()
        if status[0] != "2"  # what an operation is for is read with it
    )
    for part, result in (("parameters", parameters), ("responses", responses)):
        for (name, text), count in sorted(result.items(), key=lambda item: (-item[1], item[0])):
            if count > 1:
                shared[part].setdefault(name, json.loads(text))
    for operation in operations:
        if "parameters" in operation:
            operation["parameters"] = [
                p["name"] if shared["parameters"].get(p["name"]) == p else p
                for p in operation["parameters"]
            ]
        answers = operation["responses"]
        same = [status for status in answers if shared["responses"].get(status) == answers[status]]
        operation["responses"] = {
            **{status: answer for status, answer in answers.items() if status not in same},
            "shared": sorted(same),
        }
    return {"shared": shared, **document}


def json_text(value, key="", depth=0):
    """Return a JSON value as lines that can be read and compared.

    A value has one line if that is short, or if nothing within it is listed (`LISTED`). Any other
    has one for all its short members, and one or more for each of the rest.
    """
    start = " " * depth + (f"{json.dumps(key)}: " if key else "")
    flat = start + json.dumps(value, sort_keys=True, ensure_ascii=False)
    if depth and (len(flat) <= LINE or not (key in LISTED or holds_list(value))):
        return flat
    if isinstance(value, list):
        opening, closing = "[]"
        members = [json_text(member, "", depth + 1) for member in value]
        short = [isinstance(member, str) for member in value]
    else:
        opening, closing = "{}"
        members = [json_text(value[name], name, depth + 1) for name in sorted(value)]
        if depth and key not in LISTED:
            members.sort(key=lambda text: "\n" in text)
        short = [depth > 0 and key not in LISTED and "\n" not in text for text in members]
    parts = []
    for together, group in groupby(zip(short, members, strict=True), key=lambda pair: pair[0]):
        texts = [text for _, text in group]
        first = " " * (depth + 1) + ", ".join(text.strip() for text in texts)
        parts += [first] if together else texts
    return start + opening + ",\n".join(parts).lstrip() + closing


def holds_list(value):
    """Return whether something within a JSON value is listed."""
    if isinstance(value, dict):
        return any(key in LISTED or holds_list(member) for key, member in value.items())
    return isinstance(value, list) and any(holds_list(member) for member in value)


def test_the_document_of_the_api(tmp_path):
    document = create_app(Settings(data_dir=tmp_path)).openapi()
    document["info"].pop("version")
    assert_golden("openapi.json", json_text(shortened(document)).splitlines())


def help_lines(command):
    """Yield the help of a command and its subcommands.

    Not as argparse writes it, which differs between versions of Python.
    """
    yield f"{command.prog}: {' '.join((command.description or '').split())}".rstrip(": ")
    for exclusive in command._mutually_exclusive_groups:
        names = " | ".join(option_name(action) for action in exclusive._group_actions)
        yield f"  {'exactly' if exclusive.required else 'at most'} one of {names}"
    for section in command._action_groups:
        if section.description:
            yield f"  {section.title}: {section.description}"
        yield from (f"  {option_line(action)}" for action in section._group_actions)
    yield from (f"  | {line}" for line in (command.epilog or "").splitlines())
    subcommands = [a for a in command._actions if isinstance(a, argparse._SubParsersAction)]
    for one in subcommands:
        yield from (f"    {option_line(choice)}" for choice in one._choices_actions)
        for subcommand in one.choices.values():
            yield ""
            yield from help_lines(subcommand)


def option_name(action):
    return ", ".join(action.option_strings) or str(action.metavar or action.dest)


def option_line(action):
    """Return an option with its value, how often it may be there, its default and its help."""
    words = [option_name(action)]
    if action.option_strings and isinstance(action.metavar, str):
        words.append(action.metavar)
    if action.choices is not None and not isinstance(action, argparse._SubParsersAction):
        words.append("{" + ",".join(str(choice) for choice in action.choices) + "}")
    if action.nargs not in (0, None, argparse.PARSER):
        words.append(f"[nargs {action.nargs}]")
    if action.required and action.option_strings:
        words.append("[required]")
    if isinstance(action, argparse._AppendAction):
        words.append("[repeatable]")
    if action.default not in (None, False, [], argparse.SUPPRESS):
        words.append(f"[default {action.default}]")
    help_text = "[hidden]" if action.help == argparse.SUPPRESS else action.help or ""
    return f"{' '.join(words)}: {help_text}".rstrip(": ")


def test_the_help_of_every_command(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: None)  # some defaults depend on this machine
    for variable in ("SCENEPRINT_URL", "SCENEPRINT_KEY"):
        monkeypatch.delenv(variable, raising=False)
    top = parser()
    (commands,) = (a for a in top._actions if isinstance(a, argparse._SubParsersAction))
    assert list(commands.choices) == list(all_commands())
    assert_golden("commands.txt", [*help_lines(top)])


def pose_of(x, y, z, yaw):
    """T_room_camera (4, 4) of a level camera; its axes are x right, y down, z forward."""
    T = np.eye(4)
    T[:3, 0] = np.sin(yaw), -np.cos(yaw), 0
    T[:3, 1] = 0, 0, -1
    T[:3, 2] = np.cos(yaw), np.sin(yaw), 0
    T[:3, 3] = x, y, z
    return T


def view(name):
    """The room in whole millimetres, which no processor rounds otherwise."""
    k = Intrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
    T = pose_of(*VIEWS[name])
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], -1) @ T[:3, :3].T
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    origin = T[:3, 3]
    far = np.maximum((ROOM[0] - origin) / rays, (ROOM[1] - origin) / rays).min(-1)
    for low, high in BOXES:
        a, b = (low - origin) / rays, (high - origin) / rays
        near, beyond = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        far = np.where((near > 0) & (near < beyond), np.minimum(far, near), far)
    samples = np.rint(far * 1000).astype(np.uint16)
    return make_frame(samples, k, name=name, pose=T)


@pytest.mark.parametrize("preset", PRESETS)
def test_signatures(preset):
    signer = pipeline.open_signer(preset)
    for name in VIEWS:
        signature = pipeline.sign(view(name), signer).vector[:FROZEN]
        rows = [signature[i : i + ROW].tobytes().hex() for i in range(0, len(signature), ROW)]
        kept = golden(f"signatures/{preset}-{name.replace(' ', '-')}.hex", rows)
        off = np.abs(signature.astype(int) - np.frombuffer(bytes.fromhex("".join(kept)), np.uint8))
        # floating sums differ between processors: a component in a hundred may round otherwise
        assert off.max() <= 1, name
        assert (off == 0).mean() >= 0.99, name


def test_an_answer():
    """A found place, and one that is another corner of the room."""
    signer = pipeline.open_signer("depth")
    query, *database = (pipeline.prepare(view(name), signer)[1] for name in VIEWS)
    results = {}
    for name, match in zip(list(VIEWS)[1:], database, strict=True):
        one = pipeline.validate(query, match, seed=7)
        results[name] = {
            "status": one.status, "strength": one.strength, "reason": one.reason,
            "overlap": round(one.overlap, 6), "plane_overlap": round(one.plane_overlap, 6),
            "T": None if one.T_match_query is None else one.T_match_query.round(6).tolist(),
        }  # fmt: skip
    kept = json.loads("\n".join(golden("answer.json", json_text(results).splitlines())))
    for name, now in results.items():
        assert (now["status"], now["strength"]) == (kept[name]["status"], kept[name]["strength"])
    again, was = results["window again"], kept["window again"]
    assert (again["status"], results["door"]["status"]) == ("accepted", "rejected")
    np.testing.assert_allclose(again["T"], was["T"], atol=2e-4)
    assert again["overlap"] == pytest.approx(was["overlap"], abs=2e-3)
    assert again["plane_overlap"] == pytest.approx(was["plane_overlap"], abs=2e-3)
