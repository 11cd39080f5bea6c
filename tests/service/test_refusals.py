"""Tests of rejected requests and their problem documents, as a table."""

import json

import numpy as np
import pytest

from sceneprint.formats.depth_file import encode_npy, encode_png

JSON = {"content-type": "application/json"}


@pytest.fixture(scope="module")
def hall(served, make_map):
    return make_map(served, "refusals")


ZERO = encode_png(np.zeros((120, 160), np.uint16))

#: bytes of the file -> type of the problem, text that the detail holds
FILES = {
    "empty": (b"", "unreadable-frame", "empty"),
    "missing": (ZERO, "useless-frame", "All 19200 samples are missing"),
    "other size": (encode_npy(np.ones((120, 159), np.float32)), "invalid-intrinsics", "159 x 120"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_no_depth_image_is_refused(served, hall, small_shots, refused, name):
    data, kind, text = FILES[name]
    for route in ("frames", "queries"):
        form = small_shots[0].form() | {"files": {"frame": ("a", data)}}
        refused(served.client.post(f"{hall}/{route}", **form), 422, kind, text)
    assert served.client.get(f"{hall}/frames").json()["items"] == []


TURN = {"x": 0, "y": 0, "z": 0}
SKEW = [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

#: what is other in `meta` -> type of the problem, text of its detail, fields at fault
META = {
    "unknown": ({"colour": 1}, "invalid-request", "colour: Extra", ["colour"]),
    "scale": ({"depth_scale": 1e300}, "useless-frame", "are missing", []),
    "no parent": ({"pose": {"matrix": np.eye(4).tolist()}}, "invalid-request",
                  "parent_frame", [""]),
    "not rigid": ({"pose": {"parent_frame": "w", "matrix": SKEW}}, "invalid-pose", "rigid", []),
    "quaternion": ({"pose": {"parent_frame": "w", "translation": TURN,
                             "rotation": {**TURN, "w": 2}}}, "invalid-pose", "length 2", []),
    "four errors": ({"a": 1, "b": 1, "c": 1, "d": 1}, "invalid-request", "(and 1 more)",
                    ["a", "b", "c", "d"]),
}  # fmt: skip


@pytest.mark.parametrize("name", META)
def test_metadata_that_cannot_be_is_refused(served, hall, small_shots, refused, name):
    other, kind, text, fields = META[name]
    for route in ("frames", "queries"):
        answer = served.client.post(f"{hall}/{route}", **small_shots[0].form(**other))
        problem = refused(answer, 422, kind, text)
        assert [error["field"] for error in problem.get("errors", [])] == fields


@pytest.mark.parametrize(
    ("field", "value", "kind"),
    [
        ("fx", "-5", "invalid-intrinsics"), ("fx", "NaN", "invalid-request"),
        ("cx", "Infinity", "invalid-request"), ("fx", "1e999", "invalid-request"),
        ("fx", "1e300", "invalid-intrinsics"), ("width", "161", "invalid-intrinsics"),
    ],
)  # fmt: skip
def test_a_camera_that_is_none_is_refused(served, hall, small_shots, refused, field, value, kind):
    form = small_shots[0].form()
    camera = ", ".join(
        f'"{key}": {value if key == field else known}'
        for key, known in small_shots[0].camera.items()
    )
    form["data"]["meta"] = f'{{"intrinsics": {{{camera}}}}}'
    problem = refused(served.client.post(f"{hall}/frames", **form), 422, kind)
    fields = [error["field"] for error in problem.get("errors", [])]
    assert fields == ([f"intrinsics.{field}"] if kind == "invalid-request" else [])


#: content of a query that is no form -> status, type, text
BODIES = {
    b"": (400, "malformed-body", "The body is empty."), b"{": (400, "malformed-body", "not JSON"),
    b'{"frame_id": "\\ud800"}': (400, "malformed-body", "not JSON"),
    b"[" * 5000: (400, "malformed-body", "not JSON"),
    b" " * (1 << 18) + b" ": (413, "too-large", "the limit of 262144 bytes"),
    b"{}": (422, "invalid-request", "has no frame"),
    b'{"frame_id": "a", "k": 0}': (422, "invalid-request", "k: "),
    b'{"frame_id": "a", "stages": "retrieve"}': (404, "unknown-frame", ""),
    b'{"frame_id": "a", "stages": "fly, retrieve"}': (
        422, "invalid-request", "stages.0: Input should be 'retrieve', 'diversify' or 'validate'."),
    b'{"frame_id": "a", "stages": "validate"}': (422, "invalid-request", "stages: "),
    b'{"frame_id": "a", "fly": 1}': (422, "invalid-request", "fly: "),
    b'{"frame_id": "../a\\u0000"}': (404, "unknown-frame", ""),
}  # fmt: skip


@pytest.mark.parametrize("number", range(len(BODIES)))
def test_json_that_asks_nothing_is_refused(served, hall, refused, number):
    content, (status, kind, text) = list(BODIES.items())[number]
    answer = served.client.post(f"{hall}/queries", content=content, headers=JSON)
    refused(answer, status, kind, text)
    assert "tuple" not in answer.text  # callers need not know Python


@pytest.mark.parametrize(
    ("content", "headers", "status", "kind"),
    [
        (b"{", JSON, 400, "malformed-body"), (b'{"name": "\xff"}', JSON, 400, "malformed-body"),
        (b'{"name": "a", "title": "\\ud800"}', JSON, 400, "malformed-body"),
        (b"", JSON, 400, "malformed-body"), (b" " * (1 << 18) + b" ", JSON, 413, "too-large"),
        (b'{"name": "a", "model": "big"}', JSON, 422, "invalid-request"),
        (b'{"name": "a"}', {}, 415, "unsupported-type"), (b"", {}, 415, "unsupported-type"),
    ],
)  # fmt: skip
def test_a_map_that_cannot_be_is_refused(served, refused, content, headers, status, kind):
    refused(served.client.post("/v1/maps", content=content, headers=headers), status, kind)


@pytest.mark.parametrize(
    ("method", "path", "status", "kind", "allow"),
    [
        ("GET", "/v1/maps/nowhere", 404, "unknown-map", None),
        ("GET", "/v1/maps/nowhere/frames", 404, "unknown-map", None),
        ("GET", "/v1/maps/refusals/frames/nobody", 404, "unknown-frame", None),
        ("DELETE", "/v1/maps/refusals/frames/nobody", 404, "unknown-frame", None),
        ("GET", "/v1/jobs/nothing", 404, "unknown-job", None),
        ("GET", "/v1/maps/%2e%2e", 404, "unknown-map", None),
        ("GET", "/v1/maps/%2e%2e%2fx", 404, "not-found", None),
        ("GET", "/v1/maps/%00", 404, "unknown-map", None),
        ("GET", "/v1/maps/" + "a" * 5000, 404, "unknown-map", None),
        ("GET", "/", 404, "not-found", None), ("GET", "/v2/maps", 404, "not-found", None),
        ("GET", "/v1/maps/", 404, "not-found", None),
        ("PUT", "/v1/maps", 405, "method-not-allowed", "GET, POST"),
        ("POST", "/v1/maps/refusals", 405, "method-not-allowed", "DELETE, GET, PATCH"),
        ("BREW", "/healthz", 405, "method-not-allowed", "GET"),
        ("PUT", "/v1/keys/me", 405, "method-not-allowed", "GET"),  # not those of a key's name
    ],
)  # fmt: skip
def test_what_is_not_there_is_said_so(served, hall, refused, method, path, status, kind, allow):
    answer = served.client.request(method, served.url + path)
    problem = refused(answer, status, kind)
    assert answer.headers.get("allow") == allow
    assert len(problem["detail"]) < 5300


@pytest.mark.parametrize(
    ("value", "field", "text"),
    [
        ('{"robot"', "filter", "not JSON"),
        ('{"robot": []}', "filter.robot", "at least 1"),
        ('{"not_within_s": 0}', "filter.not_within_s", "greater than 0"),
        ('{"not_within_s": 1e999}', "filter.not_within_s", "finite"),
        ('{"captured_after": "2026-11-16T09:30:00"}', "filter.captured_after", "timezone"),
        ('{"captured_after": "2026-11-16T09:30:00Z", "captured_before": "2026-11-16T09:29:59Z"}',
         "filter.captured_before", "earlier than `captured_after`"),
        ('{"tags": [' + '"a",' * 32 + '"a"]}', "filter.tags", "at most 32"),
        ('{"exclude_frames": [' + '"a",' * 1000 + '"a"]}', "filter.exclude_frames", "1000"),
        ('{"region": {"parent_frame": "house", "min": {"x": 0, "y": 1, "z": 0}, "max": {"x": 1, '
         '"y": 0, "z": 1}}}', "filter.region.max", "y: less than in `min`"),
        ('{"region": {"parent_frame": "house", "min": {"x": 0, "y": 1, "z": Infinity}, "max": '
         '{"x": 1, "y": 1, "z": 1}}}', "filter.region.min.z", "finite"),
        ('{"region": {"min": {"x": 0, "y": 1, "z": 0}, "max": {"x": 1, "y": 1, "z": 1}}}',
         "filter.region.parent_frame", "required"),
    ],
)  # fmt: skip
def test_a_filter_that_makes_no_sense_is_named(
    served, hall, small_shots, refused, value, field, text
):
    form = small_shots[0].form()
    form["data"] |= {"stages": "retrieve", "k": "50", "filter": value}
    answer = served.client.post(f"{hall}/queries", **form)
    problem = refused(answer, 422, "invalid-request")
    assert [error["field"] for error in problem["errors"]] == [field]
    assert text in problem["errors"][0]["reason"]


@pytest.mark.parametrize(
    ("count", "poses", "more", "message"),
    [
        (1, True, {}, "The sequence has 1 frames"),
        (2, False, {}, "frame 0 has no pose"),
        (2, True, {"k": "0"}, "greater than or equal to 1"),
        (2, True, {"colour": "red"}, "colour"),
        (2, True, {"stages": "retrieve"}, "stages"),
    ],
)
def test_what_is_no_sequence_is_refused(
    served, hall, small_shots, refused, count, poses, more, message
):
    odometry = {"pose": {"matrix": np.eye(4).tolist(), "parent_frame": "odom"}} if poses else {}
    forms = [shot.form(**odometry) for shot in small_shots[:count]]
    metas = [json.loads(form["data"]["meta"]) for form in forms]
    answer = served.client.post(
        f"{hall}/localize/sequence", data={"metas": json.dumps(metas), **more},
        files=[("frame", form["files"]["frame"]) for form in forms],
    )  # fmt: skip
    assert message in str(refused(answer, 422, "invalid-request"))
