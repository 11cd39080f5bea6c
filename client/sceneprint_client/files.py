"""What every reader of files needs: bytes, text and JSON of files, up to a limit."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator
from pathlib import Path

from sceneprint_client.errors import SceneprintError, naming


def read_bytes(path: Path, limit: int, error: type[SceneprintError]) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Parameters
    ----------
    path : the file
    limit : bytes; a larger file is refused unread
    error : what to raise

    Raises
    ------
    error : the file is absent, is no regular file (a pipe could wait for ever), is too
        large, or may not be read.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise error(f"{path}: This is no regular file. Name a file that holds the data.")
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as cause:  # ValueError: a NUL in the name
        reason = getattr(cause, "strerror", None) or cause
        raise error(
            f"{path}: The file cannot be read ({reason}). Check its name and your rights."
        ) from cause
    if len(data) > limit:
        raise error(
            f"{path}: The file has more than {limit} bytes, the most that is read. "
            "Check that it is the file you meant."
        )
    return data


def read_text(path: Path, limit: int, error: type[SceneprintError]) -> str:
    """Return a UTF-8 text file of at most `limit` bytes; raises as `read_bytes`."""
    try:
        return read_bytes(path, limit, error).decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(
            f"{path}: The file is no text ({cause.reason} at byte {cause.start}). "
            "Check that it is the file you meant."
        ) from cause


def read_object(
    path: Path, limit: int, error: type[SceneprintError], example: str
) -> dict[str, object]:
    """Return the object of a JSON file.

    Parameters
    ----------
    path, limit, error : see `read_text`
    example : what such a file looks like, for errors

    Raises
    ------
    SceneprintError : as `read_text`; or it is no JSON, or no object. It names the file.
    """
    text = read_text(path, limit, error)
    with naming(str(path)):
        try:
            fields = json.loads(text)
        except (ValueError, RecursionError) as cause:
            raise error(f"This is not JSON ({cause}). Write it such as {example}.") from cause
        if not isinstance(fields, dict):
            raise error(f"This is no JSON object. Write it such as {example}.")
    return fields


def data_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and content of the lines that are neither empty nor a # comment."""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.strip()
        if content and not content.startswith("#"):
            yield number, content
