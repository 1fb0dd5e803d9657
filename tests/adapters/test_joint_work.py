"""What is asked of the solvers of one joint: who answers, in which order, for any number of jobs."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.adapters.joint_work import Joint, SolverName, SolverSettings, claims
from pipeline.kinematics.cell import NO_CERTIFICATE, Claim
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.cross_check import Recheck
from pipeline.kinematics.incremental import StablePose
from pipeline.kinematics.solvers import NO_MARGIN
from pipeline.kinematics.sweep import Certified, Found, Release, go, let_go, spine
from pipeline.kinematics.table import Grid, Status
from tests.kinematics.hollow_joint import PROOF, REST_MM, SETTINGS, direct, hollow_pair, incremental

GRID = Grid(np.array([0.0, 10.0]), np.array([0.0]))
SCAN = Pose(0.5, -0.3, 5.0, 0.0)
SOLVERS: tuple[SolverName, ...] = ("direct", "incremental")


def joint(name: SolverName, jobs: int = 1) -> Joint:
    return Joint(hollow_pair(), SolverSettings(name=name, incremental=SETTINGS, proof=PROOF), jobs)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_joint_is_solved_by_the_solver_it_is_given(name: SolverName, jobs: int) -> None:
    solver = direct() if name == "direct" else incremental()
    walks, finished = [*spine(GRID, 0.0, 0.0, SCAN)] * 2, list[int]()
    assert joint(name, jobs).walk(walks, finished.append) == [go(solver, walk) for walk in walks]
    assert sorted(finished) == [0, 1]
    releases = [Release(5.0, 0.0, SCAN, away) for away in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))]
    assert joint(name, jobs).release(releases) == [let_go(solver, one) for one in releases]


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_sample_is_solved_by_the_other_solver_and_every_pose_is_proven(name: SolverName, jobs: int) -> None:
    other = incremental() if name == "direct" else direct()
    asked = [Recheck((0, 0), (0.0, 0.0), SCAN, SCAN), Recheck((1, 0), (10.0, 0.0), SCAN, SCAN)]
    # the ball's highest point is a corner of it, and so is the bowl's
    poses = [Pose(0.0, 0.0, REST_MM - way, 0.0) for way in (1e-4, -3e-4, 6e-3)]
    proofs, answers = joint(name, jobs).prove([Claim((0.0, 0.0), pose, NO_CERTIFICATE) for pose in poses], asked)
    assert [(one.gap_before_mm, one.gap_after_mm) for one in proofs] == [(0.0, 2e-4), (1e-3, 0.0), (0.0, 1e-2)]
    assert answers == [other.at((float(np.radians(f)), 0.0)).solve(SCAN, SCAN) for f in (0.0, 10.0)]


def test_without_a_sample_nothing_is_answered() -> None:
    assert joint("direct").prove([]) == ([], [])


def test_what_is_certified_is_claimed_at_its_attitude() -> None:
    rest = StablePose(Pose(0.0, 0.0, REST_MM, 0.0), Status.OK, 3, 0)
    lost = StablePose(SCAN, Status.SLID_OFF, 3, 0)
    found = {(0, 0): Found(SCAN, lost), (1, 0): Found(SCAN, rest)}
    known = joint("direct").certify(GRID, found)
    assert set(known) == {(1, 0)}
    claimed = claims(GRID, found, known)
    assert claimed == {(1, 0): Claim((float(np.radians(10.0)), 0.0), rest.pose, known[(1, 0)].certificate)}


def test_claims_are_in_the_order_of_what_is_known() -> None:
    cells = [(1, 0), (0, 0)]
    found = {at: Found(SCAN, StablePose(SCAN, Status.OK, 0, 0)) for at in cells}
    known = dict.fromkeys(cells, Certified(NO_CERTIFICATE, NO_MARGIN))
    assert list(claims(GRID, found, known)) == cells
