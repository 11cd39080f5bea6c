"""Tests of statistics over several processes, and of request ids in all answers."""

import json
import logging
import resource
from pathlib import Path

from sceneprint import process
from sceneprint.process import JsonFormatter, name_request, of_request, request_id
from sceneprint.settings import Settings
from sceneprint.store.store_counts import samples_since
from sceneprint_client.api import Answer
from service.metrics import Sampler
from tests.whole_engine import Engine


def test_all_figures_are_there(served, make_map, until):
    make_map(served, "plain")

    def figures():
        lines = served.client.get("/metrics").text.splitlines()
        pairs = (line.rpartition(" ")[::2] for line in lines if not line.startswith("#"))
        return {name: float(value) for name, value in pairs}

    def worked():
        seen = figures()
        return sum(int(seen[f'sceneprint_workers{{state="{one}"}}']) for one in ("idle", "busy"))

    def have_begun():  # workers start after the service
        return worked() == len(served.workers) and figures()["sceneprint_workers_began"] >= 1

    until(have_begun)
    values = figures()
    assert values['sceneprint_index_tail_frames{map="plain"}'] == 0
    assert values["sceneprint_maps"] >= 1
    assert values["sceneprint_disk_free_bytes"] > 0
    assert values['sceneprint_disk_bytes{part="database"}'] > 0
    received = 'sceneprint_received_bytes_total{route="/v1/maps"}'
    assert values[received] >= len(
        json.dumps({"name": "plain", "model": "depth"}, separators=(",", ":"))
    )


def test_models_and_reencoding_over_http(served, make_map, refused):
    path, client = make_map(served, "anew"), served.client
    listed = client.get("/v1/models").json()["items"]
    depth = next(one for one in listed if one["name"] == "depth")
    assert "anew" in depth["maps"]
    place = f"{path}/reencoding"
    refused(client.post("/v1/maps/nowhere/reencoding", json={"model": "paper"}), 404, "unknown-map")
    refused(client.post(place, json={"model": depth["model_id"]}), 409, "conflict")
    refused(client.delete(place), 409, "conflict")
    begun = client.post(place, json={"model": "paper"})
    assert begun.status_code == 202
    assert begun.json()["name"] == "anew"


def answered(status, seconds):
    return Answer.model_construct(status=status, milliseconds={"total": 1e3 * seconds})


def test_a_sample_is_written_where_something_was_counted(tmp_path):
    sampler = Sampler()
    with Engine(Settings(data_dir=tmp_path)) as engine:
        store = engine.store.database
        assert not sampler.flush(store)  # nothing happened: nothing is written
        for status in (200, 200, 404):
            sampler.request(status)
        sampler.answer(answered("found", 0.1))
        assert sampler.flush(store)
        assert not sampler.flush(store)
        with store.read() as connection:
            (kept,) = samples_since(connection, "service", 0.0)
        assert kept.data["statuses"] == {"200": 2, "404": 1}
        assert kept.data["queries"] == {"found": 1}
        assert sum(kept.data["latencies"].values()) == 1


def test_an_id_goes_with_its_request_to_the_worker(served, make_map, until):
    path, asked = make_map(served, "named"), {"X-Request-Id": "robot-7.42"}
    wrong = served.client.post("/v1/maps/nowhere/frames", headers=asked)
    assert wrong.json()["instance"] == "/requests/robot-7.42"
    wall = {"files": {"frame": ("w.npy", flat(), "application/octet-stream")}}
    meta = {"intrinsics": {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 32, "cy": 24}}
    sent = served.client.post(
        f"{path}/frames", **wall, data={"meta": json.dumps(meta)}, headers=asked
    )
    assert sent.status_code == 202, sent.text
    url = f"{path}/frames/{sent.json()['frame_id']}"
    until(lambda: served.client.get(url).json()["state"] in ("rejected", "indexed"))
    until(lambda: [line for line in served.log() if line.get("request_id") == "robot-7.42"
                   and line["logger"].startswith("sceneprint.engine")])  # fmt: skip


def flat():
    import io

    import numpy as np

    out = io.BytesIO()
    depth = np.zeros((48, 64), np.float32)
    depth[10:13, 10:14] = 2.0
    np.save(out, depth)
    return out.getvalue()


def test_lines_name_the_request_that_is_worked_on():
    def line():
        record = logging.LogRecord("a", logging.INFO, "", 0, "text", None, None)
        return json.loads(JsonFormatter().format(record))

    assert "request_id" not in line()
    with of_request("one"):
        assert line()["request_id"] == "one"
        with of_request(None):
            assert "request_id" not in line()
        assert request_id() == "one"
    assert request_id() is None
    with of_request("two"):
        name_request("three")
        assert line()["request_id"] == "three"
    assert request_id() is None


def test_as_many_files_may_be_open_as_the_system_lets(served):
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    wanted = process.MOST if hard == resource.RLIM_INFINITY else min(hard, process.MOST)
    for pid in (served.process.pid, *served.workers):
        text = Path(f"/proc/{pid}/limits").read_text()
        (line,) = [one for one in text.splitlines() if one.startswith("Max open files")]
        assert int(line.split()[3]) >= wanted
