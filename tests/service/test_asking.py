"""Tests of query options over HTTP in JSON, in forms and beside a bare frame."""

import json
import random

import pytest

OPTIONS = {
    "k": 2, "seed": 5, "candidates": 3, "diversity": {"sigma": 0.5},
    "validation": {"weak": 0.0, "mode": "full"}, "explain": True, "exact": True,
    "filter": {"robot": "r1"}, "keep": False, "stages": "retrieve,diversify,validate",
}  # fmt: skip
JUNK = [
    None, True, -1, 0, 1, 2**70, 1.5, 1e308, "", "x", "*", ",", "\x00", "a" * 300, "{}", "[1]",
    [], ["x"], [None], {}, {"x": 1}, {"map": "ask-a"}, {"map": "ask-a", "frame_id": "x"},
    {"sigma": -1}, {"mode": "none"}, "true", "1e3", ["retrieve"], [["retrieve"]], "é",
]  # fmt: skip


@pytest.fixture(scope="module")
def shots(small_shots):
    """Three views of each of two rooms."""
    return small_shots[::16]


@pytest.fixture(scope="module")
def maps(served, make_map, shots):
    """`ask-a` has two views of each of two rooms, `ask-b` one of each."""
    found = {}
    for name, views in (("ask-a", (0, 1, 3, 4)), ("ask-b", (0, 3))):
        path, found[name] = make_map(served, name), []
        for i in views:
            meta = {"session": f"room {i // 3}", "robot": "r1"}
            found[name].append(served.index(path, shots[i], **meta))
    return found


def told(answer, status=200):
    assert answer.status_code == status, answer.text
    found = answer.json()
    return {k: v for k, v in found.items() if k not in ("query_id", "milliseconds")}


def as_text(options):
    return {n: one if isinstance(one, str) else json.dumps(one) for n, one in options.items()}


def sent(served, path, shot, options, *, bare):
    """A frame with options: in a form, or as the body."""
    if bare:
        query = {**as_text(options), **{k: str(v) for k, v in shot.camera.items()}}
        return served.client.post(
            path, params=query, content=shot.png, headers={"Content-Type": "image/png"}
        )
    form = shot.form()
    form["data"] |= as_text(options)
    return served.client.post(path, **form)


def test_options_are_the_same_however_they_come(served, maps, shots):
    for path, more in (
        ("/v1/maps/ask-a/queries", {}),
        ("/v1/maps/ask-a/localize", {}),
        ("/v1/queries", {"maps": "ask-b,ask-a"}),
    ):
        one, two = (
            told(sent(served, path, shots[1], OPTIONS | more, bare=bare)) for bare in (False, True)
        )
        assert one == two
    assert one["maps"] == ["ask-b", "ask-a"]
    assert [len(one["explanations"]), one["counts"]["selected"], one["counts"]["map"]] == [6, 3, 6]
    assert one["matches"][0]["validation"]["strength"] == "weak"
    own = maps["ask-a"][1]
    by_text, by_json = (
        told(served.client.post("/v1/maps/ask-a/queries", json={"frame_id": own, **given}))
        for given in (as_text(OPTIONS), OPTIONS)
    )
    assert by_text == by_json
    assert by_json["frame"] == {"map": "ask-a", "frame_id": own}


def test_what_cannot_be_asked_is_refused(served, maps, shots, refused, make_map):
    make_map(served, "ask-paper", "paper")
    named = {"map": "ask-a", "frame_id": maps["ask-a"][0]}

    def refuse(path, body, status, kind, text):
        refused(served.client.post(path, json=body), status, kind, text)

    bad = (422, "invalid-request")
    query, several = "/v1/maps/ask-a/queries", "/v1/queries"
    for field, value in (
        ("candidates", 0), ("candidates", 201), ("deadline_ms", 0), ("diversity", {"sigma": 0}),
        ("diversity", "{"), ("validation", {"mode": "fast"}), ("validation", {"residual_m": -1}),
        ("validation", {"stiffness": 1}), ("explain_frame", ""), ("keep", "perhaps"),
    ):  # fmt: skip
        refuse(query, {"frame_id": maps["ask-a"][0], field: value}, *bad, field)
    refuse(query, {"k": 3}, *bad, "`frame_id`")
    matrix = [[float(i == j) for j in range(4)] for i in range(4)]
    pose, far = ({"matrix": [[1.0, 0.0, 0.0, x], *matrix[1:]], "parent_frame": "r1/room 0"}
                 for x in (0.0, 1e300))  # fmt: skip
    for prior, text in (
        ({"pose": pose, "deviation_m": 1e-200}, "greater than or equal to"),
        ({"pose": pose, "covariance": [0.0] * 36}, "prior"),
        ({"pose": far}, "prior"),
    ):
        refuse(query, {"frame_id": maps["ask-a"][0], "prior": prior}, *bad, text)
    refuse("/v1/maps/ask-a/localize", {"frame_id": "x", "stages": ["retrieve"]}, *bad, "validated")
    explained = {"frame_id": maps["ask-a"][0], "explain_frame": maps["ask-b"][0]}
    refuse(query, explained, 404, "unknown-frame", "in map 'ask-a'")
    refuse(several, {"maps": ["ask-a"]}, *bad, "`frame`")
    refuse(several, {"frame": named}, *bad, "maps")
    refuse(several, {"frame": named, "maps": []}, *bad, "maps")
    refuse(several, {"frame": named, "maps": ["m"] * 65}, *bad, "64")
    refuse(several, {"frame": named, "maps": ["ask-a", "ask-paper"]}, *bad, "ask-paper has paper-")
    refuse(several, {"frame": named, "maps": ["ask-a", "no"]}, 404, "unknown-map", "'no'")
    away = {"map": "no", "frame_id": "x"}
    refuse(several, {"frame": away, "maps": ["ask-a"]}, 404, "unknown-map", "'no'")
    same = "/v1/similarity"
    refuse(same, {"frame_a": named}, *bad, "'frame_b' is missing")
    refuse(same, {"frame_a": named, "frame_b": away}, 404, "unknown-map", "'no'")
    refuse(same, {"frame_a": named, "frame_b": named, "model": "paper"}, *bad, "Omit `model`")
    file = ("a.png", shots[0].png)
    for files, data, text in (
        ({"a": file}, {}, "frame_b"),
        ({"a": file, "b": file}, {}, "meta_a"),
        ({"a": file}, {"frame_a": json.dumps(named), "meta_a": "{}"}, "specified together with"),
        ({"a": file}, {"frame_b": json.dumps(named), "b": "text"}, "text instead of a file"),
        ({"b": file}, {"frame_a": json.dumps(named), "meta_a": "{}"}, "without a file"),
        ({"a": file, "b": file}, {"meta_a": "{}", "meta_b": "{}"}, "intrinsics"),
        ({"a": file}, {"frame_b": json.dumps(named), "speed": "1"}, "speed"),
    ):
        refused(served.client.post(same, files=files, data=data), 422, "invalid-request", text)
    form = {"frame_b": json.dumps(named), "meta_a": "{"}
    answer = served.client.post(same, files={"a": file}, data=form)
    refused(answer, 400, "malformed-body", "`meta_a` is not JSON")
    refused(served.client.post(same, content=b"[]", headers={"Content-Type": "application/json"}),
            400, "malformed-body")  # fmt: skip
    refused(served.client.post(same, content=b"x", headers={"Content-Type": "text/plain"}),
            415, "unsupported-type")  # fmt: skip


def test_no_body_breaks_a_route(served, maps):
    """Every answer is one that the document declares: `promised` looks."""
    rng, statuses = random.Random(0), set()
    named = {"map": "ask-a", "frame_id": maps["ask-a"][0]}
    fields = [*OPTIONS, "deadline_ms", "explain_frame", "frame", "maps", "frame_id", "frame_a",
              "frame_b", "validate", "model"]  # fmt: skip
    whole = {
        "/v1/maps/ask-a/queries": {"frame_id": maps["ask-a"][0]},
        "/v1/maps/ask-a/localize": {"frame_id": maps["ask-a"][0]},
        "/v1/queries": {"maps": ["ask-a", "ask-b"], "frame": named},
        "/v1/similarity": {"frame_a": named, "frame_b": named, "validate": False},
    }
    for _ in range(80):
        path = rng.choice([*whole])
        body = {**whole[path], "stages": ["retrieve"]} if "queries" in path else {**whole[path]}
        for field in rng.sample(fields, rng.randint(1, 3)):
            body[field] = rng.choice([*JUNK, OPTIONS.get(field)])
        answer = served.client.post(path, json=body)
        statuses.add(answer.status_code)
        assert answer.status_code in (200, 404, 422), (path, body, answer.text)
    assert statuses >= {422}


def test_an_answer_lists_its_stages_and_is_counted_but_its_frame_is_not_kept(served, maps, shots):
    def figure(name):
        lines = served.client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))

    path, counted = "/v1/maps/ask-a", 'sceneprint_answers_total{status="unvalidated"}'
    before, figures = served.client.get(path).json(), figure(counted)
    answer = sent(served, f"{path}/queries", shots[2], {"stages": "retrieve"}, bare=False)
    found = json.loads(answer.text, parse_constant=lambda text: pytest.fail(text))
    stages = ["prepare", "retrieve", "diversify", "validate", "total"]
    assert list(found["milliseconds"]) == stages
    *parts, total = found["milliseconds"].values()
    assert sum(parts) == pytest.approx(total, abs=0.05)
    assert min(parts) >= 0
    after = served.client.get(path).json()
    del before["recent_queries"], after["recent_queries"]  # they are counted a moment later
    assert after == before
    assert figure(counted) == figures + 1
    route = 'route="/v1/maps/{map_name}/queries",status="200"}'
    assert figure(f'sceneprint_requests_total{{method="POST",{route}') >= 1
    assert figure('sceneprint_frames{state="indexed"}') >= 4
