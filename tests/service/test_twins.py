"""Tests that activity in other maps is invisible to a key for one map.

Two stores have the same map, and one has many changes in other maps. The answers must be equal
except times and random values. A third store uses another database.
"""

from __future__ import annotations

import json
import re
import secrets
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

import pytest

KEYS = {
    "boss": {"*": "admin"}, "admin": {"alpha": "admin"}, "reader": {"alpha": "read"},
}  # fmt: skip
#: Ids and seals, the beginnings of ids in names of files, and cursors; times; how long something
#: took, and in which minutes it was.
CHANCE = re.compile(
    r'\b[0-9a-f]{32}(?:[0-9a-f]{16})?\b|(?<=[-"])[0-9a-f]{12}(?=[-.])'
    r'|(?<="next_cursor":")[0-9a-f]{64}(?=")'
)
TIMES = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)")
TOOK = re.compile(
    r'"milliseconds":(?:{[^}]*}|[\d.e-]+)|"oldest_waiting_s":{[^}]*}|"(minutes|buckets)":\[[^]]*\]'
)
OWN_HEADERS = ("date", "x-request-id", "content-length")


@dataclass
class Twin:
    """One of them: a service, and what happens in it.

    Parameters
    ----------
    house : the service
    shots : frames to send
    busy : whether much happens beside `alpha`
    """

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
        """What would show, if anything of it did: rows of every table that others number too."""
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

    def told(self, key, method, path, **request):
        """All that an answer tells, on lines."""
        answer = self.ask(key, method, path, **request)
        assert answer.status_code < 500, answer.text
        kept = {k: v for k, v in answer.headers.items() if k not in OWN_HEADERS}
        text = answer.content.decode("latin-1").replace(answer.headers["x-request-id"], "<request>")
        return f"{key} {method} {path}\n{answer.status_code} {json.dumps(kept)}\n{text}\n"


def live(one, small_model):
    """What happens in alpha, and in the busy one always something else before and after."""
    path = "/v1/maps/alpha"
    for number, shot in enumerate(one.shots[:5]):
        session = "run" if number < 4 else "run-2"
        form = shot.form(session=session, captured_at=f"2026-11-16T09:30:0{number}Z", pose={
            "parent_frame": "hall", "translation": {"x": number, "y": 0, "z": 0},
            "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
        })  # fmt: skip
        sent = one.ask("boss", "PUT", f"{path}/frames/frame-{number}", **form)
        assert sent.status_code == 202, sent.text
        one.ids["job_id"] = sent.json()["job_id"]
        one.disturb()
    one.house.work()
    if one.busy:  # a model that no other map has, and jobs for it
        one.house.engine.reencode("bravo", small_model)
    asked = one.ask("boss", "POST", f"{path}/queries", json={"frame_id": "frame-0"})
    one.ids["query_id"] = asked.json()["query_id"]
    one.disturb()
    body = {"sessions": ["run"], "apart": 1}
    for _ in range(2):
        begun = one.ask("boss", "POST", f"{path}/associations", json=body)
        assert begun.status_code == 202, begun.text
        one.ids["association"] = begun.json()["job_id"]
        one.disturb()
    for _ in range(2):
        measured = one.ask("boss", "POST", f"{path}/coverage", json={"not_within_s": 0})
        assert measured.status_code == 202, measured.text
        one.ids["coverage"] = measured.json()["job_id"]
        one.disturb()
    body = {"before": "run", "after": "run-2"}
    compared = one.ask("boss", "POST", f"{path}/differences", json=body)
    assert compared.status_code == 202, compared.text
    one.ids["difference"] = compared.json()["job_id"]
    one.disturb()
    built = one.ask("boss", "POST", f"{path}/surface")
    assert built.status_code == 202, built.text
    one.disturb()
    one.house.work()
    tiles = one.ask("boss", "GET", f"{path}/surface/tiles").json()["items"]
    one.ids["digest"] = tiles[0]["digest"]
    fused = one.ask("boss", "POST", f"/v1/queries/{one.ids['query_id']}/reconstruction", json={})
    one.ids["reconstruction"] = fused.json()["job_id"]
    one.disturb()


def path_of(one, pattern):
    """A path of the document, about what there is in alpha."""
    paths = {"association": "associations", "reconstruction": "reconstructions",
             "coverage": "coverage", "difference": "differences"}  # fmt: skip
    kinds = [kind for kind, path in paths.items() if f"/{path}/" in pattern]
    names = {
        "map_name": "alpha", "frame_id": "frame-1", "query_id": one.ids["query_id"],
        "job_id": one.ids[kinds[0] if kinds else "job_id"], "key_name": "k2",
        "digest": one.ids["digest"],
    }  # fmt: skip
    return re.sub(r"\{(\w+)\}", lambda found: names[found[1]], pattern)


def everything(one):
    """All that the keys for alpha can read, and what changes of alpha are answered with."""
    document = one.ask("boss", "GET", "/openapi.json").json()
    queries = {
        "/v1/maps/{map_name}/trajectory": ["?session=run"], "/v1/stats": ["", "?map=alpha"],
        "/v1/jobs": ["", "?map=alpha", "?state=queued", "?kind=associate"],
        "/v1/events": ["?order=oldest", "?map=alpha&kind=frame.", "?after=0&limit=1000"],
        "/v1/queries/{query_id}/matches/{frame_id}": ["", "?detail=true"],
        "/v1/maps/{map_name}/surface/frames": ["?at=1,0,2&radius=3", "?box=-9,-9,-9,9,9,9&limit=1"],
        "/v1/maps/{map_name}/coverage/{job_id}/changes": [f"?since={one.ids['coverage']}"],
    }  # fmt: skip
    for pattern, methods in sorted(document["paths"].items()):
        if "get" in methods:
            for query in queries.get(pattern, [""]):
                yield one.told("reader", "GET", path_of(one, pattern) + query)
    for path in ("frames?limit=3", "frames?limit=2&order=desc", "associations?limit=1",
                 "coverage?limit=1", "differences?limit=1",
                 "jobs?limit=3", "events?limit=5", "events?limit=5&order=oldest"):  # fmt: skip
        path = path if path.startswith(("jobs", "events")) else f"maps/alpha/{path}"
        cursor = ""
        while cursor is not None:
            page = f"/v1/{path}{cursor and '&cursor='}{cursor}"
            yield one.told("reader", "GET", page)
            cursor = one.ask("reader", "GET", page).json()["next_cursor"]
    frame = {"map": "alpha", "frame_id": "frame-0"}
    for method, path, body in (
        ("POST", "/v1/maps/alpha/queries", {"frame_id": "frame-2", "explain": True}),
        ("POST", "/v1/maps/alpha/localize", {"frame_id": "frame-2"}),
        ("POST", "/v1/queries", {"maps": "*", "frame": frame}),
        ("POST", "/v1/similarity", {"frame_a": frame, "frame_b": frame}),
        ("POST", f"/v1/jobs/{one.ids['reconstruction']}/cancel", None),
        ("POST", f"/v1/jobs/{one.ids['reconstruction']}/retry", None),
        ("PATCH", "/v1/maps/alpha/frames/frame-3", {"tags": ["x"]}),
        ("DELETE", "/v1/maps/alpha/frames/frame-3", None),
        ("DELETE", f"/v1/maps/alpha/associations/{one.ids['association']}", None),
        ("DELETE", f"/v1/maps/alpha/coverage/{one.ids['coverage']}", None),
        ("DELETE", f"/v1/maps/alpha/differences/{one.ids['difference']}", None),
        ("DELETE", "/v1/maps/alpha/surface", None),
        ("POST", "/v1/maps", {"name": "bravo"}),
        ("GET", "/v1/events", None),
        ("GET", "/v1/maps/alpha", None),
        ("DELETE", "/v1/maps/alpha", None),
        ("GET", "/v1/events", None),
        ("GET", "/v1/jobs", None),
    ):  # fmt: skip
        yield one.told("admin", method, path, **({} if body is None else {"json": body}))
        one.disturb()


def plain(told):
    """Without times, and with what is by chance numbered as it first came."""
    numbers = {}

    def number(found):
        return f"<{numbers.setdefault(found[0], len(numbers))}>"

    return [TOOK.sub("<took>", TIMES.sub("<time>", CHANCE.sub(number, one))) for one in told]


@pytest.fixture(scope="module")
def both(tmp_path_factory, small_shots, small_model, postgres, open_house):
    """All that is told, of the quiet one, the busy one, and a busy one on PostgreSQL."""
    found = []
    server = postgres.create(f"twin{secrets.token_hex(6)}")
    with ExitStack() as stack:
        for busy, url in ((False, None), (True, None), (True, server)):
            folder = tmp_path_factory.mktemp("twin")
            house = stack.enter_context(open_house(folder, url, KEYS, events_per_map=1000))
            one = Twin(house, small_shots, busy)
            for name in ("bravo", "alpha"):
                one.ask("boss", "POST", "/v1/maps", json={"name": name, "model": "depth"})
                one.disturb()
            live(one, small_model)
            found.append(plain(list(everything(one))))
    return found


@pytest.mark.thorough
def test_what_happens_in_other_maps_moves_nothing_that_is_told(both):
    quiet, busy, server = both
    assert len(quiet) > 60
    for a, b, c in zip(quiet, busy, server, strict=True):
        assert a == b
        assert a == c


@pytest.mark.thorough
def test_it_is_all_there(both):
    """Else the test above would prove nothing."""
    text = "".join(both[0])
    # the frames' poses contradict what they show, so that their matches disagree
    for part in ("frame.indexed", "association.found", "coverage.measured", "difference.found",
                 "surface.updated",
                 "cursor=",
                 '"status":"ambiguous"',
                 "end_header",
                 '"frame_id":"frame-3"', "POST /v1/similarity\n200", "VERTEX_SE3"):  # fmt: skip
        assert part in text, part
    assert "bravo" not in text.replace('{"name": "bravo"}', "").replace("a map named 'bravo'", "")
