"""Keys, and who changed what."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any
from urllib.parse import quote

from anyio import to_thread
from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import ValidationError

from sceneprint.errors import InvalidRequest, UnsupportedType
from sceneprint.schemas import Page
from sceneprint.schemas.keys import Audited, Key, MadeKey, Me, NewKey
from service.access import Asking, administers
from service.bodies import media_type, read_json
from service.context import Here
from service.problems import declared, invalid

router = APIRouter(tags=["keys"])

BODY: dict[str, Any] = {
    "required": True,
    "content": {"application/json": {"schema": {"$ref": "#/components/schemas/NewKey"}}},
}
Cursor = Annotated[str | None, Query(description="`next_cursor` of the page before.")]
Limit = Annotated[int, Query(ge=1, le=1000)]


@router.post(
    "/keys",
    status_code=201,
    responses=declared(400, 409, 413, 415, 422),
    openapi_extra={"requestBody": BODY},
    dependencies=[Depends(administers)],
)
async def create_key(request: Request, here: Here, response: Response) -> MadeKey:
    """Make a key. Its secret is in this answer and nowhere else; a lost one is revoked."""
    if media_type(request) != "application/json":
        raise UnsupportedType(
            f"The body is {media_type(request) or 'of no type'!r:.80}. Send JSON as "
            "application/json."
        )
    new = _new(await read_json(request))
    made = await to_thread.run_sync(here.engine.create_key, new.name, new.grants, new.expires_at)
    response.headers["Location"] = f"/v1/keys/{quote(made.name, safe='')}"
    request.state.audited = made.model_dump(mode="json", include={"grants", "expires_at"})
    return made


@router.get("/keys", responses=declared(422), dependencies=[Depends(administers)])
def list_keys(here: Here, cursor: Cursor = None, limit: Limit = 100) -> Page[Key]:
    """Keys by name, without their secrets."""
    return here.engine.list_keys(cursor, limit)


@router.get("/keys/me", responses=declared())
def me(asking: Asking) -> Me:
    """What the key may do that is shown."""
    until = asking.expires_at
    return Me(
        name=asking.name or None,
        grants=dict(asking.grants),
        expires_at=None if until is None else datetime.fromtimestamp(until, UTC),
    )


@router.delete(
    "/keys/{key_name:path}",
    status_code=204,
    responses=declared(404),
    dependencies=[Depends(administers)],
)
def revoke_key(key_name: Annotated[str, Path(description="Of the key.")], here: Here) -> None:
    """Let a key open nothing any more, from the next request on, on every machine of the store."""
    here.engine.revoke_key(key_name)


@router.get("/audit", responses=declared(422), dependencies=[Depends(administers)])
def list_changes(
    here: Here,
    actor: Annotated[
        str | None, Query(max_length=128, description="Name of the key that made them.")
    ] = None,
    map_name: Annotated[
        str | None, Query(alias="map", max_length=63, description="That was changed.")
    ] = None,
    cursor: Cursor = None,
    limit: Limit = 100,
) -> Page[Audited]:
    """Who changed what, the newest first: all but uploads of frames, which the events tell of.

    The newest 100,000 changes are kept.
    """
    return here.engine.audit.page(cursor, limit, actor, map_name)


def _new(given: object) -> NewKey:
    if not isinstance(given, dict):
        raise InvalidRequest(
            "The key is not as it should be: it is no JSON object. See /docs for its fields.",
            (("", "not an object"),),
        )
    try:
        return NewKey.model_validate(given)
    except ValidationError as error:
        raise invalid(error, "The key") from error
