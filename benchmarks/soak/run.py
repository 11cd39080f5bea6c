"""The run of a plan: start processes and clients, inject faults, and collect the figures."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import httpx
import numpy as np
from tqdm import tqdm

from benchmarks.soak.attacks import SESSION, AttackFigures, run_attacks
from benchmarks.soak.audit import AuditCounts, await_idle, check, count_separated
from benchmarks.soak.broken_uploads import BrokenFigures, send_broken
from benchmarks.soak.failover_client import Exchange, FailoverClient, RequestLog, bearer
from benchmarks.soak.faults import CUT_OFF_S, FaultInjector, Kill, Promotion, schedule
from benchmarks.soak.lock_samples import LockSampler, LockShares
from benchmarks.soak.operations import OperationFigures, call_as_everybody
from benchmarks.soak.plan import MAP, MODEL, Plan
from benchmarks.soak.postgres_pair import DATABASE
from benchmarks.soak.processes import Fleet, await_service
from benchmarks.soak.recordings import Shot, recordings, walks
from benchmarks.soak.robots import (
    OFFLINE_PATIENCE_S,
    Acknowledged,
    Driver,
    Ledger,
    Listener,
    OfflineRobot,
    Reader,
    Robot,
    image_query,
)
from sceneprint.store.deletion import DAY_S
from sceneprint_client import Client
from sceneprint_client.api import FrameMeta, JobState
from sceneprint_client.api.admin import Scope
from sceneprint_client.errors import JobOver, UnknownJob

#: Map of the robot that starts offline, and fraction of the run for which it is offline.
OFFLINE_MAP, OFFLINE = "fleet-offline", 0.4
#: Number of permanent frames in the shared map.
STABLE = 24
#: Time limit for the acknowledgement of the last frame of a robot, seconds.
PATIENCE_S = 240.0
#: Smallest fraction of the run in which locks must be sampled.
SAMPLED = 0.5
#: Number of driver threads, of keys of an attacker, of frames of its map, and of those with poses.
DRIVERS, KEYS, ROWS, POSED = 32, 10, 1_000, 16
#: Messages of SQLite and sceneprint when a writer gives up waiting.
LOCKED = ("database is locked", "have waited for long", "has been writing for long")


@dataclass
class SoakFigures:
    """Figures of a run.

    Parameters
    ----------
    plan, found : plan of the run, and final state of the store
    outages : see `outages`
    waits_ms : median and 99th percentile of each kind of request
    memory : peak memory of a service process and of a worker process, bytes
    deleted, queries, repeated : number of frames that robots deleted, of answered queries, and of
        repeated requests
    faults : descriptions of wrong answers and failed clients
    locked : number of log lines in which a writer gave up waiting
    damaged, leftovers : damages and unreferenced files that `sceneprint fsck` found
    lost : acknowledged frames that are missing, except those that a standby had not received
    window : acknowledged frames that the standbys had not received
    spooled, spooled_twice : frames of the offline robot, and those that were sent again
    seconds : total duration
    """

    plan: Plan
    found: AuditCounts
    kills: Counter[str] = field(default_factory=Counter)
    outages: dict[str, list[float]] = field(default_factory=dict)
    promotions: Sequence[Promotion] = ()
    waits_ms: dict[str, tuple[float, float]] = field(default_factory=dict)
    memory: tuple[int, int] = (0, 0)
    deleted: int = 0
    queries: int = 0
    repeated: int = 0
    faults: list[str] = field(default_factory=list)
    locked: int = 0
    damaged: int = 0
    leftovers: int = 0
    lost: int = 0
    window: int = 0
    locks: LockShares = field(default_factory=LockShares)
    spooled: int = 0
    spooled_twice: int = 0
    attacks: list[AttackFigures] = field(default_factory=list)
    broken: BrokenFigures | None = None
    operations: list[OperationFigures] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def turn_ms(self) -> tuple[float, float]:
        """Return the time for which a frame blocks all writers, and those of its map, ms."""
        ms_per_frame = 1e3 / max(self.found.acknowledged, 1)
        return self.locks.everybody * ms_per_frame, self.locks.one_map * ms_per_frame

    @property
    def exceeded(self) -> list[str]:
        """Return the bounds of the plan that are exceeded."""
        plan, (_, query_ms) = self.plan, self.waits_ms.get("query", (0.0, 0.0))
        # A host that is cut off may hold the lock for that long.
        cut_off_s = plan.count("partition") * CUT_OFF_S
        most_turn_ms = plan.most_turn_ms + 1e3 * cut_off_s / max(self.found.acknowledged, 1)
        bounds = {
            "the turn of all writers takes": (self.turn_ms[0], most_turn_ms, "ms a frame"),
            "the 99th percentile of queries is": (query_ms, plan.most_query_ms, "ms"),
            "a process had": (max(self.memory) / 1e6, plan.most_bytes / 1e6, "MB"),
        }
        return [
            f"{what} {value:,.1f} {unit}, above {most:,.0f}"
            for what, (value, most, unit) in bounds.items()
            if value > most
        ]

    @property
    def sound(self) -> bool:
        """Return whether no data was lost, duplicated or damaged, and all bounds hold."""
        counts, plan = self.found, self.plan
        stored = counts.acknowledged - len(counts.missing) - counts.aged
        wrong = (
            self.lost, counts.returned, counts.stuck, counts.doubled, counts.strangers,
            counts.heard_twice, counts.disagreeing, counts.separated, len(counts.wrong),
            self.damaged, len(self.faults), counts.looked_up - counts.found,
            stored - counts.indexed - counts.stated,
            len(self.exceeded), self.locked, sum(attack.victim_refused for attack in self.attacks),
            sum(not operation.sound for operation in self.operations),
            0 if self.broken is None else len(self.broken.failed) + self.broken.crashed,
        )  # fmt: skip
        tried = counts.acknowledged > 0 and self.window == len(counts.missing)
        if plan.store == "postgresql":  # a server that is down or frozen is not sampled
            tried &= self.locks.seconds >= SAMPLED * plan.seconds
        tried &= self.spooled == plan.count("offline-hour")
        return tried and not any(wrong) and (plan.asynchronous or not counts.unheard)


def drive(folder: Path, plan: Plan) -> SoakFigures:
    """Run a plan in an empty folder, and end all its processes."""
    begun = time.monotonic()
    # Walks of the robots, of the offline robot, and of the permanent frames.
    n = plan.robots + -(-plan.count("offline-hour") // plan.frames) + -(-STABLE // plan.frames)
    with recordings(plan.data, n * plan.frames) as data:
        walked = walks(data, n, plan.frames)
    shots = [shot for walk in walked[plan.robots :] for shot in walk]
    stable, spooled = shots[:STABLE], shots[STABLE:][: plan.count("offline-hour")]
    with Fleet(folder, plan) as fleet:
        figures = _Run(fleet, plan, walked[: plan.robots], stable, spooled).figures()
    if plan.count("operation"):
        figures.operations = call_as_everybody(folder, stable[:4], plan.count("operation"))
    figures.seconds = time.monotonic() - begun
    return figures


class _Run:
    """A run in progress; see `drive`."""

    def __init__(
        self, fleet: Fleet, plan: Plan, walked: list[list[Shot]], stable: list[Shot],
        spooled: list[Shot],
    ) -> None:  # fmt: skip
        self._fleet, self._plan = fleet, plan
        self._walked, self._stable, self._spooled = walked, stable, spooled
        self._ledger, self._log, self._stop = Ledger(), RequestLog(), threading.Event()
        self._rng = random.Random(plan.seed)
        self._figures = SoakFigures(plan, AuditCounts(), faults=self._log.faults)
        #: Retention by map, seconds; other maps have no retention.
        self._aging: dict[str, float] = {}
        if plan.retention_s is not None:
            own = {plan.map_of(i) for i in range(plan.robots)} - {MAP}
            self._aging = dict.fromkeys(own, plan.retention_s)

    def figures(self) -> SoakFigures:
        """Run the whole plan, and return its figures."""
        fleet, plan, figures = self._fleet, self._plan, self._figures
        key = fleet.start()
        locks = LockSampler(self._primary)
        with ExitStack() as opened:
            clients = [opened.enter_context(Client(url, key)) for url in fleet.urls]
            names = self._create_maps(clients[0])
            ids = self._upload_stable(clients[0])
            listeners = [self._listener(clients[0], name) for name in names]
            offline = self._offline_robot(clients[0])
            readers = self._readers(clients[0], ids)
            sampling = [locks] if plan.store == "postgresql" else []
            injector = FaultInjector(
                fleet, plan, partial(_answers, key=key, shot=self._stable[0]), self._rng
            )  # fmt: skip
            self._walk(clients[0], key, [*listeners, *offline, *readers, *sampling], injector)
            for thread in (*offline, *readers):
                thread.finish(OFFLINE_PATIENCE_S)
            for url in fleet.urls:
                await_service(url)
            await_idle(clients[0])
            for sampler in sampling:
                sampler.stop()
            figures.found = check(self._ledger, ids, clients, listeners, self._aging)
            for listener in listeners:
                listener.stop()
            figures.memory = fleet.memory()
            fleet.stop()
            figures.leftovers, figures.damaged = fleet.fsck()
            with fleet.store() as store, store.database.read() as connection:
                figures.found.separated = count_separated(connection, names)
        figures.locks, figures.spooled_twice = locks.shares, sum(r.repeated for r in offline)
        self._count(injector)
        return figures

    def _count(self, injector: FaultInjector) -> None:
        """Fill in the figures on faults, requests and acknowledged frames."""
        figures, log, ledger = self._figures, self._log, self._ledger
        unreceived = {name for promotion in injector.promotions for name in promotion.unreceived}
        window = {frame.frame_id for frame in ledger.frames} & unreceived
        figures.kills = Counter(kill.victim for kill in injector.kills)
        figures.outages = outages(injector.kills, log.exchanges)
        figures.promotions = injector.promotions
        for kind in sorted({exchange.kind for exchange in log.exchanges}):
            ms = [1e3 * (e.answered - e.begun) for e in log.exchanges if e.kind == kind]
            p50, p99 = np.quantile(ms, (0.5, 0.99)).tolist()
            figures.waits_ms[kind] = p50, p99
        figures.repeated = sum(exchange.tries - 1 for exchange in log.exchanges)
        figures.deleted, figures.queries = len(ledger.deleted), ledger.queries
        figures.lost, figures.window = len(figures.found.missing - window), len(window)
        figures.spooled = sum(frame.map_name == OFFLINE_MAP for frame in ledger.frames)
        if self._plan.store == "sqlite":
            lines = self._fleet.log_lines()
            figures.locked = sum(sign in line for line in lines for sign in LOCKED)

    def _primary(self) -> str:
        assert self._fleet.pair is not None
        return self._fleet.pair.primary.url(DATABASE).replace("+psycopg", "")

    def _create_maps(self, client: Client) -> list[str]:
        """Create the maps of all robots."""
        names = [MAP, *map(self._plan.map_of, range(self._plan.robots))]
        names += [OFFLINE_MAP] if self._spooled else []
        names = list(dict.fromkeys(names))
        for name in names:
            days = self._aging[name] / DAY_S if name in self._aging else None
            client.create_map(name, model=MODEL, retention_days=days)
        return names

    def _upload_stable(self, client: Client) -> list[str]:
        """Upload the permanent frames, and return their ids."""
        begun = time.monotonic()
        added = [client.upload(MAP, shot.png, shot.meta) for shot in self._stable]
        client.wait([upload.job_id for upload in added])
        self._ledger.frames += [
            Acknowledged(upload.frame_id, MAP, shot, begun)
            for upload, shot in zip(added, self._stable, strict=True)
        ]
        return [upload.frame_id for upload in added]

    def _walk(
        self, client: Client, key: str, others: Sequence[threading.Thread], injector: FaultInjector
    ) -> None:
        """Start all clients, inject the faults, and stop the robots at the end."""
        plan, stop = self._plan, self._stop
        drivers = self._drivers(client)
        noisy = self._create_noisy_tenant(client) if plan.count("attack") else []
        with tqdm(total=plan.seconds, unit="s", disable=None, leave=False) as bar:
            showing = threading.Thread(target=_show, args=(bar, self._ledger, stop), daemon=True)
            begun = time.monotonic()
            for thread in (*others, showing, *drivers):
                thread.start()
            try:
                due = schedule(plan.seconds, plan.faults, self._rng)
                injector.run(due, bar.set_postfix_str)
                self._attack_others(client, key, noisy)
                if not noisy:  # otherwise the run ends with the attacks
                    stop.wait(max(begun + plan.seconds - time.monotonic(), 0.0))
            finally:
                stop.set()
        end = time.monotonic() + PATIENCE_S
        for driver in drivers:
            driver.finish(end - time.monotonic())

    def _attack_others(self, client: Client, key: str, noisy: Sequence[str]) -> None:
        """Let a tenant attack the others, and send broken uploads."""
        plan, fleet, figures = self._plan, self._fleet, self._figures
        if plan.count("attack"):
            figures.attacks += run_attacks(
                fleet.urls[0], noisy, self._stable[:8], float(plan.count("attack")), self._log,
                partial(self._empty_queue, client), plan.attacks,
            )  # fmt: skip
        if plan.count("broken-upload"):
            client.create_map("siege", model=MODEL)
            figures.broken = send_broken(
                fleet.urls[0], key, [*fleet.services, *fleet.workers], self._stable,
                plan.count("broken-upload"), plan.seed,
            )  # fmt: skip

    def _create_noisy_tenant(self, client: Client) -> list[str]:
        """Create a tenant with a map of many frames, and return its keys."""
        client.create_map("noisy", model=MODEL)
        grants: dict[str, Scope] = {"noisy": "admin"}
        first = client.create_key("noisy-0", grants)
        keys = [first.secret] + [
            client.create_key(f"noisy-{i}", grants, tenant="noisy-0").secret for i in range(1, KEYS)
        ]
        few = self._stable[:8]
        for i in range(ROWS):
            shot = few[i % len(few)]
            client.put_frame("noisy", f"row-{i}", shot.png, shot.meta)
        self._empty_queue(client)
        for i in range(POSED):
            shot = few[i % len(few)]
            matrix = [[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
            pose = {"parent_frame": "map", "matrix": matrix}
            meta = shot.meta.model_dump() | {"session": SESSION, "sequence": i, "pose": pose}
            client.put_frame("noisy", f"posed-{i}", shot.png, FrameMeta.model_validate(meta))
        await_idle(client)
        return keys

    def _empty_queue(self, client: Client) -> None:
        """Cancel the queued jobs of the attacker, and wait for the others."""
        for job in list(client.jobs(JobState.QUEUED)):
            if job.map == "noisy":
                with suppress(JobOver, UnknownJob):
                    client.cancel_job(job.job_id)
        await_idle(client)

    def _drivers(self, client: Client) -> list[Driver]:
        """Return the threads of the robots; each robot has its own key and starting time."""
        plan, robots = self._plan, []
        for i, walk in enumerate(self._walked):
            name, map_name = f"robot-{i}", plan.map_of(i)
            key = client.create_key(name, {map_name: "write"}).secret
            robots.append(Robot(i, name, map_name, key, walk, i / plan.robots / plan.rate))
        return [
            Driver(
                robots[i::DRIVERS], plan.rate, FailoverClient(self._fleet.urls, self._log, i),
                self._ledger, self._log, self._stop, deletes=not plan.asynchronous,
                signed=plan.signed,
            )
            for i in range(min(plan.robots, DRIVERS))
        ]  # fmt: skip

    def _listener(self, client: Client, map_name: str) -> Listener:
        secret = client.create_key(f"listener-of-{map_name}", {map_name: "read"}).secret
        failover = FailoverClient(self._fleet.urls, self._log)
        return Listener(map_name, secret, failover, self._log)

    def _readers(self, client: Client, ids: Sequence[str]) -> list[Reader]:
        """Return the readers of the shared map."""
        secrets = [
            client.create_key(f"reader-{i}", {MAP: "read"}).secret
            for i in range(self._plan.readers)
        ]
        return [
            Reader(
                secret, MAP, ids, FailoverClient(self._fleet.urls, self._log, i), self._ledger,
                self._log, self._stop, i,
            )
            for i, secret in enumerate(secrets)
        ]  # fmt: skip

    def _offline_robot(self, client: Client) -> list[OfflineRobot]:
        """Return the offline robot, if the plan has one."""
        if not self._spooled:
            return []
        name = "robot-offline"
        key = client.create_key(name, {OFFLINE_MAP: "write"}).secret
        robot = Robot(self._plan.robots, name, OFFLINE_MAP, key, self._spooled, 0.0)
        file, offline_s = self._fleet.folder / "spool.db", OFFLINE * self._plan.seconds
        return [OfflineRobot(robot, file, offline_s, self._fleet.urls, self._ledger, self._log)]


def _answers(url: str, *, key: str, shot: Shot) -> bool:
    """Return whether a service answers a query."""
    return httpx.post(
        f"{url}/v1/maps/{MAP}/queries", headers=bearer(key), timeout=5,
        trust_env=False, **image_query(shot, k="1", stages="retrieve", keep="false"),
    ).is_success  # fmt: skip


def _show(bar: tqdm[None], ledger: Ledger, stop: threading.Event) -> None:
    while not stop.wait(1.0):
        bar.set_description(f"{len(ledger.frames)} acknowledged")
        bar.update(1)


def outages(kills: Sequence[Kill], exchanges: Sequence[Exchange]) -> dict[str, list[float]]:
    """Return the longest time without an answer after each kill, by victim, seconds.

    A gap belongs to the first kill within it, or else to the last kill before it.
    """
    longest = [0.0] * len(kills)
    for wait in exchanges:
        if wait.tries > 1:
            within = [i for i, kill in enumerate(kills) if wait.begun <= kill.at <= wait.answered]
            before = [i for i, kill in enumerate(kills) if kill.at < wait.begun]
            for i in within[:1] or before[-1:]:
                longest[i] = max(longest[i], wait.answered - max(wait.begun, kills[i].at))
    gaps: dict[str, list[float]] = {}
    for kill, seconds in zip(kills, longest, strict=True):
        gaps.setdefault(kill.victim, []).append(seconds)
    return gaps
