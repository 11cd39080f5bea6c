"""Tests of the image and of Compose, without a container engine.

hadolint and the Compose schema check the files, our own rules check further properties, and the
steps of the image are run in a folder that represents its file system.
"""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

import httpx
import numpy as np
import pytest
from ruamel.yaml import YAML

from benchmarks.waiting import PATIENCE_S, free_port
from sceneprint.process import SECRETS
from sceneprint.settings import Settings
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta

ROOT = Path(__file__).resolve().parent.parent
DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPOSE = (ROOT / "docker-compose.yml").read_text()
IGNORE = (ROOT / ".dockerignore").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
KNOWN_SETTINGS = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields}


# Reading a Dockerfile


class Step(NamedTuple):
    """An instruction: its stage (from 0), name, flags, and the rest of it."""

    stage: int
    name: str
    flags: tuple[str, ...]
    rest: str


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
    return [step for step in steps if step.stage == steps[-1].stage]


def only(steps, name):
    """Return the rest of the one step of that name in the image's stage."""
    (step,) = [step for step in final(steps) if step.name == name]
    return step.rest


def words(steps, name):
    """Return the words of a step in exec form."""
    return json.loads(only(steps, name).removeprefix("CMD "))


def environment(steps):
    """What ENV sets in the image's stage."""
    pairs = [shlex.split(step.rest) for step in final(steps) if step.name == "ENV"]
    return dict(pair.split("=", 1) for words in pairs for pair in words)


# Lint


@pytest.mark.parametrize(
    ("file", "command"),
    [
        ("Dockerfile", ["hadolint", "--no-color"]),
        ("docker-compose.yml", ["check-jsonschema", "--builtin-schema", "vendor.compose-spec"]),
    ],
)
def test_linters_accept_the_files(file, command):
    """The linters are installed beside this Python, with the extra `dev`."""
    program = Path(sys.executable).parent / command[0]
    done = subprocess.run(
        [program, *command[1:], ROOT / file], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stdout


def test_the_image_runs_as_a_user_on_slim_bases_with_settings_that_are_read():
    steps = steps_of(DOCKERFILE)
    users = [step.rest for step in final(steps) if step.name == "USER"]
    assert users
    assert all(re.fullmatch(r"[1-9]\d*:[1-9]\d*", user) for user in users)
    slim = r"\S+:\d+\.\d+\S*-slim\S*( AS \w+)?"
    assert all(re.fullmatch(slim, step.rest) for step in steps if step.name == "FROM")
    env = environment(steps)
    assert env.keys() - KNOWN_SETTINGS == {
        "PATH", "PYTHONUNBUFFERED", "PYTHONDONTWRITEBYTECODE",
        "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_CACHE_DIR",
    }  # fmt: skip
    assert only(steps, "EXPOSE") == env["SCENEPRINT_PORT"]
    assert words(steps, "VOLUME") == [env["SCENEPRINT_DATA_DIR"]]
    assert f'version="{PROJECT["version"]}"' in only(steps, "LABEL")


# What is sent to the builder


def is_ignored(path):
    """Return whether .dockerignore excludes a file; the last pattern that fits decides."""
    ignored, parts = False, path.split("/")
    for line in IGNORE.splitlines():
        if line.strip() and not line.startswith("#"):
            pattern = line.removeprefix("!").removeprefix("**/")
            heads = parts if line.startswith("**/") else parts[:1]
            if any(fnmatch(head, pattern) for head in heads):
                ignored = not line.startswith("!")
    return ignored


def test_the_builder_gets_no_secret():
    assert [path for path in (".env", "key.pem", ".git/config") if not is_ignored(path)] == []


def context_files():
    """Return the files that the builder gets: those that git knows or would add."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    paths = sorted(path for path in listed.stdout.split("\0") if path and (ROOT / path).is_file())
    return [path for path in paths if not is_ignored(path)]


# docker-compose.yml


def composed():
    """Return the composition with its merge keys and anchors resolved."""
    return YAML(typ="safe", pure=True).load(COMPOSE)


def defaults(value):
    """What Compose makes of ${NAME:-default} where NAME is not set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", value)


#: Of libraries that ours are built on: who they are to PostgreSQL and to the object store.
OF_LIBRARIES = re.compile(r"PGPASSWORD|AWS_[A-Z_]+(?<!_FILE)")


@pytest.mark.parametrize("name", composed()["services"])
def test_a_part_of_the_composition_is_confined_and_told_what_is_read(name):
    part = composed()["services"][name]
    assert re.fullmatch(r"\S+:v?\d+\.\d+\S*", part["image"])
    assert (part["read_only"], part["init"], part["cap_drop"]) == (True, True, ["ALL"])
    assert part["security_opt"] == ["no-new-privileges:true"]
    assert set(part["deploy"]["resources"]["limits"]) == {"cpus", "memory", "pids"}
    for port in part.get("ports", []):
        assert re.fullmatch(r"127\.0\.0\.1:\d+:\d+", defaults(port))
    variables = part.get("environment", {})
    for key, value in variables.items():
        if key.endswith("_FILE"):
            assert value in [f"/run/secrets/{secret}" for secret in part["secrets"]], key
        elif re.search("PASSWORD|SECRET", key):  # without a default
            assert re.fullmatch(r"\$\{SCENEPRINT_\w+:-\}", value), key
    if part["image"].startswith("sceneprint:"):
        ours = {variable for variable in variables if variable.removesuffix("_FILE") in SECRETS}
        unknown = variables.keys() - KNOWN_SETTINGS - ours
        assert [name for name in unknown if not OF_LIBRARIES.fullmatch(name)] == []
        own = {key.removeprefix("SCENEPRINT_").lower(): value for key, value in variables.items()
               if key in KNOWN_SETTINGS}  # fmt: skip
        Settings(**own)


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
    there = code.replace("/proc", str(tmp_path))
    assert there != code

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


class Image:
    """The file system and the environment of an image, below a folder."""

    def __init__(self, root):
        self.root, self.env = root, {}

    def here(self, text):
        """Return a text with the current paths of the image's folders."""
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
    inherited = re.compile(
        r"HOME|LANG|TMPDIR|PIP_\w+|SSL_\w+|REQUESTS_\w+|\w+_proxy", re.IGNORECASE
    )
    env = {name: value for name, value in os.environ.items() if inherited.fullmatch(name)}
    return {**env, "PATH": f"{folder}/bin:/usr/local/bin:/usr/bin:/bin"}


def run_step(image, shell, cwd):
    """Run what a RUN says, without what is root's."""
    mine = [part for part in parts_of(shell) if part.split()[0] not in OF_ROOT]
    if mine:
        done = subprocess.run(
            ["/bin/sh", "-c", image.here(" && ".join(mine))],
            cwd=cwd, env=image.env, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert done.returncode == 0, (
            f"a step of the Dockerfile fails. Where pip found nothing to install, this test needs "
            f"a package index (PIP_INDEX_URL, or a pip.conf).\n{mine}\n{done.stdout}{done.stderr}"
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
    steps, files = steps_of(DOCKERFILE), context_files()
    image = Image(folder / "root")
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
    result = built(tmp_path_factory.mktemp("image"))
    result.env["HOME"] = "/nonexistent"  # the user has none
    return result


@pytest.fixture
def start(image, tmp_path):
    """Starts a part of the composition; whatever still runs at the end is killed."""
    started = []
    steps = steps_of(DOCKERFILE)

    def begin(name, env):
        part = composed()["services"][name]
        command = words(steps, "ENTRYPOINT") + part.get("command", words(steps, "CMD"))
        log = tmp_path / f"{name}.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                image.command(command), env={**image.env, **part["environment"], **env},
                cwd=image.root, stdout=out, stderr=out, start_new_session=True,
            )  # fmt: skip
        started.append(process)
        return process, log

    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def machine_code(image):
    return {path.name for path in Path(image.env["NUMBA_CACHE_DIR"]).rglob("*.nbc")}


@pytest.mark.thorough
def test_service_and_worker_run_as_composed(image, start, room_frames, tmp_path):
    steps, parts = steps_of(DOCKERFILE), composed()["services"]
    compiled = machine_code(image)
    assert len(compiled) > 20
    port = {"SCENEPRINT_PORT": str(free_port())}

    def exits(command):
        env = {**image.env, **port}
        return subprocess.run(image.command(command), env=env, timeout=PATIENCE_S, cwd=image.root,
                              capture_output=True).returncode  # fmt: skip

    assert exits(words(steps, "HEALTHCHECK")) == 1  # nobody is there
    service, service_log = start("service", port)
    until = time.monotonic() + PATIENCE_S
    while exits(words(steps, "HEALTHCHECK")) != 0:
        assert service.poll() is None, service_log.read_text()
        assert time.monotonic() < until, service_log.read_text()
        time.sleep(0.3)

    url = f"http://127.0.0.1:{port['SCENEPRINT_PORT']}"
    assert httpx.get(f"{url}/v1/maps").status_code == 401
    documented = set(re.findall(r"docker compose exec service (.+?) NAME", DOCKERFILE + COMPOSE))
    assert documented == {"sceneprint keys --create"}
    key = subprocess.run(
        image.command([*documented.pop().split(), "robot"]), env=image.env, text=True,
        capture_output=True, check=True, cwd=image.root,
    )  # fmt: skip
    with Client(url, key.stdout.strip(), timeout_s=PATIENCE_S) as client:
        client.create_map("hall")
        worker, worker_log = start("worker", port)
        lens, path = room_frames[0].intrinsics, tmp_path / "frame.npy"
        np.save(path, room_frames[0].depth)
        camera = {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        meta = FrameMeta.model_validate({"intrinsics": camera})
        client.wait([client.upload("hall", path, meta).job_id], timeout_s=PATIENCE_S)
        assert client.query("hall", path, meta).status == "found"
    assert exits(parts["worker"]["healthcheck"]["test"][1:]) == 0

    assert parts["service"]["stop_grace_period"] == "30s"
    for process, log in ((worker, worker_log), (service, service_log)):
        process.send_signal(signal.Signals[only(steps, "STOPSIGNAL")])
        assert process.wait(30) == 0, log.read_text()
    assert exits(words(steps, "HEALTHCHECK")) == 1
    # nothing was left to compile: no first frame waits for what the build could have done
    assert machine_code(image) == compiled
