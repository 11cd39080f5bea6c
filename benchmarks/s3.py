"""S3 server in its own process: moto, which stores objects in memory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Self

import httpx

from benchmarks.waiting import answers, free_port, until

_MAIN = "import sys; from moto.server import main; main(sys.argv[1:])"


class ObjectServer:
    """An S3 server that runs within the context; it does not check signatures.

    Parameters
    ----------
    port : port to listen on; 0 for a free port
    log : file that receives a line per request, which `requests` counts
    """

    def __init__(self, port: int = 0, log: Path | None = None) -> None:
        self.port, self._log = port or free_port(), log or Path(os.devnull)
        self.endpoint = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def env(self) -> dict[str, str]:
        """Return the environment variables for a process that uses the server."""
        return {
            "AWS_ENDPOINT_URL": self.endpoint, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "fleet", "AWS_SECRET_ACCESS_KEY": "no-secret",
        }  # fmt: skip

    def start(self) -> None:
        """Start the server and wait until it answers."""
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _MAIN, "-H", "127.0.0.1", "-p", str(self.port)],
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip
        until(lambda: answers(f"{self.endpoint}/moto-api/"))

    def bucket(self, name: str) -> str:
        """Create a bucket, and return its URL."""
        httpx.put(f"{self.endpoint}/{name}", timeout=10, trust_env=False).raise_for_status()
        return f"s3://{name}"

    def requests(self) -> Counter[str]:
        """Return the number of requests by method."""
        text = self._log.read_text(errors="replace")
        return Counter(re.findall(r'"(GET|HEAD|PUT|POST|DELETE) ', text))

    def kill(self) -> None:
        """Kill the server; its objects are lost."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
