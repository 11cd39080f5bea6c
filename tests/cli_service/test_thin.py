"""`sceneprint thin`: says what can go, and deletes it when told to."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sceneprint_client import Client

Run = Callable[..., Any]


def test_what_can_go_is_said_and_with_yes_it_goes(
    sceneprint: Run, service_url: str, data_folder: Path, rooms: Path, tmp_path: Path
) -> None:
    def thin(*arguments: object, expect: int = 0) -> Any:
        return sceneprint("thin", "thick", *arguments, "--data", data_folder, expect=expect)

    sceneprint("upload", "thick", rooms, "--model", "depth")
    with Client(service_url) as client:
        model = client.map("thick").model
        said = thin("--keep", 2, "--json", tmp_path / "out.json").stdout
        lines = said.splitlines()
        assert lines[0] == f"map thick, model {model}, seed 0"
        assert re.fullmatch(
            r"4 of 6 frames are redundant, 2 stay; frees about \d+\.\d MB", lines[1]
        )
        assert lines[-1] == "nothing was deleted; add --yes to delete them"
        written = json.loads((tmp_path / "out.json").read_text())
        assert (written["frames"], written["keep"], written["novelty"]) == (6, 2, None)
        assert (written["seed"], written["session"], len(written["losses"])) == (0, None, 4)
        shares = sorted((one["share"] for one in written["losses"]), reverse=True)
        assert written["largest_share"] == shares[0]
        assert f"(median), {shares[0]:.3f} (maximum)" in lines[2]
        for line, share in zip(lines[3:7], shares, strict=True):
            (one,) = [one for one in written["losses"] if one["share"] == share]
            assert line == f"  {one['frame_id']}  {share:.3f} from {one['like']}"
        assert client.map("thick").frames == {"indexed": 6}
        assert thin("--keep", 2, "--yes").stdout == "".join(
            f"{line}\n" for line in [*lines[:-1], "4 frames deleted"]
        )
        assert client.map("thick").frames == {"deleted": 4, "indexed": 2}
        lost = {one["frame_id"] for one in written["losses"]}
        assert {f.frame_id for f in client.frames("thick", state="deleted")} == lost
        assert thin("--keep", 2, "--yes").stdout.splitlines()[1] == "none of 2 frames is redundant"
        said = thin("--novelty", "2", "--json", tmp_path / "novel.json").stdout.splitlines()
        assert said[0] == f"map thick, model {model}"
        assert said[1].startswith("1 of 2 frames are redundant, 1 stay")
        assert json.loads((tmp_path / "novel.json").read_text())["seed"] is None
        nobody = thin("--novelty", "2", "--session", "nobody's\n").stdout.splitlines()
        assert nobody == [
            f"map thick, model {model}, session nobody's\\n",
            "none of 0 frames is redundant",
        ]


def test_no_such_map(sceneprint: Run, data_folder: Path) -> None:
    said = sceneprint("thin", "nowhere", "--keep", 1, "--data", data_folder, expect=2)
    assert said.stderr.startswith("sceneprint thin: There is no map 'nowhere'")


@pytest.mark.parametrize(
    "arguments",
    [(), ("--keep", "3", "--novelty", "0.1"), ("--keep", "0"), ("--novelty", "-0.1"),
     ("--novelty", "nan"), ("--novelty", "far")],
)  # fmt: skip
def test_one_way_at_a_time(sceneprint: Run, arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit):
        sceneprint("thin", "thick", *arguments)
