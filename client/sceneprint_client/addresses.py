"""Where a service is: its default address, and which addresses are this machine."""

from __future__ import annotations

import ipaddress

#: Where `sceneprint serve` listens unless told otherwise.
DEFAULT_URL = "http://127.0.0.1:8008"


def is_loopback(host: str) -> bool:
    """Whether a name or address, without port or brackets, is only ever this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
