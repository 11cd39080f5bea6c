"""Tests that answers over HTTP equal those of `sceneprint evaluate`."""

import json
import subprocess
import sys

import pytest

from sceneprint.formats.dataset import find_sequences
from sceneprint_client import Client, meta_of
from sceneprint_lab.cli.demo import serving


def evaluate(folder, *arguments):
    out = folder / "figures.json"
    subprocess.run(
        [sys.executable, "-m", "sceneprint", "evaluate", *arguments, "--json", str(out)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return json.loads(out.read_text())


def told(answer, names):
    """The matches of an answer as `per_query` of an evaluation tells them."""
    return [
        {
            "match": names[match.frame_id],
            "distance": match.distance,
            "status": match.validation.status,
            "strength": match.validation.strength,
            "T_match_query": None if match.transform is None else match.transform.matrix,
        }
        for match in answer.matches
    ]


def check(folder, expected, database, queries):
    """Ask a service of the same frames, and compare to the last bit."""
    data = folder / "data"
    data.mkdir()
    with serving(data, workers=1) as url, Client(url) as client:
        client.create_map("same")
        added = {name: client.upload("same", frame) for name, frame in database.items()}
        client.wait([one.job_id for one in added.values()])
        names = {one.frame_id: name for name, one in added.items()}
        assert [one["name"] for one in expected["per_query"]] == list(queries)
        for one in expected["per_query"]:
            frame = queries[one["name"]]
            meta = meta_of(frame, with_pose=False)
            answer = client.query("same", frame.path, meta, k=10, exact=True)
            assert answer.exact
            # an evaluation searches each pair: what others guide, or lies elsewhere, it has not
            chosen = [match for match in answer.matches if match.selected]
            guided = {names[m.frame_id] for m in chosen if m.validation.search == "guided"}
            served = told(answer.model_copy(update={"matches": chosen}), names)
            assert [pair for pair in served if pair["match"] not in guided] == [
                pair for pair in one["matches"] if pair["match"] not in guided
            ]
            by_rank = sorted(chosen, key=lambda match: match.rank)
            assert [names[match.frame_id] for match in by_rank] == one["selection"]
            ranked = client.query("same", frame.path, meta, k=10, stages=("retrieve",), exact=True)
            assert [names[match.frame_id] for match in ranked.matches] == one["ranking"]


@pytest.mark.thorough
def test_redkitchen_over_http_is_redkitchen_evaluated(data_root, tmp_path):
    recording = data_root / "7scenes" / "redkitchen"
    figures = evaluate(
        tmp_path, str(recording), "--db", "0:600:15", "--queries", "650:1000:44", "--jobs", "1"
    )
    frames = [frame for sequence in find_sequences(recording) for frame in sequence.frames]
    assert figures["counts"] == {"queries": 8, "database": 40, "left_out": 0}

    def named(some):
        return {f"redkitchen/{frame.name}": frame for frame in some}

    check(tmp_path, figures, named(frames[0:600:15]), named(frames[650:1000:44]))
