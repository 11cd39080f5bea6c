"""Tests of the OpenAPI document, to which `promised` holds the answers of all other tests."""

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
    found = set(references(document))
    assert len(found) >= 20
    for reference in found:
        place = document
        for step in reference.removeprefix("#/").split("/"):
            place = place[step]
        assert isinstance(place, dict)
    names = [operation["operationId"] for operation in operations(document).values()]
    assert len(names) == len(set(names))  # how many there are, its golden tells
    used = {reference.rpartition("/")[2] for reference in found}
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


@pytest.mark.parametrize(
    ("method", "path", "statuses"),
    [
        ("post", "/v1/maps", {200, 201, 400, 409, 413, 415, 422}),
        ("get", "/v1/maps/{map_name}", {200, 404}),
        ("delete", "/v1/maps/{map_name}", {204, 404}),
        ("post", "/v1/maps/{map_name}/frames", {200, 201, 202, 400, 404, 409, 413, 415, 422}),
        ("get", "/v1/maps/{map_name}/frames", {200, 404, 422}),
        ("post", "/v1/maps/{map_name}/queries", {200, 400, 404, 413, 415, 422}),
        ("get", "/v1/jobs", {200, 404, 422}),
        ("get", "/v1/jobs/{job_id}", {200, 404}),
        ("post", "/v1/jobs/{job_id}/cancel", {200, 404, 409}),
        ("post", "/v1/jobs/{job_id}/retry", {200, 202, 404, 409}),
        ("post", "/v1/jobs/retry", {200, 404, 422}),
        ("get", "/healthz", {200}),
        ("get", "/metrics", {200}),
    ],
)  # fmt: skip
def test_an_operation_declares_what_it_answers(document, method, path, statuses):
    declared = operations(document)[method, path]["responses"]
    always = {400, 401, 403, 408, 421, 429, 500, 503, 507}
    assert {int(status) for status in declared} == statuses | always


def test_bodies_that_are_read_by_hand_are_described(document):
    schemas = document["components"]["schemas"]
    assert "required" not in schemas["FrameMeta"]  # a cloud needs no more than its points
    assert schemas["FrameMeta"]["additionalProperties"] is False
    upload = operations(document)["post", "/v1/maps/{map_name}/frames"]["requestBody"]
    raw = ["image/png", "application/x-npy", "image/x-portable-floatmap", "application/ply",
           "application/x-ros-pointcloud2", "application/octet-stream"]  # fmt: skip
    assert list(upload["content"]) == ["multipart/form-data", *raw]
    form = upload["content"]["multipart/form-data"]["schema"]
    assert form["required"] == ["frame", "meta"]
    assert sorted(form["properties"]) == ["frame", "if_novel", "meta", "priority"]
    query = operations(document)["post", "/v1/maps/{map_name}/queries"]["requestBody"]
    options = {"k", "stages", "exact", "filter", "seed", "candidates", "diversity", "validation",
               "prior", "deadline_ms", "explain", "explain_frame", "keep",
               "record", "confidence"}  # fmt: skip
    assert {"application/json", "multipart/form-data", "image/png"} <= set(query["content"])
    beside = operations(document)["post", "/v1/maps/{map_name}/queries"]["parameters"]
    assert {one["name"] for one in beside if one["in"] == "query"} >= options | {"fx", "meta"}
    by_form = query["content"]["multipart/form-data"]["schema"]["properties"]
    by_id = query["content"]["application/json"]["schema"]["properties"]
    assert set(by_form) == {"frame", "meta"} | options
    assert set(by_id) == {"frame_id", "robot"} | options
    assert (by_form["k"]["minimum"], by_form["k"]["maximum"], by_form["k"]["default"]) == (1, 50, 5)
    assert by_form["stages"]["type"] == "string"
    assert {"items", "anyOf"} & set(by_form["stages"]) == set()
    assert [one["type"] for one in by_id["stages"]["anyOf"]] == ["string", "array"]
    reference = {"$ref": "#/components/schemas/Filter"}
    assert reference in by_id["filter"]["anyOf"]
    assert (by_form["filter"]["type"], by_form["filter"]["contentSchema"]) == ("string", reference)
    assert schemas["Filter"]["additionalProperties"] is False
    assert by_form["diversity"]["contentSchema"] == {"$ref": "#/components/schemas/Diversity"}
    several = operations(document)["post", "/v1/queries"]["requestBody"]["content"]
    assert several["multipart/form-data"]["schema"]["required"] == ["frame", "maps", "meta"]
    assert several["application/json"]["schema"]["required"] == ["maps"]
    pair = operations(document)["post", "/v1/similarity"]["requestBody"]["content"]
    parts = set(pair["multipart/form-data"]["schema"]["properties"])
    assert parts >= {"a", "b", "meta_a", "meta_b", "frame_a", "frame_b", "validate", "model"}
    made = operations(document)["post", "/v1/maps"]["requestBody"]
    assert (made["required"], list(made["content"])) == (True, ["application/json"])
    schema = made["content"]["application/json"]["schema"]
    assert schema == {"$ref": "#/components/schemas/NewMap"}
    assert schemas["NewMap"]["required"] == ["name"]


def test_keys_are_asked_for_by_all_but_health(document):
    """`/readyz` answers without one, and tells more to who has one."""
    for (_, path), operation in operations(document).items():
        assert ("security" in operation) is (path != "/healthz"), path
        assert ({} in operation.get("security", ())) is (path == "/readyz"), path
    assert document["components"]["securitySchemes"]["HTTPBearer"]["scheme"] == "bearer"
