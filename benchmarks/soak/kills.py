"""SIGKILL at random moments, while robots upload and delete: what was lost, and what was doubled.

The same frames go to two data folders: one undisturbed, one whose service, workers and embedded
robots are killed again and again. In the end both must hold the same and answer the same.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from benchmarks.soak.answers import State, state_of
from benchmarks.soak.load import MAP, MODEL, Part, Shot, free_port, service, workers
from benchmarks.soak.writers import EmbeddedWriter, Plan, RemoteWriter, write_shots
from sceneprint.errors import SceneprintError
from sceneprint_client import Client

#: Seconds between two kills: sometimes less than a part takes to begin, sometimes more.
PAUSE_S = (0.2, 2.0)
#: Seconds for the end of all work after the last kill.
END_S = 300.0
#: How often each is killed, in proportion: the one worker among several, as well as all.
VICTIMS = {"service": 3, "all workers": 2, "one worker": 3, "a writer": 3}


@dataclass(frozen=True)
class KillFigures:
    """What came of it.

    Parameters
    ----------
    kills : by victim
    acknowledged, deleted : frames, and those among them whose deletion was acknowledged
    lost : acknowledged frames that are not indexed in the end, and deleted ones that are
    doubled : frames with more than one signature, contents with more than one frame, and frames
        that nobody was told of
    separated : changes whose event or line of the audit log is missing
    half_written : findings of `sceneprint fsck` other than files that nothing refers to
    leftovers : files that nothing refers to
    differing : frames whose signature is not that of the undisturbed run
    queries, wrong : asked with exact=true, and those whose answer is not the undisturbed one
    retries : uploads and deletions that had to be sent again
    tries : most tries of a job
    seconds : from the first kill to the last
    """

    kills: dict[str, int]
    acknowledged: int
    deleted: int
    lost: int
    doubled: int
    separated: int
    half_written: int
    leftovers: int
    differing: int
    queries: int
    wrong: int
    retries: int
    tries: int
    seconds: float


def kill(folder: Path, shots: list[Shot], n_kills: int, seed: int) -> KillFigures:
    """Upload all shots while killing, and compare with an undisturbed run.

    Parameters
    ----------
    folder : empty; two data folders and logs come to lie in it
    shots : to upload
    n_kills : how many
    seed : of victims and moments
    """
    calm, data = folder / "calm", folder / "killed"
    run_undisturbed(calm, shots)
    write_shots(shots, folder / "shots.json")
    with Client.embedded(data) as client:
        client.create_map(MAP, model=MODEL)
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    parts = [service(data, port, waiting=512), workers(data, 2)]
    plan = Plan(range(len(shots)))
    remote = [RemoteWriter(url, shots, plan) for _ in range(2)]
    embedded = [EmbeddedWriter(data, folder / "shots.json", plan) for _ in range(2)]
    try:
        for part in parts:
            part.begin()
        for writer in (*remote, *embedded):
            writer.start()
        kills, seconds = _kill(parts, embedded, plan, n_kills, random.Random(seed))
        plan.release(len(shots) + 4)
        wait_until(lambda: not any(one.is_alive() for one in (*remote, *embedded)), "writers end")
        if len(plan.acknowledged) != len(shots):
            raise AssertionError("a writer ended before all of its frames were acknowledged")
        with Client(url) as client:
            wait_until(lambda: is_idle(client), "all jobs are over")
        leftovers, half_written = check_files(data)
        found, wanted = state_of(data, url), state_of(calm, None)
    finally:
        for part in parts:
            part.kill()
        for one in embedded:
            one.end()
    return figures(kills, plan, leftovers, half_written, found, wanted, seconds)


def figures(
    kills: Counter[str], plan: Plan, leftovers: int, half_written: int, found: State,
    wanted: State, seconds: float,
) -> KillFigures:  # fmt: skip
    """Hold what was found against what was acknowledged and against the undisturbed run."""
    kept = {one for one in plan.acknowledged.values() if one not in plan.deleted}
    indexed = set(found.contents)
    resurrected = indexed & plan.deleted
    return KillFigures(
        kills=dict(kills),
        acknowledged=len(plan.acknowledged),
        deleted=len(plan.deleted),
        lost=len(kept - indexed) + len(resurrected),
        doubled=found.doubled + len(indexed - kept - plan.deleted),
        separated=found.separated,
        half_written=half_written,
        leftovers=leftovers,
        differing=sum(
            found.signatures.get(content) != vector for content, vector in wanted.signatures.items()
        ),
        queries=len(wanted.answers),
        wrong=sum(found.answers.get(name) != answer for name, answer in wanted.answers.items()),
        retries=plan.retries,
        tries=found.tries,
        seconds=seconds,
    )


def run_undisturbed(data: Path, shots: list[Shot]) -> None:
    """Upload all shots, delete those that are to be deleted, and wait for the rest."""
    with Client.embedded(data) as client:
        client.create_map(MAP, model=MODEL)
        jobs = []
        for shot in shots:
            added = client.upload(MAP, shot.png, shot.meta)
            if Plan.is_deleted(shot.number):
                client.delete_frame(MAP, added.frame_id)
            else:
                jobs.append(added.job_id)
        with tqdm(total=len(jobs), desc="undisturbed run", disable=None, leave=False) as bar:

            def progress(done: int, _: int) -> None:
                bar.update(done - bar.n)

            client.wait(jobs, timeout_s=3600, progress=progress)


def _kill(
    parts: list[Part], embedded: list[EmbeddedWriter], plan: Plan, n_kills: int, rng: random.Random
) -> tuple[Counter[str], float]:
    """Kill, begin again, and let uploads keep pace with the kills."""
    serving, working = parts
    done: Counter[str] = Counter()
    released, start = 0, time.monotonic()
    for number in tqdm(range(n_kills), desc="kills", disable=None, leave=False):
        due = plan.total * (number + 1) // n_kills
        plan.release(due - released)
        released = due
        time.sleep(rng.uniform(*PAUSE_S))
        victim = rng.choices(list(VICTIMS), list(VICTIMS.values()))[0]
        if victim == "service":
            serving.kill()
            serving.begin()
        elif victim == "all workers":
            working.kill()
            working.begin()
        elif victim == "one worker":
            children = working.children()
            if not children:  # not begun yet: then the one that begins them
                working.kill()
                working.begin()
            else:
                with suppress(ProcessLookupError):
                    os.kill(rng.choice(children), signal.SIGKILL)
        else:
            rng.choice(embedded).kill()
        done[victim] += 1
    return done, time.monotonic() - start


def wait_until(what: Callable[[], bool], said: str) -> None:
    """Wait for something; AssertionError where it does not come to it within END_S."""
    end = time.monotonic() + END_S
    while not what():
        if time.monotonic() > end:
            raise AssertionError(f"it did not come to it within {END_S:g} s that {said}")
        time.sleep(0.2)


def is_idle(client: Client) -> bool:
    """Whether the service answers, and no job waits or runs."""
    try:
        jobs = client.status().jobs or {}
    except SceneprintError:
        return False
    return not jobs.get("queued", 0) and not jobs.get("running", 0)


def check_files(data: Path) -> tuple[int, int]:
    """Files that nothing refers to, and all other findings; the former are removed."""
    command = [sys.executable, "-m", "sceneprint", "fsck", "--data", str(data), "--json"]
    report = data.with_suffix(".fsck.json")
    subprocess.run([*command, str(report), "--grace", "0"], check=False, capture_output=True)
    return leftovers_of(report)


def leftovers_of(report: Path) -> tuple[int, int]:
    """Leftovers and other findings of a report of `sceneprint fsck --json`."""
    findings = json.loads(report.read_text())["findings"]
    left = sum(one["severity"] == "leftover" for one in findings)
    return left, len(findings) - left
