"""Tenants, the owners of keys and of the jobs queued with these keys."""

from __future__ import annotations

import time
from dataclasses import dataclass

from sqlalchemy import Connection, delete, func, insert, select, update

from sceneprint.errors import Conflict, UnknownTenant
from sceneprint.store.tables import jobs, keys, tenants


@dataclass(frozen=True)
class TenantRow:
    """A tenant.

    Parameters
    ----------
    name : unique name
    created_at : seconds since 1970
    """

    name: str
    created_at: float
    keys: int


def list_tenants(connection: Connection) -> list[TenantRow]:
    """Return all tenants, sorted by name."""
    held = (
        select(func.count()).where(keys.c.tenant == tenants.c.name).scalar_subquery().label("keys")
    )
    statement = select(tenants.c.name, tenants.c.created_at, held).order_by(tenants.c.name)
    return [TenantRow(*row) for row in connection.execute(statement)]


def has_tenant(connection: Connection, name: str) -> bool:
    """Return whether a tenant exists."""
    statement = select(tenants.c.name).where(tenants.c.name == name)
    return connection.execute(statement).first() is not None


def create_tenant(connection: Connection, name: str) -> None:
    """Create a tenant without keys. Raise Conflict if the name is in use."""
    if has_tenant(connection, name):
        raise Conflict(f"A tenant named {name!r:.80} already exists. Choose another name.")
    connection.execute(insert(tenants).values(name=name, created_at=time.time()))


def delete_tenant(connection: Connection, name: str) -> None:
    """Delete a tenant without keys; its queued jobs remain.

    Raises
    ------
    UnknownTenant : If the tenant does not exist.
    Conflict : If the tenant has a key.
    """
    if not has_tenant(connection, name):
        raise unknown_tenant(name)
    if _first_key(connection, name) is not None:
        raise Conflict(
            f"The tenant {name!r:.80} has keys. Revoke them with `sceneprint keys --revoke` before "
            "you delete the tenant."
        )
    connection.execute(delete(tenants).where(tenants.c.name == name))


def join_tenant(connection: Connection, key_name: str, tenant: str | None) -> str:
    """Return the tenant of a new key: `tenant`, or a tenant named `key_name`, created if missing.

    Raises
    ------
    UnknownTenant : If `tenant` does not exist.
    """
    if tenant is not None:
        if not has_tenant(connection, tenant):
            raise unknown_tenant(tenant)
        return tenant
    if not has_tenant(connection, key_name):
        create_tenant(connection, key_name)
    return key_name


def leave_tenant(connection: Connection, key_name: str, tenant: str) -> None:
    """Delete the tenant of a revoked key if it was created with the key and has no other key."""
    if tenant == key_name and _first_key(connection, tenant) is None:
        delete_tenant(connection, tenant)


def unknown_tenant(name: str) -> UnknownTenant:
    """Return the error for a tenant that does not exist."""
    return UnknownTenant(
        f"There is no tenant named {name!r:.80}. List the tenants with `sceneprint keys "
        "--list-tenants`, or create the tenant with `sceneprint keys --create-tenant NAME`."
    )


def save_turns(connection: Connection, *names: str) -> None:
    """Store the latest turns of the tenants `names`, or of all tenants, in the table of tenants.

    Call this before removing jobs: a tenant could otherwise delete its maps to be served next.
    """
    last = (
        select(func.max(jobs.c.turn))
        .where(jobs.c.tenant == tenants.c.name)
        .correlate(tenants)
        .scalar_subquery()
    )
    named = [tenants.c.name.in_(names)] if names else []
    connection.execute(update(tenants).where(tenants.c.turn < last, *named).values(turn=last))


def _first_key(connection: Connection, tenant: str) -> str | None:
    return connection.execute(select(keys.c.name).where(keys.c.tenant == tenant).limit(1)).scalar()
