"""Serialization of records, such as manifests, as JSON with a checksum.

record  --seal-->  bytes  --unseal-->  JSON values, which the record's class validates
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from pydantic import BaseModel, ConfigDict


class StrictRecord(BaseModel):
    """An immutable record that rejects unknown fields and values of other types."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


def seal(record: StrictRecord) -> bytes:
    """Serialize a record as JSON with a checksum; equal records give equal bytes."""
    values = json.loads(record.model_dump_json())
    return json.dumps(values | {"sha256": _checksum(values)}, indent=1).encode()


def unseal(data: bytes) -> dict[str, Any]:
    """Return the values of a sealed record.

    Raises
    ------
    ValueError : If the bytes are not a sealed record or have changed
    """
    values = json.loads(data)
    if not isinstance(values, dict) or values.pop("sha256", None) != _checksum(values):
        raise ValueError("the checksum does not match")
    return values


def _checksum(values: dict[str, Any]) -> str:
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
