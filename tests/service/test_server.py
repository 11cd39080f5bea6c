"""The socket that is listened on."""

from __future__ import annotations

import socket

import pytest

from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from service.server import listen


def test_accepted_connections_do_not_wait_for_acknowledgements(tmp_path):
    """asyncio turns Nagle off where the protocol says TCP, and leaves it on where it says 0."""
    with listen(Settings(data_dir=tmp_path, port=0)) as listening:
        assert (listening.type, listening.proto) == (socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listening.listen()
        host, port = listening.getsockname()
        assert host == "127.0.0.1"
        with socket.create_connection((host, port)):
            accepted, _ = listening.accept()
            with accepted:
                assert accepted.proto == socket.IPPROTO_TCP
        with pytest.raises(UnusableStore, match=f"127.0.0.1:{port} is not available"):
            listen(Settings(data_dir=tmp_path, port=port))
