"""Tests of the OpenAPI document, to which `promised` holds the answers of all other tests."""

import hashlib

import pytest


@pytest.fixture(scope="module")
def document(served):
    return served.client.get("/openapi.json").json()


def references(part):
    if isinstance(part, dict):
        if isinstance(part.get("$ref"), str):
            yield part["$ref"]
        for value in part.values():
            yield from references(value)
    elif isinstance(part, list):
        for value in part:
            yield from references(value)


def operations(document):
    return {
        (method, path): operation
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    }


def test_the_document_is_whole(document):
    assert document["openapi"].startswith("3.1.")
    assert document["info"]["title"] == "sceneprint"
    result = set(references(document))
    assert len(result) >= 20
    for reference in result:
        place = document
        for step in reference.removeprefix("#/").split("/"):
            place = place[step]
        assert isinstance(place, dict)
    names = [operation["operationId"] for operation in operations(document).values()]
    assert len(names) == len(set(names))  # how many there are, its golden tells
    used = {reference.rpartition("/")[2] for reference in result}
    assert set(document["components"]["schemas"]) == used  # nothing that nothing refers to


def test_every_refusal_is_a_problem(document):
    for place, operation in operations(document).items():
        for status, response in operation["responses"].items():
            if status >= "400":
                kinds = response["content"]
                assert list(kinds) == ["application/problem+json"], (place, status)
                schema = kinds["application/problem+json"]["schema"]
                assert schema == {"$ref": "#/components/schemas/Problem"}
    required = document["components"]["schemas"]["Problem"]["required"]
    assert set(required) >= {"type", "title", "status", "detail"}


def test_keys_are_asked_for_by_all_but_health(document):
    """`/readyz` answers without one, and tells more to who has one."""
    for (_, path), operation in operations(document).items():
        assert ("security" in operation) is (path != "/healthz"), path
        assert ({} in operation.get("security", ())) is (path == "/readyz"), path
    assert document["components"]["securitySchemes"]["HTTPBearer"]["scheme"] == "bearer"


def test_who_has_the_document_is_not_sent_it_again(served):
    def get(**headers):
        return served.client.get("/openapi.json", headers=headers)

    sent = get(**{"Accept-Encoding": "identity"})
    tag = sent.headers["etag"]
    assert hashlib.sha256(sent.content).hexdigest().startswith(tag.strip('"'))
    response = get(**{"Accept-Encoding": "identity", "If-None-Match": tag})
    assert (response.status_code, response.content, response.headers["etag"]) == (304, b"", tag)
    packed = get(**{"Accept-Encoding": "gzip"})
    assert (packed.headers["content-encoding"], packed.content) == ("gzip", sent.content)
    assert packed.headers["etag"] != tag
