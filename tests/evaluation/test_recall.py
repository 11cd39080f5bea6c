"""Tests of recall and travelled distance against manual results."""

import numpy as np

from sceneprint_lab.evaluation.measures import metres_apart, recall
from sceneprint_lab.evaluation.protocol import SignedFrame, travelled


def member(name, x, y=0.0, scene="hall"):
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return SignedFrame(0, name, scene, pose, np.zeros(4, np.uint8))


def test_recall_by_hand():
    relevant = np.array([[1, 0, 1], [0, 0, 1], [0, 1, 0], [0, 0, 0]], bool)
    allowed = np.array([[1, 1, 0], [1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
    # the first finds at once; the second at the third place; of the third what is relevant may
    # not be found, and the fourth has nothing: neither counts
    rankings = [[0, 1], [0, 1, 2], [0, 2], [0, 1, 2]]
    found = recall(relevant, allowed, rankings)
    assert found == {"queries": 2, "at_1": 0.5, "at_5": 1.0, "at_10": 1.0}
    nothing = recall(np.zeros((1, 3), bool), np.ones((1, 3), bool), [[0]])
    assert nothing == {"queries": 0, "at_1": None, "at_5": None, "at_10": None}


def test_poses_of_two_scenes_are_not_compared():
    found = metres_apart([member("a/1", 0)], [member("a/2", 3, 4), member("b/1", 0, 0, "shed")])
    np.testing.assert_array_equal(found, [[5.0, np.inf]])


def test_travel_leads_through_all_frames_of_a_run():
    # out to 3 m and back: frame 10 comes after frame 9, at the place of frame 1
    run = [member("hall/1", 0), member("hall/9", 3), member("hall/10", 0)]
    other = member("hall/b/1", 0)
    found = travelled([run[2], run[0], other], [run[0], run[1], run[2], other])
    np.testing.assert_array_equal(
        found, [[6, 3, 0, np.inf], [0, -3, -6, np.inf], [np.inf, np.inf, np.inf, 0]]
    )
