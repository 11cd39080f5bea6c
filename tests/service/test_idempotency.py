"""Tests of idempotency keys, which identify repeated requests."""

from __future__ import annotations

from sceneprint_client.api.base import Given
from service.auth import Caller
from service.bodies import idempotent_request


class Before(Given):
    """A record of one version."""

    robot: str | None = None


class After(Before):
    """The same in the next, which can say more."""

    gripper: str | None = "none"


def print_of(part):
    once = idempotent_request(Caller("fleet", {}), "k", "route", part)
    return once.fingerprint


def test_a_request_of_before_an_upgrade_is_the_same_after_it():
    assert print_of(After(robot="spot")) == print_of(Before(robot="spot"))
    assert print_of(After()) != print_of(After(gripper=None))
    assert print_of(After()) != print_of(After(robot="spot"))
