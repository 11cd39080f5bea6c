"""Tests of invalid forms, bodies that are too large, and aborted requests."""

import gzip
import json
import time

import pytest

from benchmarks.waiting import PATIENCE_S

LIMIT = 100_000


@pytest.fixture(scope="module")
def narrow(begin, make_map):
    """A server that takes few bytes, and no worker: what it stores stays as it came."""
    server = begin("--workers", "0", max_upload_bytes=LIMIT)
    make_map(server, "hall")
    return server


@pytest.fixture
def wire(narrow):
    """A connection on which anything can be said."""
    with narrow.connect() as opened:
        yield opened


def answer(wire):
    """All that comes until the other side closes."""
    data = b""
    try:
        while more := wire.recv(65536):
            data += more
    except ConnectionResetError:
        pass  # it closed with bytes of ours unread
    head, _, body = data.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    headers = dict(line.lower().split(": ", 1) for line in lines)
    return int(first.split()[1]), headers, body


def post(path, *headers):
    lines = (f"POST {path} HTTP/1.1", "Host: localhost", *headers)
    return "".join(f"{line}\r\n" for line in lines).encode() + b"\r\n"


def part(name, content, file=None, end=b"\r\n"):
    named = "" if file is None else f'; filename="{file}"'
    head = f'--x\r\nContent-Disposition: form-data; name="{name}"{named}\r\n\r\n'
    return head.encode() + content + end


CAMERA = {"width": 2, "height": 2, "fx": 2, "fy": 2, "cx": 0, "cy": 0}
META = json.dumps({"intrinsics": CAMERA}).encode()
FRAME, KNOWN, END = part("frame", b"abc", "a.png"), part("meta", META), b"--x--\r\n"
X = "multipart/form-data; boundary=x"

#: content type, body -> status, type, text of the detail
FORMS = {
    "no type": ("", b"abc", 415, "unsupported-type", "of no type"),
    "urlencoded": ("application/x-www-form-urlencoded", b"a=b", 415, "unsupported-type",
                   "multipart/form-data"),
    "no boundary": ("multipart/form-data", b"abc", 400, "malformed-body", "boundary"),
    "no form": (X, b"hello", 400, "malformed-body", "cannot be parsed"),
    "nameless": (X, b'--x\r\nContent-Disposition: form-data\r\n\r\na\r\n' + END, 400,
                 "malformed-body", "name"),
    "two files": (X, FRAME + FRAME + KNOWN + END, 400, "malformed-body", "Too many files"),
    "long field": (X, FRAME + part("meta", b" " * 262_145) + END, 413, "too-large", "100000"),
    "many fields": (X, FRAME + part("meta", b"{}") * 17 + END, 400, "malformed-body", "fields"),
    "slow charset": (X + '; Charset="PunyCode"', part("frame", b"a", "f") + END, 400,
                     "malformed-body", "charset is 'punycode'"),
    "charset with halves of pairs": (X + "; charset=utf-7", FRAME + part("+2AA-", META) + END, 400,
                                     "malformed-body", "charset is 'utf-7'"),
    "empty": (X, b"", 400, "malformed-body", "The body is empty"),
    "no frame": (X, KNOWN + END, 422, "invalid-request", "no file part `frame`"),
    "no meta": (X, FRAME + END, 422, "invalid-request", "no field `meta`"),
    "meta twice": (X, FRAME + KNOWN + KNOWN + END, 422, "invalid-request", "'meta' more than once"),
    "unknown part": (X, FRAME + KNOWN + part("colour", b"1") + END, 422, "invalid-request",
                     "an unknown part 'colour'"),
    "meta is no JSON": (X, FRAME + part("meta", b"{") + END, 400, "malformed-body", "`meta`"),
    "meta lacks all": (X, FRAME + part("meta", b"{}") + END, 422, "unreadable-frame",
                       "neither a depth image"),
    "cut in frame": (X, KNOWN + part("frame", b"ab", "a", b""), 422, "invalid-request", "`frame`"),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMS)
def test_a_form_that_is_none_is_refused(narrow, refused, name):
    kind_of, body, status, kind, text = FORMS[name]
    headers = {"content-type": kind_of} if kind_of else {}
    reply = narrow.client.post("/v1/maps/hall/frames", content=body, headers=headers)
    refused(reply, status, kind, text)
    assert leftovers(narrow.folder) == []


def leftovers(folder):
    return [path for path in (folder / "blobs").rglob("*") if path.is_file()]


def test_the_length_is_believed_before_a_byte_is_read(wire):
    wire.sendall(post("/v1/maps/hall/frames", f"Content-Type: {X}", f"Content-Length: {LIMIT + 1}"))
    status, headers, body = answer(wire)  # nothing of the body was sent, and it does not wait
    assert (status, headers["connection"]) == (413, "close")
    assert headers["content-type"] == "application/problem+json"
    problem = json.loads(body)
    assert (problem["status"], problem["type"]) == (413, "/problems/too-large")
    assert "the limit of 100000 bytes" in problem["detail"]
    assert problem["instance"] == f"/requests/{headers['x-request-id']}"


@pytest.mark.parametrize("path", ["/v1/maps/hall/frames", "/v1/maps/hall/queries", "/v1/maps"])
def test_a_stream_without_length_is_stopped_while_it_streams(narrow, wire, path):
    kind = "application/json" if path == "/v1/maps" else X
    wire.sendall(post(path, f"Content-Type: {kind}", "Transfer-Encoding: chunked"))
    block = part("frame", b"a" * 8_000, "a", b"")
    sent = 0
    while sent <= LIMIT:  # and never the chunk that ends it
        wire.sendall(b"%x\r\n" % len(block) + block + b"\r\n")
        sent += len(block)
    status, headers, body = answer(wire)
    assert (status, headers["connection"]) == (413, "close")
    assert json.loads(body)["type"] == "/problems/too-large"
    assert narrow.client.get("/readyz").json()["frames"] == {}
    assert leftovers(narrow.folder) == []


def test_what_is_as_large_as_may_be_is_read(narrow, refused):
    body = FRAME + KNOWN + END
    body += b" " * (LIMIT - len(body))  # behind the end, and so without effect
    headers = {"content-type": X}
    full = narrow.client.post("/v1/maps/hall/frames", content=body, headers=headers)
    refused(full, 422, "unreadable-frame")
    streamed = narrow.client.post("/v1/maps/hall/frames", content=iter([body]), headers=headers)
    refused(streamed, 422, "unreadable-frame")
    over = narrow.client.post("/v1/maps/hall/frames", content=iter([body, b" "]), headers=headers)
    refused(over, 413, "too-large")


def test_a_compressed_body_is_refused(narrow, refused):
    for route in ("frames", "queries"):
        packed = gzip.compress(FRAME + KNOWN + END)
        headers = {"content-type": X, "content-encoding": "gzip"}
        answer = narrow.client.post(f"/v1/maps/hall/{route}", content=packed, headers=headers)
        refused(answer, 415, "unsupported-type", "Content-Encoding 'gzip'")
    plain = {"content-type": X, "content-encoding": "identity"}
    answer = narrow.client.post("/v1/maps/hall/frames", content=FRAME + KNOWN + END, headers=plain)
    refused(answer, 422, "unreadable-frame")


def test_a_caller_who_hangs_up_leaves_nothing_behind(narrow, wire, small_shots):
    whole = part("meta", META) + part("frame", small_shots[0].png, "a.png") + END
    head = post("/v1/maps/hall/frames", f"Content-Type: {X}", f"Content-Length: {len(whole)}")
    wire.sendall(head + whole[: len(whole) // 2])
    wire.close()
    end = time.monotonic() + PATIENCE_S
    while not [line for line in narrow.log("request") if line["status"] == 499]:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert leftovers(narrow.folder) == []
    assert narrow.client.get("/readyz").json() | {"version": ""} == {
        "status": "ready", "version": "", "read_only": False, "frames": {}, "jobs": {},
    }  # fmt: skip
    assert narrow.log("unexpected error") == []  # it is no fault of ours
    assert [line for line in narrow.log() if line["level"] == "error"] == []


@pytest.mark.parametrize(
    ("text", "kept_as_given"),
    [("abc-1.2_Z", True), ("a" * 64, True), ("a" * 65, False), ("a b", False), ("", False)],
)
def test_a_request_keeps_the_id_it_came_with_where_it_is_one(narrow, until, text, kept_as_given):
    reply = narrow.client.get("/v1/maps/nowhere", headers={"X-Request-Id": text})
    own = reply.headers["x-request-id"]
    assert (own == text) is kept_as_given
    assert reply.json()["instance"] == f"/requests/{own}"
    assert reply.headers["x-content-type-options"] == "nosniff"
    # written once the answer has been sent
    noted = until(lambda: [line for line in narrow.log("request") if line["request_id"] == own])
    assert {(line["method"], line["path"], line["status"]) for line in noted} == {
        ("GET", "/v1/maps/nowhere", 404)
    }
