"""Tests of the HTML that notebooks show for records."""

import xml.etree.ElementTree as ElementTree

from sceneprint_client.api import Answer, Match
from sceneprint_client.api.base import Transform
from sceneprint_client.api.query import Alternative, Validation

EVIL = "<script>alert('&\"')</script>"


def pose(x, y):
    """A camera that looks along y, with z up."""
    axes = [[1, 0, 0, x], [0, 0, 1, y], [0, -1, 0, 1.5], [0, 0, 0, 1]]
    return Transform.model_validate(
        {"parent_frame": "hall", "child_frame": "query.optical", "matrix": axes,
         "translation": {"x": x, "y": y, "z": 1.5}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    )  # fmt: skip


def match(rank, frame_id):
    validation = Validation.model_construct(status="accepted", overlap=0.8125, reason="")
    return Match.model_construct(
        rank=rank, frame_id=frame_id, map="hall", similarity=0.75, validation=validation
    )


def cells(table):
    return [[cell.text for cell in row] for row in table]


def test_an_answer_has_a_plan_and_its_matches():
    answer = Answer.model_construct(
        query_id="q1", status="ambiguous", reason=EVIL, location=None, maps=["hall"], seed=7,
        alternatives=[Alternative(pose=pose(0, 0), confidence=0.6, support=2),
                      Alternative(pose=pose(4, 2), support=1)],
        matches=[match(i, f"{i:032x}") for i in range(1, 11)],
    )  # fmt: skip
    html = ElementTree.fromstring(f"<div>{answer._repr_html_()}</div>")
    fields, plan, matches = html[1], html[2], html[3]
    assert dict(cells(fields)) == {
        "query_id": "q1", "status": "ambiguous", "reason": EVIL, "maps": "hall", "frames": "1",
        "alternatives": "0.00, 0.00, 1.50 m in hall, confidence 0.60; 4.00, 2.00, 1.50 m in hall",
        "kind": "depth",
    }  # fmt: skip
    # 120 pixels are 4 m; y points up
    circles = [(mark.get("cx"), mark.get("cy"), mark.get("fill")) for mark in plan.iter("circle")]
    assert circles == [("20", "140", "none"), ("140", "80", "none")]
    assert [mark.get("d") for mark in plan.iter("path")] == ["M20 140l0 -14", "M140 80l0 -14"]
    assert cells(matches)[1] == ["1", f"{1:032x}", "hall", "0.75", "0.8125", "accepted"]
    assert len(cells(matches)) == 1 + 5
    assert len(answer._repr_html_()) < 2_500
