"""Models made ready to sign, each once a process."""

from __future__ import annotations

import threading
from pathlib import Path

from sceneprint.models import Model, parse_model
from sceneprint.pipeline import Signer, open_signer
from sceneprint.store import Database
from sceneprint.store.maps import model_content


class Signers:
    """Signers by the id of their model; the model's file is the one in the database.

    Parameters
    ----------
    database : that holds the models
    cache_dir : of pair tables
    """

    def __init__(self, database: Database, cache_dir: Path) -> None:
        self.database, self._cache_dir = database, cache_dir
        self._lock = threading.Lock()
        self._open: dict[str, Signer] = {}

    def __call__(self, model_id: str) -> Signer:
        """The signer of a model that a map refers to.

        Raises
        ------
        UnreadableModel : another version of sceneprint stored it.
        """
        with self._lock:  # building a table takes seconds: once is enough
            if model_id not in self._open:
                with self.database.read() as connection:
                    content = model_content(connection, model_id)
                model = parse_model(content, f"model {model_id[:12]}")
                self._open[model_id] = open_signer(model, self._cache_dir)
            return self._open[model_id]

    def of(self, model: Model) -> Signer:
        """The signer of a model that no map may refer to yet."""
        with self._lock:
            if model.id not in self._open:
                self._open[model.id] = open_signer(model, self._cache_dir)
            return self._open[model.id]
