"""Tenants: who pays. Keys belong to tenants, and so do the jobs that are queued with them."""

from __future__ import annotations

import time
from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, insert, select, update

from sceneprint.errors import Conflict, UnknownTenant
from sceneprint.store.tables import jobs, keys, tenants

# The table.


@dataclass(frozen=True)
class TenantRow:
    """A tenant.

    Parameters
    ----------
    name : unique
    created_at : seconds since 1970
    keys : how many it has
    """

    name: str
    created_at: float
    keys: int


def list_tenants(connection: Connection) -> list[TenantRow]:
    """All tenants by name."""
    held = (
        select(func.count()).where(keys.c.tenant == tenants.c.name).scalar_subquery().label("keys")
    )
    asked = select(tenants.c.name, tenants.c.created_at, held).order_by(tenants.c.name)
    return [TenantRow(*row) for row in connection.execute(asked)]


def has_tenant(connection: Connection, name: str) -> bool:
    """Whether there is a tenant of that name."""
    asked = select(tenants.c.name).where(tenants.c.name == name)
    return connection.execute(asked).first() is not None


def create_tenant(connection: Connection, name: str) -> None:
    """Create a tenant without keys; Conflict where there is one of that name."""
    if has_tenant(connection, name):
        raise Conflict(f"There is a tenant named {name!r:.80}. Choose another name.")
    connection.execute(insert(tenants).values(name=name, created_at=time.time()))


def delete_tenant(connection: Connection, name: str) -> None:
    """Delete a tenant that has no key; its jobs that wait keep their turn.

    Raises
    ------
    UnknownTenant : there is none of that name.
    Conflict : it has a key.
    """
    if not has_tenant(connection, name):
        raise unknown_tenant(name)
    if _first_key(connection, name) is not None:
        raise Conflict(
            f"The tenant {name!r:.80} has keys. Revoke them with `sceneprint keys --revoke`, then "
            "delete it."
        )
    connection.execute(delete(tenants).where(tenants.c.name == name))


def join_tenant(connection: Connection, key_name: str, tenant: str | None) -> str:
    """The tenant of a new key: the one that is named, or one of the key's own name.

    Raises
    ------
    UnknownTenant : there is none of the name that was given.
    """
    if tenant is not None:
        if not has_tenant(connection, tenant):
            raise unknown_tenant(tenant)
        return tenant
    if not has_tenant(connection, key_name):
        create_tenant(connection, key_name)
    return key_name


def leave_tenant(connection: Connection, key_name: str, tenant: str) -> None:
    """Delete the tenant that came with a revoked key, unless another key has it."""
    if tenant == key_name and _first_key(connection, tenant) is None:
        delete_tenant(connection, tenant)


def unknown_tenant(name: str) -> UnknownTenant:
    """That there is no tenant of a name."""
    return UnknownTenant(
        f"There is no tenant named {name!r:.80}. Create it with `sceneprint keys --create-tenant "
        "NAME`; list them with `sceneprint keys --list-tenants`."
    )


def keep_turns(connection: Connection, *names: str) -> None:
    """Keep the latest turns of some tenants at the workers, or of all where none is named; call it
    before jobs are removed.

    Else whoever deletes its maps again and again would always come first.
    """
    last = (
        select(func.max(jobs.c.turn))
        .where(jobs.c.tenant == tenants.c.name)
        .correlate(tenants)
        .scalar_subquery()
    )
    which = [tenants.c.name.in_(names)] if names else []
    connection.execute(update(tenants).where(tenants.c.turn < last, *which).values(turn=last))


def _first_key(connection: Connection, tenant: str) -> str | None:
    asked = select(keys.c.name).where(keys.c.tenant == tenant).limit(1)
    return connection.execute(asked).scalar()
