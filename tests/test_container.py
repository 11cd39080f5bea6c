"""Tests of the image and of Compose, without a container engine.

hadolint and the Compose schema check the files, our own rules check further properties, and the
steps of the image are run in a folder that represents its file system.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any, cast

import httpx
import numpy as np
import pytest
from ruamel.yaml import YAML

from benchmarks.waiting import PATIENCE_S
from sceneprint.models import PRESETS
from sceneprint.process import SECRETS
from sceneprint.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPOSE = (ROOT / "docker-compose.yml").read_text()
IGNORE = (ROOT / ".dockerignore").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
KNOWN_SETTINGS = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields}


# Reading a Dockerfile


@dataclass(frozen=True)
class Step:
    """One instruction: which stage it is in (from 0), its name, flags, and the rest of it."""

    stage: int
    name: str
    flags: tuple[str, ...]
    rest: str

    def words(self):
        """The rest as the exec form has it; a ValueError where it is in shell form."""
        try:
            found = json.loads(self.rest)
        except json.JSONDecodeError as error:
            raise ValueError(f"{self.name} is not in exec form: {self.rest}") from error
        return cast(list[str], found)


def steps_of(text):
    """Instructions in their order, continued lines joined and comments left out."""
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    steps, stage = [], -1
    for line in filter(str.strip, joined.splitlines()):
        name, _, rest = line.strip().partition(" ")
        stage += name.upper() == "FROM"
        flags = re.match(r"(?:--\S+\s+)*", rest.lstrip())
        rest = rest.lstrip()[flags.end() :]
        steps.append(Step(stage, name.upper(), tuple(flags[0].split()), rest))
    return steps


def final(steps):
    """Steps of the stage that becomes the image."""
    return [step for step in steps if step.stage == steps[-1].stage]


def only(steps, name):
    """The one step of that name in the image's stage."""
    found = [step for step in final(steps) if step.name == name]
    if len(found) != 1:
        raise ValueError(f"{len(found)} {name} in the last stage")
    return found[0]


def health_check(steps):
    """Command of the image's health check."""
    step = only(steps, "HEALTHCHECK")
    return Step(step.stage, "HEALTHCHECK", (), step.rest.removeprefix("CMD ")).words()


def environment(steps):
    """What ENV sets in the image's stage."""
    pairs = [shlex.split(step.rest) for step in final(steps) if step.name == "ENV"]
    return dict(pair.split("=", 1) for words in pairs for pair in words)


def image_problems(text):
    """What our rules have against a Dockerfile that hadolint knows nothing about."""
    steps, found = steps_of(text), []
    for read in (
        lambda: only(steps, "ENTRYPOINT").words(),
        lambda: only(steps, "CMD").words(),
        lambda: health_check(steps),
        lambda: only(steps, "STOPSIGNAL"),
    ):
        try:
            read()
        except ValueError as error:
            found.append(str(error))
    users = [step.rest for step in final(steps) if step.name == "USER"]
    if not users or not all(re.fullmatch(r"[1-9]\d*:[1-9]\d*", user) for user in users):
        found.append("the image does not run as a fixed number other than root's")
    names = [step.name for step in final(steps)]
    if "USER" in names and not names.index("USER") < len(names) - 1 - names[::-1].index("RUN"):
        found.append("what the last RUN makes is not the user's")
    if re.search(
        r"\b(apt-get|pip|gcc|make)\b", " ".join(s.rest for s in final(steps) if s.name == "RUN")
    ):
        found.append("the last stage installs or builds")
    slim = r"\S+:\d+\.\d+\S*-slim\S*( AS \w+)?"
    bases = [step.rest for step in steps if step.name == "FROM"]
    found += [f"no slim base with its version: {x}" for x in bases if not re.fullmatch(slim, x)]
    uncached = {s.stage for s in steps if s.name == "ENV" and "PIP_NO_CACHE_DIR=1" in s.rest}
    if not {s.stage for s in steps if s.name == "RUN" and "pip" in s.rest} <= uncached:
        found.append("pip keeps its cache in a layer")
    if set(environment(steps)) - KNOWN_SETTINGS - {
        "PATH", "PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE",
        "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_CACHE_DIR",
    }:  # fmt: skip
        found.append("ENV sets what nothing reads")
    return found


def changed(text, old, new):
    """The text with one part replaced, which must be there once: else nothing would be tried."""
    assert text.count(old) == 1, f"{text.count(old)} of {old!r}"
    return text.replace(old, new)


def changed_all(text, old, new):
    """The text with a part replaced wherever it is: parts of a composition have much in common."""
    assert old in text, old
    return text.replace(old, new)


# Lint


def tool(name):
    """A tool beside this Python; it comes with the dev extra."""
    path = shutil.which(name, path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if path is None:
        pytest.fail(f"{name} is not installed: it belongs to the dev extra, run `make test`")
    return path


def hadolint(text):
    """Codes of what hadolint finds."""
    done = subprocess.run(
        [tool("hadolint"), "--no-color", "--format", "json", "-"],
        input=text, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.stderr == ""
    return sorted({str(found["code"]) for found in json.loads(done.stdout)})


def test_hadolint_has_nothing_against_the_dockerfile():
    assert hadolint(DOCKERFILE) == []


def test_our_rules_have_nothing_against_the_dockerfile():
    assert image_problems(DOCKERFILE) == []


def test_the_image_says_what_it_is():
    steps = steps_of(DOCKERFILE)
    labels = dict(pair.split("=", 1) for pair in shlex.split(only(steps, "LABEL").rest))
    told = {name.rpartition(".")[2]: value for name, value in labels.items()}
    assert told["version"] == PROJECT["version"]
    assert told["licenses"] == PROJECT["license"]
    assert told["title"] == PROJECT["name"]
    assert only(steps, "EXPOSE").rest == environment(steps)["SCENEPRINT_PORT"]
    assert json.loads(only(steps, "VOLUME").rest) == [environment(steps)["SCENEPRINT_DATA_DIR"]]


# What is sent to the builder


def is_ignored(path, patterns=IGNORE):
    """Whether .dockerignore keeps a file from the builder; the last pattern that fits decides."""
    ignored = False
    parts = path.split("/")
    for line in patterns.splitlines():
        if line.strip() and not line.startswith("#"):
            pattern = line.removeprefix("!").removeprefix("**/")
            at_any_depth = line.startswith("**/")
            heads = parts if at_any_depth else parts[:1]
            if any(fnmatch(head, pattern) for head in heads):
                ignored = not line.startswith("!")
    return ignored


def test_the_builder_gets_the_code_and_nothing_else():
    for kept in ("sceneprint/presets/paper.safetensors", "migrations/script.py.mako", "LICENSE"):
        assert not is_ignored(kept), kept
    secret, compiled = (".env", "key.pem", ".git/config"), "sceneprint/__pycache__/types.pyc"
    for left in (*secret, compiled, ".venv/bin/python", "tests/conftest.py", "out/figures.json"):
        assert is_ignored(left), left


def context_files():
    """What the builder is sent of a fresh checkout: no file that git does not know or would add."""
    paths = sorted(path for path in tracked_files() if path and (ROOT / path).is_file())
    return [path for path in paths if not is_ignored(path)]


# docker-compose.yml


def composed(text=COMPOSE):
    """The composition, with its merge keys and anchors followed."""
    return cast(dict[str, Any], YAML(typ="safe", pure=True).load(text))


def defaults(value):
    """What Compose makes of ${NAME:-default} where NAME is not set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", value)


def mount_problem(mount, volumes):
    """What is wrong with a mount: a volume that is not declared, or a file that is not in git."""
    source, _, rest = mount.partition(":")
    if not source.startswith("./"):
        return None if source in volumes else f"volume {source} is not declared"
    is_ours = source.removeprefix("./") in tracked_files()
    return None if is_ours and rest.endswith(":ro") else f"{mount} is no file of ours to be read"


@cache
def tracked_files():
    """Files that git knows or would add."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return frozenset(listed.stdout.split("\0"))


def waits_rightly(part, other, condition, parts):
    """Whether a part waits until what it needs is of use; that there are workers no proxy needs."""
    if other not in parts:
        return False
    if parts[other].get("restart") == "no":
        return condition == "service_completed_successfully"
    return condition == "service_healthy" or (part, other) == ("proxy", "signer")


#: Of libraries that ours are built on: who they are to PostgreSQL and to the object store.
OF_LIBRARIES = re.compile(r"PGPASSWORD|AWS_[A-Z_]+(?<!_FILE)")


def environment_problems(name, part):
    """What is wrong with what a part is told."""
    given, found = part.get("environment", {}), []
    for key, value in given.items():
        if key.endswith("_FILE"):
            if value not in [f"/run/secrets/{one}" for one in part.get("secrets") or ()]:
                found.append(f"{name}: {key} names no secret that it has")
        elif re.search("PASSWORD|SECRET", key) and not re.fullmatch(
            r"\$\{SCENEPRINT_\w+:-\}", value
        ):
            found.append(f"{name}: {key} has a default")
    if not part["image"].startswith("sceneprint:"):
        return found
    ours = {one for one in given if one.removesuffix("_FILE") in SECRETS}
    unknown = {one for one in set(given) - KNOWN_SETTINGS - ours if not OF_LIBRARIES.fullmatch(one)}
    if unknown:
        found.append(f"{name}: nothing reads {', '.join(sorted(unknown))}")
    try:
        own = {k: v for k, v in given.items() if k in KNOWN_SETTINGS}
        Settings(**{k.removeprefix("SCENEPRINT_").lower(): v for k, v in own.items()})
    except ValueError as error:
        found.append(f"{name}: {error}")
    return found


def health_problem(part):
    """What is wrong with how a part is asked whether it is well."""
    if part["restart"] == "no":
        return None if "healthcheck" not in part else "is over before anybody asks"
    if part["image"].startswith("sceneprint:") and "healthcheck" not in part:
        return None  # that of the image
    command = part.get("healthcheck", {}).get("test", [])
    return None if command[:1] == ["CMD"] and len(command) > 1 else "no health check in exec form"


def compose_problems(text):
    """What our rules have against a composition."""
    document, found = composed(text), []
    parts, volumes = document["services"], set(document.get("volumes", {}))
    for name, part in parts.items():
        if not re.fullmatch(r"\S+:v?\d+\.\d+\S*", part["image"]):
            found.append(f"{name}: {part['image']} has no version")
        if name not in ("service", "worker") and part.get("profiles") != ["fleet"]:
            found.append(f"{name}: is of no profile")
        wrong = [mount_problem(mount, volumes) for mount in part.get("volumes", [])]
        found += [f"{name}: {one}" for one in (*wrong, health_problem(part)) if one is not None]
        found += environment_problems(name, part)
        found += [
            f"{name}: {port} is not published to this machine alone"
            for port in part.get("ports", [])
            if not re.fullmatch(r"127\.0\.0\.1:\d+:\d+", defaults(port))
        ]
        for other, wish in part.get("depends_on", {}).items():
            if not waits_rightly(name, other, wish["condition"], parts):
                found.append(f"{name}: does not wait until {other} is healthy")
        for key, want in (
            ("read_only", True), ("init", True), ("cap_drop", ["ALL"]),
            ("security_opt", ["no-new-privileges:true"]),
            ("restart", "no" if name == "bucket" else "unless-stopped"),
        ):  # fmt: skip
            if part.get(key) != want:
                found.append(f"{name}: {key} is {part.get(key)!r}")
        limits = part.get("deploy", {}).get("resources", {}).get("limits", {})
        if set(limits) != {"cpus", "memory", "pids"}:
            found.append(f"{name}: limits only {sorted(limits)}")
    return found


def test_our_rules_have_nothing_against_the_composition():
    assert compose_problems(COMPOSE) == []
    fleet = {"database", "objects", "bucket", "api", "signer", "proxy"}
    assert set(composed()["services"]) == {"service", "worker", *fleet}


def by_schema(path):
    """What the schema of the Compose specification says; check-jsonschema brings a copy."""
    command = [tool("check-jsonschema"), "--builtin-schema", "vendor.compose-spec", str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)


def test_the_composition_is_as_the_specification_has_it(tmp_path):
    done = by_schema(ROOT / "docker-compose.yml")
    assert (done.returncode, done.stderr) == (0, "")
    broken = tmp_path / "docker-compose.yml"
    broken.write_text(changed_all(COMPOSE, "  init: true\n", "  initt: true\n"))
    done = by_schema(broken)
    assert done.returncode == 1
    assert "'initt'" in done.stdout


def test_the_two_parts_have_room_for_what_they_run():
    steps = steps_of(DOCKERFILE)
    service, worker = (composed()["services"][name] for name in ("service", "worker"))
    assert service["image"] == worker["image"] == f"sceneprint:{PROJECT['version']}"
    assert defaults(service["ports"][0]).endswith(f":{environment(steps)['SCENEPRINT_PORT']}")
    assert service["environment"]["SCENEPRINT_WORKERS"] == "0"  # no worker is counted twice
    assert "SCENEPRINT_WORKER_CONTAINERS" in worker["deploy"]["replicas"]
    assert defaults(worker["deploy"]["replicas"]) == "1"
    mounted = {mount.partition(":")[2] for mount in service["volumes"]}
    env = environment(steps)
    assert mounted == {env["SCENEPRINT_DATA_DIR"], env["SCENEPRINT_CACHE_DIR"]}
    # a read-only root, and a cache folder that numba may write to: else it would not use it
    assert Path(env["NUMBA_CACHE_DIR"]).is_relative_to(env["SCENEPRINT_CACHE_DIR"])


def test_the_workers_health_check_tells_a_worker_from_itself(tmp_path):
    *shell, code = composed()["services"]["worker"]["healthcheck"]["test"][1:]
    there = changed(code, "/proc", str(tmp_path))

    def checked(*processes):
        for number, words in enumerate(processes):
            (tmp_path / f"{number + 1}").mkdir(exist_ok=True)
            (tmp_path / f"{number + 1}/cmdline").write_text("\0".join([*words, ""]))
        return subprocess.run([*shell, there], timeout=PATIENCE_S).returncode

    own = ["grep", *shlex.split(code)[1:-1], "/proc/1/cmdline"]
    watching = ["python", "/opt/sceneprint/bin/sceneprint", "work"]
    spawned = ["python", "-c", "from multiprocessing.spawn import ...", "--multiprocessing-fork"]
    assert checked([*shell, code], own, watching) == 1
    assert checked([*shell, code], own, watching, spawned) == 0


# The steps of the image, run


#: Folders of the image that stand under a folder of the test instead.
FOLDERS = ("/opt/sceneprint", "/var/cache/sceneprint", "/data", "/src")
#: What only a container's root can do, and what it is done for is left out with it: the user.
OF_ROOT = ("apt-get", "groupadd", "useradd", "chown")


@dataclass
class Image:
    """What the steps of a Dockerfile have made, under a folder."""

    root: Path
    env: dict[str, str]
    skipped: list[str] = field(default_factory=list)
    ran: list[str] = field(default_factory=list)

    def here(self, text):
        """The text with the image's folders where they are now."""
        return re.sub(rf"(?<![\w.])({'|'.join(FOLDERS)})(?![\w-])", rf"{self.root}\1", text)

    def command(self, words):
        """Words with their program found as the image would find it."""
        program = shutil.which(words[0], path=self.env["PATH"])
        assert program is not None, f"{words[0]} is not in the image"
        return [program, *words[1:]]


def parts_of(shell):
    """Commands of a line joined by &&, each as it is written."""
    words = shlex.shlex(shell, posix=False, punctuation_chars="&")
    words.whitespace_split, words.commenters = True, ""
    parts = [[]]
    for word in words:
        parts.append([]) if word == "&&" else parts[-1].append(word)
    return [" ".join(part) for part in parts]


def base_environment(folder):
    """A fresh Python, as the base image has one; and how pip finds its index on this machine."""
    done = subprocess.run([sys.executable, "-m", "venv", folder], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    kept = re.compile(r"HOME|LANG|TMPDIR|PIP_\w+|SSL_\w+|REQUESTS_\w+|\w+_proxy", re.IGNORECASE)
    env = {name: value for name, value in os.environ.items() if kept.fullmatch(name)}
    return {**env, "PATH": f"{folder}/bin:/usr/local/bin:/usr/bin:/bin"}


def run_step(image, shell, cwd):
    """Run what a RUN says, without what is root's."""
    mine = [part for part in parts_of(shell) if part.split()[0] not in OF_ROOT]
    image.skipped += [p.split()[0] for p in parts_of(shell) if p.split()[0] in OF_ROOT]
    if mine:
        image.ran.append(" && ".join(mine))
        done = subprocess.run(
            ["/bin/sh", "-c", image.here(image.ran[-1])],
            cwd=cwd, env=image.env, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert done.returncode == 0, (
            f"a step of the Dockerfile fails. Where pip found nothing to install, this test needs "
            f"a package index (PIP_INDEX_URL, or a pip.conf).\n{image.ran[-1]}\n{done.stdout}"
            f"{done.stderr}"
        )


def copy_step(image, step, files, cwd):
    """COPY from the checkout; from another stage it is there already, and must be."""
    *sources, target = step.rest.split()
    if step.flags:
        assert sources == [target], "a stage's files lie where they were"
        assert Path(image.here(target)).exists()
        return
    for source in sources:
        chosen = [f for f in files if f == source or f.startswith(f"{source}/")]
        assert chosen, f"COPY {source}: nothing of that name is sent to the builder"
        for name in chosen:
            to = cwd / target / (name.removeprefix(f"{source}/") if target.endswith("/") and
                                 name != source else name)  # fmt: skip
            to.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to)


def built(folder):
    """Run every step of the Dockerfile, in their order."""
    steps, files = steps_of(DOCKERFILE), context_files()
    image = Image(folder / "root", {})
    image.root.mkdir()
    cwd = image.root
    for step in steps:
        if step.name == "FROM":
            image.env, cwd = base_environment(folder / f"base{step.stage}"), image.root
            if step.stage:  # what the stage before has not handed on is gone
                handed = [s.rest.split()[0] for s in steps if s.stage == step.stage and s.flags
                          and s.name == "COPY"]  # fmt: skip
                for gone in set(FOLDERS) - set(handed):
                    shutil.rmtree(image.here(gone), ignore_errors=True)
        elif step.name == "ENV":
            for pair in shlex.split(image.here(step.rest)):
                name, _, value = pair.partition("=")
                if name != "PIP_NO_CACHE_DIR":  # a download less; the rules above see to it
                    image.env[name] = value.replace("$PATH", image.env["PATH"])
        elif step.name == "WORKDIR":
            cwd = Path(image.here(step.rest))
            cwd.mkdir(parents=True)
        elif step.name == "COPY":
            copy_step(image, step, files, cwd)
        elif step.name == "RUN":
            run_step(image, step.rest, cwd)
    return image


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Made once for this file, in minutes; `--dist loadfile` keeps a file in one process."""
    made = built(tmp_path_factory.mktemp("image"))
    made.env["HOME"] = "/nonexistent"  # the user has none
    return made


@pytest.mark.thorough
def test_every_step_runs_but_what_is_roots(image):
    assert image.skipped == ["groupadd", "useradd", "chown"]
    assert len(image.ran) == sum(step.name == "RUN" for step in steps_of(DOCKERFILE))


@pytest.mark.thorough
def test_what_is_installed_is_the_lock_and_no_more(image):
    code = (
        "import json; from importlib.metadata import distributions as d;"
        "print(json.dumps({x.name.lower().replace('_', '-'): x.version for x in d()}))"
    )
    told = subprocess.run(
        image.command(["python", "-c", code]), env=image.env, capture_output=True, text=True,
        check=True, cwd=image.root,
    )  # fmt: skip
    there = json.loads(told.stdout)
    assert there.pop("sceneprint") == there.pop("sceneprint-client") == PROJECT["version"]
    lock = set(re.findall(r"^([\w.-]+)==([\w.]+)", (ROOT / "requirements.lock").read_text(), re.M))
    assert set(there.items()) <= {(name.lower(), version) for name, version in lock}
    wanted = {re.split(r"[<>=;\[ ]", line)[0] for line in PROJECT["dependencies"]}
    assert wanted - set(there) == {"open3d", "sceneprint-client"}
    assert {"pip", "setuptools", "pytest", "mypy", "ruff", "dash"} & set(there) == set()


@pytest.mark.thorough
def test_kernels_are_compiled_and_tables_built(image):
    cache = Path(image.env["SCENEPRINT_CACHE_DIR"])
    assert len(list(cache.glob("table-*.bin"))) == len(PRESETS)
    assert len(machine_code(image)) > 20


def machine_code(image):
    """Files of compiled kernels."""
    return {path.name for path in Path(image.env["NUMBA_CACHE_DIR"]).rglob("*.nbc")}


@dataclass
class Running:
    """A process as a container would run it."""

    process: subprocess.Popen[bytes]
    log: Path

    def stop(self, number, within_s):
        """Its exit code once told to stop."""
        self.process.send_signal(number)
        return self.process.wait(within_s)


@pytest.fixture
def start(image, tmp_path):
    """Starts a part of the composition; whatever still runs at the end is killed."""
    started = []
    steps = steps_of(DOCKERFILE)

    def begin(name, env):
        part = composed()["services"][name]
        words = only(steps, "ENTRYPOINT").words() + part.get("command", only(steps, "CMD").words())
        log = tmp_path / f"{name}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                image.command(words), env={**image.env, **part["environment"], **env},
                cwd=image.root, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
        started.append(Running(process, log))
        return started[-1]

    yield begin
    for running in started:
        if running.process.poll() is None:
            os.killpg(running.process.pid, signal.SIGKILL)
            running.process.wait()


@pytest.mark.thorough
def test_service_and_worker_run_as_composed(image, start, room_frames, tmp_path):
    steps, parts = steps_of(DOCKERFILE), composed()["services"]
    compiled = machine_code(image)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = {"SCENEPRINT_PORT": str(free.getsockname()[1])}

    def exits(words):
        env = {**image.env, **port}
        return subprocess.run(image.command(words), env=env, timeout=PATIENCE_S, cwd=image.root,
                              capture_output=True).returncode  # fmt: skip

    assert exits(health_check(steps)) == 1  # nobody is there
    service = start("service", port)
    until = time.monotonic() + PATIENCE_S
    while exits(health_check(steps)) != 0:
        assert service.process.poll() is None, service.log.read_text()
        assert time.monotonic() < until, service.log.read_text()
        time.sleep(0.3)

    url = f"http://127.0.0.1:{port['SCENEPRINT_PORT']}/v1"
    assert httpx.get(f"{url}/maps").status_code == 401
    documented = set(re.findall(r"docker compose exec service (.+?) NAME", DOCKERFILE + COMPOSE))
    assert documented == {"sceneprint keys --create"}
    made = subprocess.run(
        image.command([*documented.pop().split(), "robot"]), env=image.env, text=True,
        capture_output=True, check=True, cwd=image.root,
    )  # fmt: skip
    headers = {"Authorization": f"Bearer {made.stdout.strip()}"}
    with httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_S) as client:
        assert client.post("/maps", json={"name": "hall"}).status_code == 201
        worker = start("worker", port)
        frame = room_frames[0]
        lens, data = frame.intrinsics, tmp_path / "frame.npy"
        np.save(data, frame.depth)
        camera = {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        added = client.post(
            "/maps/hall/frames",
            files={"frame": ("frame.npy", data.read_bytes())},
            data={"meta": json.dumps({"intrinsics": camera})},
            headers={"Prefer": "wait=200"},
        )
        assert (added.status_code, added.json()["state"]) == (201, "indexed"), added.text
        found = client.post(
            "/maps/hall/queries",
            files={"frame": ("frame.npy", data.read_bytes())},
            data={"meta": json.dumps({"intrinsics": camera})},
        )
        assert (found.status_code, found.json()["status"]) == (200, "found"), found.text
    assert exits(parts["worker"]["healthcheck"]["test"][1:]) == 0

    stop = signal.Signals[only(steps, "STOPSIGNAL").rest]
    assert parts["service"]["stop_grace_period"] == "30s"
    assert worker.stop(stop, 30) == 0, worker.log.read_text()
    assert service.stop(stop, 30) == 0, service.log.read_text()
    assert exits(health_check(steps)) == 1
    # nothing was left to compile: no first frame waits for what the build could have done
    assert machine_code(image) == compiled
