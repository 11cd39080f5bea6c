"""Tests of query options over HTTP in JSON, in forms and beside a bare frame."""

import json

import pytest

OPTIONS = {
    "k": 2, "seed": 5, "candidates": 3, "diversity": {"sigma": 0.5},
    "validation": {"weak": 0.0, "mode": "full"}, "explain": True, "exact": True,
    "filter": {"robot": "r1"}, "keep": False, "stages": "retrieve,diversify,validate",
}  # fmt: skip


@pytest.fixture(scope="module")
def shots(small_shots):
    """Three views of each of two rooms."""
    return small_shots[::16]


@pytest.fixture(scope="module")
def maps(served, make_map, shots):
    """`ask-a` has two views of each of two rooms, `ask-b` one of each."""
    results = {}
    for name, views in (("ask-a", (0, 1, 3, 4)), ("ask-b", (0, 3))):
        path, results[name] = make_map(served, name), []
        for i in views:
            meta = {"session": f"room {i // 3}", "robot": "r1"}
            results[name].append(served.index(path, shots[i], **meta))
    return results


def body(answer, status=200):
    assert answer.status_code == status, answer.text
    page = answer.json()
    return {k: v for k, v in page.items() if k not in ("query_id", "milliseconds")}


def as_text(options):
    return {n: o if isinstance(o, str) else json.dumps(o) for n, o in options.items()}


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
            body(sent(served, path, shots[1], OPTIONS | more, bare=bare)) for bare in (False, True)
        )
        assert one == two
    assert one["maps"] == ["ask-b", "ask-a"]
    assert [len(one["explanations"]), one["counts"]["selected"], one["counts"]["map"]] == [6, 3, 6]
    assert one["matches"][0]["validation"]["strength"] == "weak"
    own = maps["ask-a"][1]
    by_text, by_json = (
        body(served.client.post("/v1/maps/ask-a/queries", json={"frame_id": own, **options}))
        for options in (as_text(OPTIONS), OPTIONS)
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


def test_an_answer_lists_its_stages_and_is_counted_but_its_frame_is_not_kept(served, maps, shots):
    def figure(name):
        lines = served.client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))

    path, counted = "/v1/maps/ask-a", 'sceneprint_answers_total{status="unvalidated"}'
    before, figures = served.client.get(path).json(), figure(counted)
    answer = sent(served, f"{path}/queries", shots[2], {"stages": "retrieve"}, bare=False)
    page = json.loads(answer.text, parse_constant=lambda text: pytest.fail(text))
    stages = ["prepare", "retrieve", "diversify", "validate", "total"]
    assert list(page["milliseconds"]) == stages
    *parts, total = page["milliseconds"].values()
    assert sum(parts) == pytest.approx(total, abs=0.05)
    assert min(parts) >= 0
    after = served.client.get(path).json()
    del before["recent_queries"], after["recent_queries"]  # they are counted a moment later
    assert after == before
    assert figure(counted) == figures + 1
