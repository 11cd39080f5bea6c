"""Models, model files and pair tables."""

from sceneprint.models.model import SCHEMA_VERSION, Model, ModelParameters
from sceneprint.models.model_file import (
    build_table,
    default_cache_dir,
    open_table,
    parse_model,
    read_model,
    save_model,
    write_model,
)
from sceneprint_client.api.maps import PRESETS

__all__ = [
    "PRESETS",
    "SCHEMA_VERSION",
    "Model",
    "ModelParameters",
    "build_table",
    "default_cache_dir",
    "open_table",
    "parse_model",
    "read_model",
    "save_model",
    "write_model",
]
