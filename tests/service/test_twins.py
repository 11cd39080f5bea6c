"""Tests that activity in other maps is invisible to a key for one map.

Two stores have the same map, and one has many changes in other maps. The answers must be equal
except times and random values.
"""

import json
import re
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import pytest

KEYS = {
    "boss": {"*": "admin"}, "admin": {"alpha": "admin"}, "reader": {"alpha": "read"},
}  # fmt: skip
ALPHA = "/v1/maps/alpha"
#: Ids and seals, the beginnings of ids in names of files, and cursors.
CHANCE = re.compile(
    r'\b[0-9a-f]{32}(?:[0-9a-f]{16})?\b|(?<=[-"])[0-9a-f]{12}(?=[-.])'
    r'|(?<="next_cursor":")[0-9a-f]{64}(?=")'
)
TIMES = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)")
#: How long something took, and in which minutes it was.
TOOK = re.compile(
    r'"milliseconds":(?:{[^}]*}|[\d.e-]+)|"oldest_waiting_s":{[^}]*}|"(minutes|buckets)":\[[^]]*\]'
)
OWN_HEADERS = ("date", "x-request-id", "content-length")


@dataclass
class Twin:
    """A service, with frames to send; in a busy one much happens beside `alpha`."""

    house: Any
    shots: list[Any]
    busy: bool
    ids: dict[str, str] = field(default_factory=dict)
    sent: int = 0

    def ask(self, key, method, path, **request):
        answer = self.house.ask(key, method, path, **request)
        # queries are logged when there is time, and their events have that time
        assert self.house.engine.query_log.flush(60)
        return answer

    def disturb(self):
        """Change rows of every table that others number too."""
        if not self.busy:
            return
        shot = self.shots[4 + self.sent % 40]
        self.sent += 1
        self.ask("boss", "POST", "/v1/maps/bravo/frames", **shot.form(session="there"))
        self.ask("boss", "POST", "/v1/maps", json={"name": f"c{self.sent}", "model": "depth"})
        self.ask("boss", "DELETE", f"/v1/maps/c{self.sent}")
        self.ask("boss", "POST", "/v1/keys", json={"name": f"k{self.sent}"})
        frames = self.ask("boss", "GET", "/v1/maps/bravo/frames?limit=1").json()["items"]
        self.ask("boss", "DELETE", f"/v1/maps/bravo/frames/{frames[0]['frame_id']}")

    def answer_of(self, key, method, path, **request):
        """Return all that an answer tells, on lines."""
        answer = self.ask(key, method, path, **request)
        assert answer.status_code < 500, answer.text
        kept = {k: v for k, v in answer.headers.items() if k not in OWN_HEADERS}
        text = answer.content.decode("latin-1").replace(answer.headers["x-request-id"], "<request>")
        return f"{key} {method} {path}\n{answer.status_code} {json.dumps(kept)}\n{text}\n"


def live(one):
    """Fill alpha; in the busy service something else happens after each step."""
    for number, shot in enumerate(one.shots[:4]):
        form = shot.form(session="run", captured_at=f"2026-11-16T09:30:0{number}Z")
        sent = one.ask("boss", "PUT", f"{ALPHA}/frames/frame-{number}", **form)
        assert sent.status_code == 202, sent.text
        one.ids["job"] = sent.json()["job_id"]
        one.disturb()
    one.house.work()
    answer = one.ask("boss", "POST", f"{ALPHA}/queries", json={"frame_id": "frame-0"})
    one.ids["query"] = answer.json()["query_id"]
    one.disturb()
    begun = one.ask("boss", "POST", f"{ALPHA}/coverage", json={"not_within_s": 0})
    one.ids["coverage"] = begun.json()["job_id"]
    one.disturb()
    one.house.work()


def everything(one):
    """Yield what the keys for alpha can read, and answers to changes of alpha."""
    query = f"/v1/queries/{one.ids['query']}"
    for path in (
        "/v1/maps", "/v1/models", ALPHA, f"{ALPHA}/sessions", f"{ALPHA}/frames/frame-1",
        f"{ALPHA}/frames/frame-1/patches", f"{ALPHA}/trajectory?session=run",
        f"{ALPHA}/coverage/{one.ids['coverage']}", "/v1/queries", query, f"{query}/question",
        "/v1/stats", "/v1/stats?map=alpha", f"/v1/jobs/{one.ids['job']}", "/v1/jobs?state=queued",
        "/v1/events?map=alpha&kind=frame.", "/v1/events?after=0&limit=1000", "/v1/keys/me",
    ):  # fmt: skip
        yield one.answer_of("reader", "GET", path)
    for path in (f"{ALPHA}/frames?limit=3", f"{ALPHA}/frames?limit=2&order=desc",
                 f"{ALPHA}/coverage?limit=1", "/v1/jobs?limit=3", "/v1/events?limit=5",
                 "/v1/events?limit=5&order=oldest"):  # fmt: skip
        cursor = ""
        while cursor is not None:
            page = f"{path}{cursor and '&cursor='}{cursor}"
            yield one.answer_of("reader", "GET", page)
            cursor = one.ask("reader", "GET", page).json()["next_cursor"]
    frame = {"map": "alpha", "frame_id": "frame-0"}
    for method, path, body in (
        ("POST", f"{ALPHA}/queries", {"frame_id": "frame-2", "explain": True}),
        ("POST", "/v1/queries", {"maps": "*", "frame": frame}),
        ("PATCH", f"{ALPHA}/frames/frame-3", {"tags": ["x"]}),
        ("DELETE", f"{ALPHA}/frames/frame-3", None),
        ("POST", "/v1/maps", {"name": "bravo"}),
        ("GET", "/v1/events", None),
        ("GET", ALPHA, None),
        ("DELETE", ALPHA, None),
        ("GET", "/v1/events", None),
        ("GET", "/v1/jobs", None),
    ):  # fmt: skip
        yield one.answer_of("admin", method, path, **({} if body is None else {"json": body}))
        one.disturb()


def plain(texts):
    """Number random values in their order, and leave out times."""
    numbers = {}

    def number(match):
        return f"<{numbers.setdefault(match[0], len(numbers))}>"

    return [TOOK.sub("<took>", TIMES.sub("<time>", CHANCE.sub(number, text))) for text in texts]


@pytest.mark.thorough
def test_what_happens_in_other_maps_moves_nothing_that_is_told(
    tmp_path_factory, small_shots, open_house
):
    both = []
    with ExitStack() as stack:
        for busy in (False, True):
            folder = tmp_path_factory.mktemp("twin")
            house = stack.enter_context(open_house(folder, None, KEYS, events_per_map=1000))
            one = Twin(house, small_shots, busy)
            for name in ("bravo", "alpha"):
                one.ask("boss", "POST", "/v1/maps", json={"name": name, "model": "depth"})
                one.disturb()
            live(one)
            both.append(plain(list(everything(one))))
    quiet, busy = both
    for a, b in zip(quiet, busy, strict=True):
        assert a == b
    text = "".join(quiet)  # it is all there, else this would prove nothing
    for part in ("frame.indexed", "coverage.measured", "cursor=", '"frame_id":"frame-3"'):
        assert part in text, part
    assert "bravo" not in text.replace('{"name": "bravo"}', "").replace("a map named 'bravo'", "")
