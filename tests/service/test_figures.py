"""Tests of statistics over several processes, and of request ids in all answers."""

import json
import resource
from pathlib import Path

from sceneprint import process


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


def test_an_id_goes_with_its_request_to_the_worker(served, make_map, small_shots, until):
    path, named = make_map(served, "named"), {"X-Request-Id": "robot-7.42"}
    wrong = served.client.post("/v1/maps/nowhere/frames", headers=named)
    assert wrong.json()["instance"] == "/requests/robot-7.42"
    sent = served.client.post(f"{path}/frames", **small_shots[40].form(), headers=named)
    assert sent.status_code == 202, sent.text
    until(lambda: [line for line in served.log() if line.get("request_id") == "robot-7.42"
                   and line["logger"].startswith("sceneprint.engine")])  # fmt: skip


def test_as_many_files_may_be_open_as_the_system_lets(served):
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    wanted = process.MOST if hard == resource.RLIM_INFINITY else min(hard, process.MOST)
    for pid in (served.process.pid, *served.workers):
        text = Path(f"/proc/{pid}/limits").read_text()
        (line,) = [line for line in text.splitlines() if line.startswith("Max open files")]
        assert int(line.split()[3]) >= wanted
