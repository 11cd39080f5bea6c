"""Keys, what they may do, and who changed what, as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, StringConstraints

from sceneprint.schemas.base import Given, Label, Told

#: What a key may do with a map; each may what those before it may.
Scope = Literal["read", "write", "admin"]
SCOPES: tuple[Scope, ...] = ("read", "write", "admin")
#: In place of the name of a map: all of them, and what is of no map.
EVERY = "*"
#: A map's name, or EVERY.
GRANTED = r"^(\*|[a-z0-9][a-z0-9_-]{0,62})$"


def allows(grants: Mapping[str, Scope], scope: Scope, map_name: str = EVERY) -> bool:
    """Whether grants, by the names of maps, are enough.

    Parameters
    ----------
    grants : of a key; those for `*` hold for every map
    scope : that is needed
    map_name : for which it is; default: for all maps
    """
    least = SCOPES.index(scope)
    held = [grants[name] for name in (EVERY, map_name) if name in grants]
    return any(SCOPES.index(one) >= least for one in held)


class NewKey(Given):
    """A key to make."""

    name: Label = Field(
        description="Who it is for; unique, and told in the audit log.", examples=["robot-7"]
    )
    grants: Annotated[
        dict[Annotated[str, StringConstraints(pattern=GRANTED)], Scope],
        Field(min_length=1, max_length=1000),
    ] = Field(
        description="What it may do, by the name of a map, which need not be there yet; `*` stands "
        "for all maps and for what is of none. `write` may what `read` may, `admin` all.",
        examples=[{"warehouse-2": "write"}],
    )
    expires_at: AwareDatetime | None = Field(
        default=None, description="When it opens nothing any more; null: never."
    )


class Key(Told):
    """A key, without its secret, which is kept nowhere."""

    name: str
    grants: dict[str, Scope] = Field(description="What it may do, by map; `*` for all.")
    created_at: datetime
    expires_at: datetime | None = Field(description="Null: it does not expire.")


class MadeKey(Key):
    """A key that was just made."""

    secret: str = Field(
        description="Send it as `Authorization: Bearer SECRET`. It is shown this once: only its "
        "hash is kept."
    )


class Me(Told):
    """Who asks, as the service sees it."""

    name: str | None = Field(description="Of the key that was shown; null where none is asked for.")
    grants: dict[str, Scope] = Field(description="What it may do, by map; `*` for all.")
    expires_at: datetime | None = Field(default=None, description="Null: it does not expire.")


class Audited(Told):
    """A change, and who made it."""

    at: datetime
    actor: str | None = Field(
        description="Name of the key that was shown; null where none was asked for; `command` for "
        "a command on the data folder."
    )
    address: str | None = Field(
        description="Where the request came from; behind a proxy, the proxy's."
    )
    action: str = Field(description="The operation, such as `delete_map`.")
    map: str | None = Field(description="That was changed.")
    target: str | None = Field(description="What was changed in it, or of no map: an id or name.")
    request_id: str | None = Field(description="As in the log.")
    data: dict[str, Any] = Field(description="More of what was changed, by the operation.")
