"""Two frames compared."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request

from sceneprint.schemas import Comparison, NamedFrame, Similarity
from service.access import Asking
from service.bodies import FORM
from service.context import Here
from service.pairs import Sent, pair
from service.problems import declared
from service.questions import JSON, TEMPLATE, as_text

router = APIRouter(tags=["queries"])


def _body() -> dict[str, Any]:
    """The ways to name two frames, for the OpenAPI document."""
    own = Comparison.model_json_schema(ref_template=TEMPLATE)["properties"]
    file = {"type": "string", "format": "binary", "description": "A depth image: PNG or NPY."}
    meta = {
        "type": "string",
        "contentMediaType": JSON,
        "contentSchema": {"$ref": "#/components/schemas/FrameMeta"},
    }
    parts = {"a": file, "meta_a": meta, "b": file, "meta_b": meta}
    texts = {name: as_text(one) for name, one in own.items()}
    return {
        "required": True,
        "content": {
            JSON: {
                "schema": {
                    "type": "object", "required": ["frame_a", "frame_b"], "properties": own,
                    "additionalProperties": False,
                }
            },
            FORM: {"schema": {"type": "object", "properties": {**parts, **texts}}},
        },
    }  # fmt: skip


@router.post(
    "/similarity",
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra={"requestBody": _body()},
)
async def compare(request: Request, here: Here, asking: Asking) -> Similarity:
    """How alike are two frames, and do they see one place? Neither is kept.

    Each is stored, or sent: file part `a` with `meta_a`, `b` with `meta_b`. Stored frames must be
    of one model; what is sent is signed with theirs. The transform maps b to a.
    """
    async with here.gate.place(), pair(request) as asked:
        a, b = asked.a, asked.b
        for side in (a, b):
            if isinstance(side, NamedFrame):
                asking.require(side.map, "read")
        return await here.gate.run(
            lambda: here.engine.queries.compare(
                a.read() if isinstance(a, Sent) else a,
                b.read() if isinstance(b, Sent) else b,
                asked.how,
            )
        )
