"""Secrets in files, as container engines hand them over, in place of the environment."""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

from sceneprint.errors import InvalidRequest

#: Variables that hold a secret; the variable with `_FILE` at its end names a file instead.
SECRETS = (
    "SCENEPRINT_DATABASE_URL", "SCENEPRINT_REPLICA_URL", "PGPASSWORD", "AWS_ACCESS_KEY_ID",
    "AWS_SECRET_ACCESS_KEY", "AZURE_STORAGE_ACCOUNT_KEY",
)  # fmt: skip
#: A secret is one line; a larger file is another one.
MOST_BYTES = 16 << 10


def read_secret_files(environment: MutableMapping[str, str]) -> None:
    """Set each secret whose file is named; line ends after it do not belong to it.

    The environment that a process was started with, which others may see (`docker inspect`,
    `/proc`), then holds no secret.

    Raises
    ------
    InvalidRequest : a file that cannot be read, is empty or is none of a secret; or both are set.
    """
    for name in SECRETS:
        given = environment.get(f"{name}_FILE")
        if not given:
            continue
        if environment.get(name):
            raise InvalidRequest(f"{name} and {name}_FILE are both set. Unset one of them.")
        try:
            with Path(given).open("rb") as file:
                data = file.read(MOST_BYTES + 1)
            text = data.decode().rstrip("\r\n")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not UTF-8"
            raise InvalidRequest(
                f"{name}_FILE: {given!r:.200} cannot be read ({reason}). Check the path and its "
                "permissions."
            ) from None
        if not text or len(data) > MOST_BYTES or "\n" in text or "\0" in text:
            raise InvalidRequest(
                f"{name}_FILE: {given!r:.200} does not hold a secret, which is one line of text. "
                "Check its content."
            )
        environment[name] = text
        del environment[f"{name}_FILE"]  # processes that are started from here have it already
