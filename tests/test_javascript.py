"""Tests of the check of the dashboard's JavaScript, which is skipped without Node."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "tools/javascript"


def check(folder, path):
    return subprocess.run(
        ["/bin/sh", str(folder / "check")],
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def test_its_tools_are_pinned_and_locked():
    wanted = json.loads((FOLDER / "package.json").read_text())["devDependencies"]
    locked = json.loads((FOLDER / "package-lock.json").read_text())["packages"]
    assert {name: locked[f"node_modules/{name}"]["version"] for name in wanted} == wanted
    packages = [one for path, one in locked.items() if path]
    assert all(one["resolved"].startswith("https://registry.npmjs.org/") for one in packages)
    assert all(one["integrity"].startswith("sha512-") for one in packages)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("export const n = Math.flor(1.5);", "error TS2551: Property 'flor' does not exist"),
        ("export const n = count(1);", "error TS2304: Cannot find name 'count'"),
        ("/** @param {number} n */ export const f = (n) => n;\nf('1');", "error TS2345"),
    ],
)
def test_a_mistake_is_found(tmp_path, line, found):
    # looked at now, and not when tests are collected: make test lints beside them
    if not (FOLDER / "node_modules/.installed").exists() or shutil.which("node") is None:
        pytest.skip("the tools are installed by make lint, where there is Node")
    options = json.loads((FOLDER / "tsconfig.json").read_text())
    (tmp_path / "page.js").write_text(f"{line}\n")
    (tmp_path / "tsconfig.json").write_text(json.dumps({**options, "include": ["page.js"]}))
    done = subprocess.run(
        [FOLDER / "node_modules/.bin/tsc", "-p", tmp_path, "--pretty", "false"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert found in done.stdout
