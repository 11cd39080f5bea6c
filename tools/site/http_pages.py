"""Pages of the HTTP API from its OpenAPI document: one for each resource, and one for records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from tools.site.markup import cell, code, fenced, first_sentence, page, plain, table

Json = Mapping[str, Any]
RECORDS = "records.md"
ERRORS = "../../reference.md#problems"
JSON = "application/json"
PROBLEM = "application/problem+json"
#: End of the descriptions of parameters that replace fields of a form.
BARE = " Allowed only if the request body is the frame itself."
_METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "HEAD")
#: Bounds of JSON Schema in words, which follow a type.
_BOUNDS = {
    "minimum": "at least {}", "exclusiveMinimum": "above {}", "maximum": "at most {}",
    "exclusiveMaximum": "below {}", "minLength": "at least {} characters",
    "maxLength": "at most {} characters", "minItems": "at least {} items",
    "maxItems": "at most {} items",
}  # fmt: skip


@dataclass(frozen=True)
class Operation:
    """An operation of the API.

    Parameters
    ----------
    method, path : method and path of its requests
    resource : tag
    body : entry in the OpenAPI document
    """

    method: str
    path: str
    resource: str
    body: Json

    @property
    def title(self) -> str:
        """Title of the operation."""
        return str(self.body["summary"]).capitalize()

    @property
    def anchor(self) -> str:
        """Anchor of the operation on the page of its resource."""
        return str(self.body["summary"]).lower().replace(" ", "-")


def operations(document: Json) -> list[Operation]:
    """Return all operations by resource, in the order of their paths."""
    result = [
        Operation(method.upper(), path, body["tags"][0], body)
        for path, methods in document["paths"].items()
        for method, body in methods.items()
        if method.upper() in _METHODS
    ]
    return sorted(result, key=lambda one: (one.resource, one.path, _METHODS.index(one.method)))


def resource_page(name: str, document: Json) -> str:
    """Return Markdown that describes the operations of a resource."""
    own = [operation for operation in operations(document) if operation.resource == name]
    return page(
        f"# {name.capitalize()}",
        _overview(own, ""),
        *(_describe(row) for row in own),
    )


def index_page(document: Json) -> str:
    """Return Markdown that lists all operations by resource."""
    result = operations(document)
    names = sorted({item.resource for item in result})
    return page(
        "# HTTP API",
        f"{len(result)} operations. Bodies and answers are described with the "
        f"[records]({RECORDS}); errors are [problems]({ERRORS}). A service serves the same "
        "as an OpenAPI document at `/openapi.json`, and as pages to try it at `/docs`. "
        "[The tour](../../api.md) shows the API at work with curl.",
        *(
            page(
                f"## {name.capitalize()}",
                _overview([item for item in result if item.resource == name], f"{name}.md"),
            )
            for name in names
        ),
    )


def _overview(own: list[Operation], file: str) -> str:
    rows = (
        (
            f"[{code(f'{row.method} {row.path}')}]({file}#{row.anchor})",
            cell(first_sentence(row.body.get("description", row.title))),
        )
        for row in own
    )
    return table(("operation", "what it does"), rows)


def _describe(one: Operation) -> str:
    parameters = one.body.get("parameters", [])
    bare = [each for each in parameters if each.get("description", "").endswith(BARE)]
    named = [each for each in parameters if each not in bare]
    folded = ""
    if bare:
        rows = _indented(_parameters(bare))
        folded = f'??? note "Parameters if the body is the frame itself"\n\n{rows}'
    return page(
        f"## {one.title} {{ #{one.anchor} }}",
        fenced(f"{one.method} {one.path}", "http"),
        plain(one.body.get("description", "")),
        _parameters(named) and f"**Parameters**\n\n{_parameters(named)}",
        folded,
        _request(one.body.get("requestBody", {})),
        f"**Answers**\n\n{_answers(one.body['responses'])}",
    )


def _indented(text: str) -> str:
    return "\n".join(f"    {line}" if line else line for line in text.split("\n"))


def _parameters(parameters: list[Json]) -> str:
    rows = (
        (
            code(parameter["name"]),
            parameter["in"] + (" (required)" if parameter.get("required") else ""),
            type_of(parameter["schema"]),
            _meaning(parameter.get("description", "").removesuffix(BARE), parameter["schema"]),
        )
        for parameter in parameters
    )
    return table(("name", "in", "type", "meaning"), rows)


def _request(body: Json) -> str:
    """Return the accepted bodies by media type."""
    parts = []
    for kind, content in body.get("content", {}).items():
        schema = content.get("schema", {})
        if "properties" in schema:
            parts.append(f"**Body** {code(kind)}:\n\n{_fields(schema)}")
        else:
            parts.append(f"**Body** {code(kind)}: {type_of(schema)}")
    return "\n\n".join(parts)


def _answers(responses: Json) -> str:
    """Return a row for each status, with a common last row for problems."""
    rows = []
    problems = []
    for status, response in responses.items():
        content = response.get("content", {})
        if PROBLEM in content:
            problems.append(status)
            continue
        kinds = [
            type_of(what.get("schema", {})) if kind == JSON else code(kind)
            for kind, what in content.items()
        ]
        rows.append((status, ", ".join(kinds) or "no body", cell(response["description"])))
    if problems:
        rows.append(
            (
                ", ".join(problems),
                "[Problem](records.md#problem)",
                f"[errors]({ERRORS})",
            )
        )
    return table(("status", "body", "meaning"), rows)


def records_page(document: Json) -> str:
    """Return Markdown that describes every record by name."""
    schemas = document["components"]["schemas"]
    return page(
        "# Records",
        f"The {len(schemas)} records that bodies and answers consist of. Lengths are metres, "
        "times are ISO 8601 with a time zone.",
        *(_record(name, schemas[name]) for name in sorted(schemas)),
    )


def _record(name: str, schema: Json) -> str:
    values = ", ".join(code(str(value)) for value in schema.get("enum", ()))
    return page(
        f"## {_record_title(name)} {{ #{_record_anchor(name)} }}",
        plain(schema.get("description", "")),
        values and f"One of: {values}.",
        _fields(schema),
    )


def _record_title(name: str) -> str:
    """Return the name of a record; a generic one as in Python, such as Page[Frame]."""
    generic, mark, of = name.partition("_")
    return f"{generic}\\[{of.rstrip('_')}\\]" if mark else name


def _record_anchor(name: str) -> str:
    return name.strip("_").replace("_", "-").lower()


def _fields(schema: Json) -> str:
    required = schema.get("required", ())
    rows = (
        (
            code(name) + (" (required)" if name in required else ""),
            type_of(field),
            _meaning(field.get("description", ""), field),
        )
        for name, field in schema.get("properties", {}).items()
    )
    return table(("field", "type", "meaning"), rows)


def _meaning(description: str, schema: Json) -> str:
    text = cell(description)
    default = schema.get("default")
    if default is None or default in ([], {}, ""):
        return text
    shown = str(default).lower() if isinstance(default, bool) else str(default)
    return f"{text} Default: {code(shown)}.".lstrip()


def type_of(schema: Json) -> str:
    """Return a type in words with its bounds; a record is a link to its description."""
    content = schema.get("contentSchema")
    if content is not None:
        return f"{type_of(content)} as JSON"
    bounds = [text.format(schema[key]) for key, text in _BOUNDS.items() if key in schema]
    return _name_of(schema) + (f" ({', '.join(bounds)})" if bounds else "")


def _name_of(schema: Json) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{_record_title(name)}]({RECORDS}#{_record_anchor(name)})"
    if "const" in schema:
        return code(str(schema["const"]))
    if "enum" in schema:
        return " or ".join(code(str(value)) for value in schema["enum"])
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(type_of(value) for value in schema[key])
    kind = schema.get("type", "anything")
    if kind == "array":
        return _array(schema)
    if kind == "object" and isinstance(schema.get("additionalProperties"), Mapping):
        return f"object of {type_of(schema['additionalProperties'])}"
    if kind == "string" and schema.get("format") == "binary":
        return "file"
    return f"{kind} ({schema['format']})" if "format" in schema else str(kind)


def _array(schema: Json) -> str:
    if "prefixItems" in schema:
        return f"list of {', '.join(type_of(item) for item in schema['prefixItems'])}"
    return f"list of {type_of(schema.get('items', {}))}"


def resources(document: Json) -> Iterator[str]:
    """Yield the names of the resources that have operations."""
    yield from sorted({operation.resource for operation in operations(document)})
