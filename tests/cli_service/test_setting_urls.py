"""Tests of URLs, body sizes and misspelt names in settings; errors never repeat a rejected URL."""

import argparse
import traceback

import pytest
from pydantic import ValidationError

from sceneprint.cli.options import settings_of
from sceneprint.errors import InvalidRequest
from sceneprint.settings import Settings
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES

SERVER = "postgresql+psycopg://u:hunter2@host/db"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("BLOB_URL", "s3://key:hunter2@bucket/prefix", "set credentials in the environment"),
        ("INDEX_URL", "gs://bucket/p#hunter2", "set credentials in the environment"),
        ("BLOB_URL", "s3://[hunter2", "set credentials in the environment"),
        ("BLOB_URL", "hunter2://bucket", "must start with one of s3://, gs://, az://"),
        ("BLOB_URL", "", "must start with one of s3://"),
        ("BLOB_URL", "s3:///hunter2", "contains no bucket"),
    ],
)
def test_a_url_that_is_none_is_refused_and_not_repeated(monkeypatch, name, value, said):
    monkeypatch.delenv("SCENEPRINT_DATABASE_URL", raising=False)
    monkeypatch.setenv(f"SCENEPRINT_{name}", value)
    with pytest.raises(InvalidRequest, match=rf"SCENEPRINT_{name}\.$") as caught:
        settings_of(argparse.Namespace())
    assert said in str(caught.value)
    assert "hunter2" not in "".join(traceback.format_exception(caught.value))
    with pytest.raises(ValidationError) as refused:  # as `python -m worker` tells it
        Settings()
    assert "hunter2" not in str(refused.value)


def test_urls_are_taken_and_hide_what_is_in_them(monkeypatch):
    for name, value in (
        ("DATABASE_URL", SERVER), ("BLOB_URL", "s3://bucket/prefix"),
        ("INDEX_URL", "file:///srv/indexes"),
    ):  # fmt: skip
        monkeypatch.setenv(f"SCENEPRINT_{name}", value)
    settings = settings_of(argparse.Namespace())
    assert settings.database == SERVER
    assert settings.blob_url.get_secret_value() == "s3://bucket/prefix"
    assert settings.index_url == "file:///srv/indexes"
    assert "hunter2" not in repr(settings)


def test_bodies_may_be_as_large_as_a_decoder_takes(monkeypatch):
    monkeypatch.setenv("SCENEPRINT_MAX_UPLOAD_BYTES", str(MAXIMUM_CLOUD_BYTES))
    assert settings_of(argparse.Namespace()).max_upload_bytes == 536870912  # as the docs say
    monkeypatch.setenv("SCENEPRINT_MAX_UPLOAD_BYTES", str(MAXIMUM_CLOUD_BYTES + 1))
    with pytest.raises(
        InvalidRequest, match=r"less than or equal to 536870912.*MAX_UPLOAD_BYTES\.$"
    ):
        settings_of(argparse.Namespace())


def test_a_misspelt_setting_is_refused_and_variables_of_others_are_not(monkeypatch):
    for other in ("DATABASE_URL_FILE", "KEY", "URL", "X"):
        monkeypatch.setenv(f"SCENEPRINT_{other}", "1")
    settings_of(argparse.Namespace())
    for name, meant in (("QUEUD_REQUESTS", "QUEUED_REQUESTS"), ("PRT", "PORT")):
        with monkeypatch.context() as changed:
            changed.setenv(f"SCENEPRINT_{name}", "1")
            text = f"SCENEPRINT_{name} is not a setting. Did you mean SCENEPRINT_{meant}?"
            with pytest.raises(InvalidRequest) as caught:
                settings_of(argparse.Namespace())
            assert str(caught.value) == text
            with pytest.raises(ValidationError) as refused:
                Settings()
            assert text in str(refused.value)
