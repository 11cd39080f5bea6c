"""Tests of secrets in files instead of environment variables."""

import os
import subprocess
import sys

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest
from sceneprint.process import SECRETS, read_secret_files


def test_a_file_holds_what_its_variable_would(tmp_path):
    password, other = tmp_path / "password", tmp_path / "other"
    password.write_bytes(b" pass word\r\n")
    other.write_text("s3cret")
    variables = {
        "PGPASSWORD_FILE": str(password), "AWS_SECRET_ACCESS_KEY_FILE": str(other),
        "SSL_CERT_FILE": "/none", "PGUSER_FILE": "/none", "AWS_ACCESS_KEY_ID_FILE": "",
    }  # fmt: skip
    read_secret_files(variables)
    assert variables == {
        "PGPASSWORD": " pass word", "AWS_SECRET_ACCESS_KEY": "s3cret",
        "SSL_CERT_FILE": "/none", "PGUSER_FILE": "/none", "AWS_ACCESS_KEY_ID_FILE": "",
    }  # fmt: skip


def test_what_is_no_secret_is_refused_and_never_shown(tmp_path):
    path, name = tmp_path / "secret", SECRETS[0]
    for content, said in (
        (None, "No such file"), (b"", "does not contain a secret"), (b"a\nhunter2", "one line"),
        (b"hunter2" * 9999, "one line"), (b"hunter2\xff", "not UTF-8"), (b"hunter2\0", "one line"),
    ):  # fmt: skip
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InvalidRequest, match=f"^{name}_FILE: .*{said}") as caught:
            read_secret_files({f"{name}_FILE": str(path)})
        assert "hunter2" not in str(caught.value)
    with pytest.raises(InvalidRequest, match="both set"):
        read_secret_files({f"{name}_FILE": str(path), name: "x"})


@pytest.mark.parametrize("command", [["sceneprint", "keys", "--list"], ["service"]])
def test_every_command_reads_them(command, tmp_path):
    path = tmp_path / "url"
    path.write_text("nothing://robot:hunter2@host/name\n")
    settings = {**os.environ, "SCENEPRINT_DATABASE_URL_FILE": str(path), "SCENEPRINT_PORT": "0"}
    settings.pop("SCENEPRINT_DATABASE_URL", None)
    done = subprocess.run(
        [sys.executable, "-m", *command], env=settings, capture_output=True, text=True,
        timeout=PATIENCE_S, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2
    assert "'nothing' is not a supported database" in done.stderr
    assert "hunter2" not in done.stderr
