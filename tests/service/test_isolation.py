"""Tests that a key for one map reveals nothing about other maps, for every operation.

For objects without permission the answer equals that for missing objects, except the request id
and the requested name. A route that is in no list of this file fails the test.
"""

import json
import re
import zlib
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

#: The key's own map, one that it may not see, and one that is not there: names of one length.
OWN, THEIRS, NONE = "alpha", "bravo", "zulus"
NO_ID = "0123456789abcdef0123456789abcdef"


@dataclass(frozen=True)
class Case:
    """A request that needs a scope; {map}, {frame}, {job} ... stand for what is asked about."""

    scope: str = "read"
    query: dict[str, str] = field(default_factory=dict)
    body: Any = None


FRAME = {"map": "{map}", "frame_id": "{frame}"}
PATHS = json.loads((Path(__file__).parents[1] / "golden" / "openapi.json").read_text())["paths"]
OF_A_MAP = {
    **{f"GET {path}": Case() for path in PATHS if "{" in path and "get" in PATHS[path]},
    "PATCH /v1/maps/{map_name}": Case("admin", body={"title": "x"}),
    "DELETE /v1/maps/{map_name}": Case("admin"),
    "POST /v1/maps": Case("admin", body={"name": "{map}"}),
    "POST /v1/maps/{map_name}/frames": Case("write"),
    "PUT /v1/maps/{map_name}/frames/{frame_id}": Case("write"),
    "POST /v1/maps/{map_name}/frames/batch": Case("write"),
    "POST /v1/maps/{map_name}/imports": Case("write"),
    "PATCH /v1/maps/{map_name}/frames/{frame_id}": Case("write", body={"tags": ["x"]}),
    "DELETE /v1/maps/{map_name}/frames/{frame_id}": Case("write"),
    "POST /v1/maps/{map_name}/frames/delete": Case("write", body={"frame_ids": ["{frame}"]}),
    "POST /v1/maps/{map_name}/frames/edit": Case(
        "write", body={"frame_ids": ["{frame}"], "add_tags": ["x"]}
    ),
    "POST /v1/maps/{map_name}/frames/{frame_id}/restore": Case("write"),
    "POST /v1/maps/{map_name}/deletions/{deletion_id}/restore": Case("write"),
    "POST /v1/maps/{map_name}/copy": Case(body={}),
    "PATCH /v1/maps/{map_name}/sessions": Case(
        "write", body={"add_tags": ["x"]}, query={"session": "{session}"}
    ),
    "DELETE /v1/maps/{map_name}/sessions": Case("write", query={"session": "{session}"}),
    "GET /v1/maps/{map_name}/trajectory": Case(query={"session": "{session}"}),
    "POST /v1/maps/{map_name}/queries": Case(body={"frame_id": "{frame}"}),
    "POST /v1/maps/{map_name}/localize": Case(body={"frame_id": "{frame}"}),
    "POST /v1/maps/{map_name}/localize/sequence": Case(),
    "POST /v1/queries": Case(body={"maps": [OWN, "{map}"], "frame": FRAME}),
    "POST /v1/similarity": Case(body={"frame_a": FRAME, "frame_b": FRAME}),
    "GET /v1/queries": Case(query={"map": "{map}"}),
    "DELETE /v1/queries": Case("admin", query={"map": "{map}"}),
    "PUT /v1/queries/{query_id}/keep": Case("write", body={}),
    "DELETE /v1/queries/{query_id}/keep": Case("write"),
    "POST /v1/queries/{query_id}/reconstruction": Case("write", body={}),
    "DELETE /v1/reconstructions/{job_id}": Case("write"),
    "POST /v1/maps/{map_name}/associations": Case("write", body={"sessions": ["{session}"]}),
    "DELETE /v1/maps/{map_name}/associations/{job_id}": Case("write"),
    "DELETE /v1/maps/{map_name}/associations/{job_id}/join": Case("write"),
    "POST /v1/maps/{map_name}/coverage": Case("write", body={"session": "{session}"}),
    "DELETE /v1/maps/{map_name}/coverage/{job_id}": Case("write"),
    "GET /v1/maps/{map_name}/coverage/{job_id}/changes": Case(query={"since": "{coverage}"}),
    "POST /v1/maps/{map_name}/differences": Case(
        "write", body={"before": "{session}", "after": "{session}-2"}
    ),
    "DELETE /v1/maps/{map_name}/differences/{job_id}": Case("write"),
    "POST /v1/maps/{map_name}/surface": Case("write"),
    "DELETE /v1/maps/{map_name}/surface": Case("write"),
    "GET /v1/maps/{map_name}/surface/frames": Case(query={"at": "0,0,0"}),
    "GET /v1/jobs": Case(query={"map": "{map}"}),
    "POST /v1/jobs/{job_id}/cancel": Case("write"),
    "POST /v1/jobs/{job_id}/retry": Case("write"),
    "POST /v1/jobs/retry": Case("write", query={"map": "{map}"}),
    "GET /v1/events": Case(query={"map": "{map}"}),
    "GET /v1/stats": Case(query={"map": "{map}"}),
    "POST /v1/maps/{map_name}/reencoding": Case("admin", body={"model": "depth"}),
    "DELETE /v1/maps/{map_name}/reencoding": Case("admin"),
}
#: In the key's own map, an id or session may be named as another map has it: it says nothing.
MADE_OF_ANYTHING = (
    "PUT /v1/maps/{map_name}/frames/{frame_id}", "POST /v1/maps/{map_name}/associations",
    "POST /v1/maps/{map_name}/coverage", "POST /v1/maps/{map_name}/differences",
    "POST /v1/maps/{map_name}/frames/delete", "POST /v1/maps/{map_name}/frames/edit",
    "POST /v1/maps/{map_name}/queries/records",
)  # fmt: skip
#: The operator's: 403 for who has a map, whatever is asked for.
OF_ALL = (
    "GET /v1/keys", "POST /v1/keys", "DELETE /v1/keys/{key_name}", "GET /v1/audit", "GET /metrics",
    "POST /v1/keys/{key_name}/rotate",
)  # fmt: skip
#: Answered to anybody with a key, and by what the key may read.
BY_KEY = (
    "GET /v1/maps", "GET /v1/models", "GET /v1/keys/me", "GET /v1/jobs", "GET /v1/events",
    "GET /v1/queries",
)  # fmt: skip
#: Answered without a key.
OF_NOBODY = ("GET /healthz", "GET /readyz")


@dataclass(frozen=True)
class There:
    """What there is of a map; where there is no such map, ids that nothing has."""

    map: str
    frame: str
    query: str
    job: str
    association: str
    reconstruction: str
    coverage: str
    difference: str
    tile: str
    session: str
    artifact: str

    def of(self, operation, what):
        """The id that a part of a path stands for."""
        kinds = {
            "associations": self.association, "reconstructions": self.reconstruction,
            "coverage": self.coverage, "differences": self.difference,
        }  # fmt: skip
        jobs = [one for kind, one in kinds.items() if f"/{kind}" in operation]
        return {
            "map_name": self.map, "frame_id": self.frame, "query_id": self.query,
            "deletion_id": "1", "job_id": (jobs or [self.job])[0], "key_name": "keeper",
            "digest": self.artifact if "/artifacts/" in operation else self.tile,
        }[what]  # fmt: skip

    def fill(self, text):
        return (
            text.replace("{map}", self.map).replace("{frame}", self.frame)
            .replace("{session}", self.session).replace("{coverage}", self.coverage)
        )  # fmt: skip

    @property
    def ids(self):
        return [value for name, value in vars(self).items() if name != "session"]


@pytest.fixture(scope="module")
def there(walled, small_shots, until):
    """Two maps with three frames each, and of each an answer and a job of every kind."""
    results = {}
    for name, some in ((OWN, small_shots[:3]), (THEIRS, small_shots[1:4])):
        created = walled.ask("boss", "POST", "/v1/maps", json={"name": name, "model": "depth"})
        assert created.status_code == 201
        session = f"run-of-{name}"
        sent = [
            walled.ask(
                "boss", "POST", f"/v1/maps/{name}/frames", headers={"Prefer": "wait=200"},
                **shot.form(
                    session=session if number < 2 else f"{session}-2",
                    captured_at=f"2026-11-16T09:30:0{number}Z",
                    pose={
                        "parent_frame": name, "translation": {"x": number, "y": 0, "z": 0},
                        "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
                    },
                ),
            ).json()
            for number, shot in enumerate(some)
        ]  # fmt: skip
        assert [row["state"] for row in sent] == ["indexed"] * 3
        frame = sent[0]["frame_id"]
        answer = walled.ask("boss", "POST", f"/v1/maps/{name}/queries", json={"frame_id": frame})
        query = answer.json()["query_id"]
        begun = {
            path: walled.ask("boss", "POST", path, json=body)
            for path, body in (
                (f"/v1/maps/{name}/associations", {"sessions": [session], "apart": 1}),
                (f"/v1/queries/{query}/reconstruction", {}),
                (f"/v1/maps/{name}/coverage", {}),
                (f"/v1/maps/{name}/differences", {"before": session, "after": f"{session}-2"}),
                (f"/v1/maps/{name}/surface", {}),
            )
        }
        assert {one.status_code for one in begun.values()} == {202}
        surface = f"/v1/maps/{name}/surface"
        until(lambda at=surface: walled.ask("boss", "GET", at).json()["state"] == "ready")
        tiles = walled.ask("boss", "GET", f"{surface}/tiles").json()["items"]
        jobs = [one.headers["location"].rpartition("/")[2] for one in list(begun.values())[:4]]
        alone = sent[0 if name == OWN else 2]["frame_id"]  # the other map has not its content
        names, *rows = copied(walled, "boss", name)
        row = next(row for row in rows if row[0] == alone)
        results[name] = There(
            name, frame, query, sent[0]["job_id"], *jobs, tiles[0]["digest"], session,
            row[names.index("geometry")],
        )  # fmt: skip
    results[NONE] = There(NONE, *[NO_ID] * 8, f"run-of-{NONE}", "0" * 64)
    return results


def copied(walled, key, name):
    """The lines of the one part of a map's copy: names, and a row for each frame."""
    answer = walled.ask(key, "POST", f"/v1/maps/{name}/copy", json={})
    _, _, data = answer.content.partition(b"\n")
    return [json.loads(line) for line in zlib.decompress(data).split(b"\n")]


@pytest.fixture(scope="module")
def operations(walled):
    """Each operation of the document by its method and path."""
    document = walled.server.client.get("/openapi.json").json()
    return {
        f"{method.upper()} {path}": operation
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    }


def request_of(operation, case, path, rest):
    """Arguments of a request: the map of the path is of one, all other ids of another."""

    def part(match):
        return (path if match[1] == "map_name" else rest).of(operation, match[1])

    method, pattern = operation.split()
    request = {"method": method, "path": re.sub(r"\{(\w+)\}", part, pattern)}
    if case.query:
        request["params"] = {name: rest.fill(value) for name, value in case.query.items()}
    if case.body is not None:
        request["content"] = rest.fill(json.dumps(case.body))
        request["headers"] = {"Content-Type": "application/json"}
    return request


def answers_of(answer, about):
    """All that an answer tells, but for what was asked for and the request's own id."""

    def blank(text):
        text = text.replace(answer.headers["x-request-id"], "<request>")
        for one in (*about.ids, about.session):
            text = text.replace(one, "<asked>")
        return text

    own = ("date", "x-request-id")
    headers = {name: blank(text) for name, text in answer.headers.items() if name not in own}
    return answer.status_code, headers, blank(answer.text)


def test_every_operation_is_in_a_list(operations):
    known = {*OF_A_MAP, *OF_ALL, *BY_KEY, *OF_NOBODY}
    assert set(operations) - known == set()  # say in this file what a key may learn by it
    assert known - set(operations) == set()


@pytest.mark.parametrize(
    ("operation", "key"),
    [
        (name, key)
        for name, case in OF_A_MAP.items()
        for key in (("reader",) if case.scope == "read" else ("admin", "reader"))
    ],
)
def test_what_is_anothers_is_answered_as_what_is_not_there(walled, there, operation, key):
    case, requests = OF_A_MAP[operation], 0
    for path in ([THEIRS, NONE], [OWN, OWN]):
        if path[0] == OWN and not re.search(r"\{(?!map_name)\w+\}", operation + str(case.body)):
            continue  # nothing but the map is named
        if path[0] == OWN and "{map_name}" not in operation:
            continue
        answers = []
        for of_path, rest in zip(path, (THEIRS, NONE), strict=True):
            request = request_of(operation, case, there[of_path], there[rest])
            answers.append((walled.ask(key, **request), there[rest]))
        (theirs, about), (none, nothing) = answers
        assert answers_of(theirs, about) == answers_of(none, nothing), operation
        requests += 1
        if path[0] == OWN and key == "admin" and operation in MADE_OF_ANYTHING:
            continue
        assert theirs.status_code in (403, 404), (operation, theirs.text)
        if operation != "POST /v1/maps" and (key == "admin" or path[0] == THEIRS):
            assert theirs.status_code == 404, (operation, theirs.text)
    assert requests


def test_its_own_is_there_all_the_same(walled, there):
    """Else the test above would prove nothing."""
    own = there[OWN]
    for operation in (one for one in OF_A_MAP if one.startswith("GET") and "imports" not in one):
        answer = walled.ask("reader", **request_of(operation, OF_A_MAP[operation], own, own))
        expected = (200, 409) if "job_id" in operation or "matches" in operation else (200,)
        if "/matches/" in operation:
            expected = (200, 404)  # a frame does not find itself
        assert answer.status_code in expected, (operation, answer.text)


def test_lists_have_nothing_of_another_map(walled, there, operations):
    listed = ["/v1/maps", "/v1/models", "/v1/keys/me", "/v1/jobs?limit=1000",
              "/v1/events?limit=1000",
              f"/v1/stats?map={OWN}", f"/v1/jobs?map={OWN}", f"/v1/events?map={OWN}",
              "/v1/jobs?kind=associate", "/v1/jobs?kind=reconstruct", "/readyz", "/openapi.json",
              f"/v1/maps/{OWN}/associations", f"/v1/maps/{OWN}/coverage",
              f"/v1/maps/{OWN}/differences",
              f"/v1/maps/{OWN}/surface", f"/v1/maps/{OWN}/surface/tiles",
              f"/v1/maps/{OWN}/sessions"]  # fmt: skip
    for path in listed:
        for key in ("admin", "reader"):
            answer = walled.ask(key, "GET", path)
            assert answer.status_code == 200, answer.text
            text = answer.text + str(answer.headers)
            assert [
                one for one in (*there[THEIRS].ids, "keeper", "boss", "watcher") if one in text
            ] == [], path
    assert len(rows := copied(walled, "reader", OWN)) > 1
    assert not [frame_id for frame_id in there[THEIRS].ids if frame_id in str(rows)]
    mine = walled.ask("reader", "GET", "/v1/maps").json()["items"]
    assert [one["name"] for one in mine] == [OWN]
    jobs = walled.ask("reader", "GET", "/v1/jobs?limit=1000").json()["items"]
    assert {job["map"] for job in jobs} == {OWN}
    # three frames, an association, a reconstruction, a coverage, a difference, a surface
    assert len(jobs) == 8
    events = walled.ask("reader", "GET", "/v1/events?limit=1000").json()["items"]
    assert {event["map"] for event in events} == {OWN}


def test_asking_all_maps_asks_those_that_the_key_may_read(walled, there):
    body = {"maps": "*", "frame": {"map": OWN, "frame_id": there[OWN].frame}}
    answer = walled.ask("reader", "POST", "/v1/queries", json=body).json()
    assert {match["map"] for match in answer["matches"]} == {OWN}
    assert THEIRS not in json.dumps(answer)
    body = {"query_id": answer["query_id"], "maps": "*"}
    again = walled.ask("reader", "POST", "/v1/queries", json=body).json()
    assert again["matches"] == answer["matches"]
    assert THEIRS not in json.dumps(again)
    refused = [
        walled.ask("reader", "POST", "/v1/queries", json=body | {"maps": [OWN, name]})
        for name in (THEIRS, NONE)
    ]
    assert answers_of(refused[0], there[THEIRS]) == answers_of(refused[1], there[NONE])
    assert refused[0].status_code == 404


def test_an_answer_over_two_maps_is_for_who_may_read_both(walled, there):
    """And so is what is made of it."""
    frame = {"map": OWN, "frame_id": there[OWN].frame}
    answer = walled.ask("boss", "POST", "/v1/queries", json={"maps": [OWN, THEIRS], "frame": frame})
    assert answer.status_code == 200, answer.text
    mixed = answer.json()["query_id"]
    assert {match["map"] for match in answer.json()["matches"]} == {OWN, THEIRS}
    assert walled.ask("watcher", "GET", f"/v1/queries/{mixed}").status_code == 200
    theirs = {"map": THEIRS, "frame_id": there[THEIRS].frame}
    answer = walled.ask("boss", "POST", "/v1/queries", json={"maps": [OWN], "frame": theirs})
    unseen(walled, "GET", "/v1/queries/{}", answer.json()["query_id"])
    match = f"/matches/{there[OWN].frame}"
    for end in (
        "", "/cloud.ply", "/similarities", "/points", "/question", "/preview.png", match,
        f"{match}/points",
    ):  # fmt: skip
        unseen(walled, "GET", "/v1/queries/{}" + end, mixed)
    unseen(walled, "POST", "/v1/queries/{}/reconstruction", mixed)
    again = [
        walled.ask("admin", "POST", "/v1/queries", json={"maps": [OWN], "query_id": one})
        for one in (mixed, "0" * 32)
    ]
    assert [answer.json()["detail"].replace(mixed, "0" * 32) for answer in again] \
        == [again[1].json()["detail"]] * 2  # fmt: skip
    assert [answer.status_code for answer in again] == [404, 404]
    record = walled.ask("boss", "PUT", f"/v1/queries/{mixed}/keep", json={"title": "secret"})
    assert record.status_code == 200
    for method in ("PUT", "DELETE"):
        unseen(walled, method, "/v1/queries/{}/keep", mixed)
    for path in ("/v1/queries?kept=true", f"/v1/queries?kept=true&map={OWN}"):
        for item in walled.ask("admin", "GET", path).json()["items"]:
            assert (item["maps"], item["title"]) == ([OWN], None)
        assert mixed in walled.ask("boss", "GET", path).text, path
    fused = walled.ask("boss", "POST", f"/v1/queries/{mixed}/reconstruction", json={})
    assert fused.status_code == 202, fused.text
    job = fused.json()["job_id"]
    for path in ("/v1/jobs/{}", "/v1/reconstructions/{}", "/v1/reconstructions/{}/mesh.ply"):
        unseen(walled, "GET", path, job)
    for path in ("/v1/jobs/{}/cancel", "/v1/jobs/{}/retry"):
        unseen(walled, "POST", path, job)
    unseen(walled, "DELETE", "/v1/reconstructions/{}", job)
    for path in ("/v1/jobs?limit=1000", f"/v1/jobs?map={OWN}", "/v1/events?limit=1000"):
        assert job not in walled.ask("admin", "GET", path).text, path


def unseen(walled, method, path, id_):
    """See that an id is to the key as one that nothing has."""
    answers = [
        (walled.ask("admin", method, path.format(one)), There("-", "-", one, *"--------"))
        for one in (id_, NO_ID)
    ]
    assert answers_of(*answers[0]) == answers_of(*answers[1])
    assert answers[0][0].status_code == 404, (path, answers[0][0].text)


def test_what_is_anothers_beside_what_is_the_keys_own(walled, there):
    """Frames of two maps in one request: the one that is not the key's is not there."""
    own = {"map": OWN, "frame_id": there[OWN].frame}
    fused = f"/v1/queries/{there[OWN].query}/reconstruction"
    for path, body in (
        ("/v1/queries", {"maps": [OWN], "frame": FRAME}),
        ("/v1/queries", {"maps": "*", "frame": FRAME}),
        ("/v1/similarity", {"frame_a": own, "frame_b": FRAME}),
        ("/v1/similarity", {"frame_a": FRAME, "frame_b": own}),
        (f"/v1/maps/{OWN}/queries", {"frame_id": own["frame_id"], "explain_frame": "{frame}",
                                     "stages": "retrieve"}),
        (fused, {"frames": ["{frame}"]}),
    ):  # fmt: skip
        answers = []
        for one in (there[THEIRS], there[NONE]):
            content = one.fill(json.dumps(body))
            request = {"content": content, "headers": {"Content-Type": "application/json"}}
            answers.append(answers_of(walled.ask("admin", "POST", path, **request), one))
        if answers[0][0] == 200:  # an answer of its own map, with what becomes of the other frame
            texts = [json.loads(text) for _, _, text in answers]
            assert texts[0]["explanation"] == texts[1]["explanation"]
        else:
            assert answers[0] == answers[1], path


@pytest.mark.parametrize("operation", OF_ALL)
def test_what_is_the_operators_is_nobody_elses(walled, there, refused, operation):
    for key in ("admin", "reader"):
        request = request_of(operation, Case(), there[THEIRS], there[THEIRS])
        refused(walled.ask(key, **request), 403, "forbidden", "for all maps")


def test_a_key_may_not_more_than_its_scope(walled, there, refused):
    less = {"write": ["reader"], "admin": ["reader", "writer"]}
    own = there[OWN]
    for operation, case in OF_A_MAP.items():
        for key in less.get(case.scope, []):
            request = request_of(operation, case, own, own)
            if operation == "POST /v1/maps":
                request["content"] = json.dumps({"name": OWN})
            answer = walled.ask(key, **request)
            if "imports" in operation and answer.status_code == 404:
                continue
            refused(answer, 403, "forbidden", f"{case.scope!r}")
    assert walled.ask("reader", "GET", f"/v1/maps/{OWN}").json()["title"] is None


def test_without_a_key_no_body_is_waited_for(walled, there, operations):
    """Each operation below /v1 is refused as soon as its head has come."""
    with ExitStack() as opened:
        wires = {}
        for operation in operations.keys() - set(OF_NOBODY):
            request = request_of(operation, Case(), there[OWN], there[OWN])
            head = f"{request['method']} {request['path']} HTTP/1.1\r\nHost: localhost\r\n"
            if "requestBody" in operations[operation]:
                head += "Content-Type: application/json\r\nContent-Length: 99\r\n"
            wires[operation] = opened.enter_context(walled.server.connect())
            wires[operation].sendall(f"{head}\r\n".encode())
        for operation, wire in wires.items():
            assert wire.recv(12) == b"HTTP/1.1 401", operation
