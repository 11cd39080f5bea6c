"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_whole(path: Path, data: bytes) -> None:
    """Put a file there in one step: a process killed here leaves the old one or none.

    Parameters
    ----------
    path : of the file; its folder must exist
    data : all of it

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    part = path.with_name(f".{secrets.token_hex(6)}.part")  # short: the name may be long already
    try:
        part.write_bytes(data)
        os.replace(part, path)  # noqa: PTH105  (the one call that is atomic by contract)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise type(error)(error.errno, error.strerror, str(path)) from error
    except BaseException:
        part.unlink(missing_ok=True)
        raise
