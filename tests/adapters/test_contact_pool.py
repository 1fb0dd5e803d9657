"""Contact work over processes: order kept, results independent of their number, failures brought home."""

from __future__ import annotations

import os

import numpy as np
import pytest

from pipeline.adapters.contact_pool import ContactPair, map_contact
from pipeline.errors import EnvironmentFault
from pipeline.geometry.mesh import TriangleMesh
from tests.adapters.pool_work import depth_at, die, refuse
from tests.kinematics.hollow_joint import BALL_MM, FACETS_MM, REST_MM, hollow_pair

TASKS = [1.0, -2.0, 0.0, 3.0, 0.5]


def test_one_job_works_here_with_one_pair_of_bodies() -> None:
    finished: list[int] = []
    results = map_contact(depth_at, TASKS, hollow_pair(), 1, finished.append)
    assert {process for _, process, _ in results} == {os.getpid()}
    assert len({bodies for _, _, bodies in results}) == 1
    assert finished == [0, 1, 2, 3, 4]
    expected = [np.sqrt(REST_MM**2 - x**2) for x in TASKS]
    np.testing.assert_allclose([depth for depth, _, _ in results], expected, rtol=0, atol=FACETS_MM)


def test_two_jobs_give_the_same_results_in_the_same_order() -> None:
    finished: list[int] = []
    pair = hollow_pair()
    here = map_contact(depth_at, TASKS, pair, 1)
    there = map_contact(depth_at, TASKS, pair, 2, finished.append)
    assert [depth for depth, _, _ in there] == [depth for depth, _, _ in here]
    assert sorted(finished) == [0, 1, 2, 3, 4]
    workers = {(process, bodies) for _, process, bodies in there}
    assert os.getpid() not in {process for process, _ in workers}
    # each worker built its bodies once
    assert len(workers) == len({process for process, _ in workers}) <= 2


def test_a_single_task_needs_no_process() -> None:
    ((_, process, _),) = map_contact(depth_at, [0.0], hollow_pair(), 8)
    assert process == os.getpid()


def test_nothing_to_do_is_nothing_done() -> None:
    assert map_contact(depth_at, [], hollow_pair(), 4) == []


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_fails_in_a_worker_reaches_the_caller(jobs: int) -> None:
    with pytest.raises(ValueError, match="task 2 cannot be done with 2562 points"):
        map_contact(refuse, [0, 1, 2, 3], hollow_pair(), jobs)


def test_compartments_are_those_beside_the_eminence() -> None:
    pair = hollow_pair()
    narrow, wide = pair.bodies(), ContactPair(pair.reference, pair.moving, BALL_MM + 1.0).bodies()
    placement = np.eye(3), np.zeros(3)
    assert narrow.compartment_gap("medial", *placement) == pytest.approx(REST_MM, abs=FACETS_MM)
    assert np.isnan(wide.compartment_gap("medial", *placement))


def test_bodies_that_cannot_be_built_are_refused_here() -> None:
    empty = TriangleMesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))
    with pytest.raises(ValueError, match="empty mesh"):
        map_contact(depth_at, [0.0], ContactPair(empty, hollow_pair().moving, 0.0), 1)


def test_a_worker_that_dies_is_the_machines_fault() -> None:
    with pytest.raises(EnvironmentFault, match=r"E-ENV-30 A worker process ended .* fewer workers"):
        map_contact(die, [1, 2, 3], hollow_pair(), 2)
