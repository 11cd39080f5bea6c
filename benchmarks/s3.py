"""A real server of the S3 protocol, as a process: moto's, from PyPI.

What it keeps is gone with it. It takes any credentials, and checks no signatures.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Self

#: Seconds for it to begin: it loads much.
BEGIN_S = 60.0
_MAIN = "import sys; from moto.server import main; main(sys.argv[1:])"


class ObjectServer:
    """A server on this machine, started when it is entered.

    Parameters
    ----------
    port : to listen on; 0 for a free one
    log : file that has a line for each request; None: nobody counts them
    """

    def __init__(self, port: int = 0, log: Path | None = None) -> None:
        self.port, self._log = port or _free_port(), log
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def env(self) -> dict[str, str]:
        """What a process needs in its environment to use it."""
        return {
            "AWS_ENDPOINT_URL": self.endpoint,
            "AWS_ALLOW_HTTP": "true",
            "AWS_ACCESS_KEY_ID": "fleet",
            "AWS_SECRET_ACCESS_KEY": "no-secret",
            "AWS_REGION": "us-east-1",
        }

    @property
    def is_running(self) -> bool:
        """Whether it was started, and has not ended."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start it, and wait until it answers."""
        with (self._log or Path(os.devnull)).open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _MAIN, "-H", "127.0.0.1", "-p", str(self.port)],
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip
        until = time.monotonic() + BEGIN_S
        while time.monotonic() < until and self.is_running:
            try:
                with urllib.request.urlopen(f"{self.endpoint}/moto-api/", timeout=5):
                    return
            except (OSError, urllib.error.URLError):
                time.sleep(0.05)
        self.kill()
        raise RuntimeError(f"moto_server does not answer on {self.endpoint}")

    def bucket(self, name: str) -> str:
        """Make a bucket; returns its URL."""
        asked = urllib.request.Request(f"{self.endpoint}/{name}", method="PUT")
        with urllib.request.urlopen(asked, timeout=10):
            return f"s3://{name}"

    def requests(self) -> Counter[str]:
        """Requests so far, by method."""
        text = "" if self._log is None else self._log.read_text(errors="replace")
        return Counter(re.findall(r'"(GET|HEAD|PUT|POST|DELETE) ', text))

    def kill(self) -> None:
        """End it as a loss of power would: what it kept is gone."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.kill()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
