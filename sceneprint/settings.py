"""All that an operator can set, in one place; built once, then handed down."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

from sceneprint.models import default_cache_dir


class Settings(BaseSettings):
    """Read from the environment: SCENEPRINT_<FIELD>. Nothing has to be set."""

    model_config = SettingsConfigDict(env_prefix="SCENEPRINT_", frozen=True)

    #: Folder of derived files (pair tables). Deleting it loses nothing but seconds.
    cache_dir: Path = Field(default_factory=default_cache_dir)
