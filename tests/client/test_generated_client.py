"""Test that a client generated from the OpenAPI document works, without any code of ours."""

import importlib
import io
import json
import subprocess
import sys

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import Client, meta_of


@pytest.mark.thorough
def test_a_generated_client_maps_and_localizes(
    service_url, map_name, tmp_path, references, monkeypatch
):
    pytest.importorskip("openapi_python_client")
    document, options = tmp_path / "openapi.json", tmp_path / "options.yaml"
    response = httpx.get(f"{service_url}/openapi.json", timeout=PATIENCE_S)
    document.write_text(response.text)
    options.write_text("post_hooks: []")
    command = [sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none"]
    subprocess.run(
        [*command, "--path", document, "--config", options, "--output-path", tmp_path / "places"],
        check=True, capture_output=True, timeout=PATIENCE_S,
    )  # fmt: skip
    names = {operation["operationId"] for path in json.loads(document.read_text())["paths"].values()
             for operation in path.values()}  # fmt: skip
    assert {path.stem for path in tmp_path.glob("places/api/*/*.py")} == names | {"__init__"}
    monkeypatch.syspath_prepend(tmp_path)
    places, models, types = (importlib.import_module(f"places{one}") for one in
                             ("", ".models", ".types"))  # fmt: skip
    api = {name: importlib.import_module(f"places.api.{name}") for name in
           ("maps.create_map", "frames.add_frame", "queries.localize", "queries.ask",
            "frames.list_frames", "maps.get_map")}  # fmt: skip
    reference = references[0]

    def form():
        meta = models.FrameMeta.from_dict(meta_of(reference).model_dump(mode="json"))
        return {"frame": types.File(io.BytesIO(reference.path.read_bytes()), "a"), "meta": meta}

    patience = httpx.Timeout(PATIENCE_S)
    with places.Client(service_url, timeout=patience) as client:
        new = models.NewMap(name=map_name, model=models.NewMapModel.DEPTH)
        assert api["maps.create_map"].sync(client=client, body=new).revision == 0
        body = models.AddFrameFilesBody(**form())
        added = api["frames.add_frame"].sync(map_name, client=client, body=body)
        assert isinstance(added, models.Added), added
        with Client(service_url) as waiting:
            waiting.wait([added.job_id], timeout_s=PATIENCE_S)
        page = api["frames.list_frames"].sync(map_name, client=client)
        assert [frame.frame_id for frame in page.items] == [added.frame_id]
        assert page.items[0].captured_at is None
        body = models.LocalizeFilesBody(**form(), k=1)
        response = api["queries.localize"].sync(map_name, client=client, body=body)
        assert response.matches == [added.frame_id]
        named = models.AskJsonBody(added.frame_id)
        assert api["queries.ask"].sync(map_name, client=client, body=named).counts.map_ == 0
        problem = api["maps.get_map"].sync("nowhere", client=client)
        assert (problem.status, problem.type_) == (404, "/problems/unknown-map")
