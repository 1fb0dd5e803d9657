"""The ball in the dish and the bar on the pyramids: the worst error over several starts, by both solvers.

The incremental solver at steps small and large, the direct one as it is.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.validation_objects import BallInDish, BarOnPyramids, ValidationPair
from pipeline.kinematics.certificate import equilibrium_residual
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.direct.prepare import prepare
from pipeline.kinematics.direct.solver import DirectSolver
from pipeline.kinematics.incremental import IncrementalSettings, solve_incremental
from pipeline.kinematics.table import Status
from tests.kinematics.settings import BALL_STARTS, BAR_STARTS, FINE, FINE_BAR, LARGE_MM, with_steps
from tests.kinematics.shapes import HelicalGroove, at_attitude, falling
from tests.validate import Row

Float = NDArray[np.float64]


def _rests(pair: ValidationPair, starts: list[Pose], settings: IncrementalSettings, large_mm: float) -> Float:
    """(N, 5) x, y, z, theta and residual of every start; NaN where no stable pose was found."""
    contact, rows = falling(pair), []
    direct = DirectSolver(prepare(pair.reference_body, pair.moving_body)).at((0.0, 0.0))
    for start in starts:
        found = direct.solve(start)
        ok = found.status is Status.OK
        rows.append((*found.pose, direct.certify(found.pose).residual) if ok else (np.nan,) * 5)
    for chosen in (settings, with_steps(settings, large_mm)):
        for start in starts:
            found = solve_incremental(contact, start, chosen)
            residual = equilibrium_residual(contact.contacts(found.pose, chosen.contact_band_mm))
            rows.append((*found.pose, residual) if found.status is Status.OK else (np.nan,) * 5)
    return np.array(rows)


@cache
def _ball() -> Float:
    return _rests(BallInDish().pair(), BALL_STARTS, FINE, LARGE_MM["ball"])


@cache
def _bar() -> Float:
    return _rests(BarOnPyramids().pair(), BAR_STARTS, FINE_BAR, LARGE_MM["bar"])


def ball_off_centre() -> Row:
    """Distance of the ball's centre from the dish's axis."""
    return Row("ball_mm", "ball in dish: off the axis", float(np.hypot(_ball()[:, 0], _ball()[:, 1]).max()), "mm", 0.02)


def ball_height() -> Row:
    """Height of the ball's centre against its radius."""
    return Row("ball_height_mm", "ball in dish: height", float(np.abs(_ball()[:, 2] + 6.0).max()), "mm", 0.02)


def ball_equilibrium() -> Row:
    """What the contacts do not balance of a unit push."""
    return Row("ball_residual", "ball in dish: equilibrium residual", float(_ball()[:, 4].max()), "", 0.01)


def bar_sideways() -> Row:
    """Displacement of the bar from the middle."""
    return Row("bar_mm", "bar on pyramids: sideways", float(np.abs(_bar()[:, 0]).max()), "mm", 0.02)


def bar_height() -> Row:
    """Height of the bar against the closed form."""
    return Row(
        "bar_height_mm",
        "bar on pyramids: height",
        float(np.abs(_bar()[:, 2] + BarOnPyramids().rest_height_mm).max()),
        "mm",
        0.02,
    )


def bar_turn() -> Row:
    """Turn that the torque left."""
    return Row("bar_deg", "bar on pyramids: turn", float(np.degrees(np.abs(_bar()[:, 3]).max())), "deg", 0.05)


def bar_equilibrium() -> Row:
    """What the contacts do not balance of a unit push."""
    return Row("bar_residual", "bar on pyramids: equilibrium residual", float(_bar()[:, 4].max()), "", 0.01)


@cache
def _runner() -> Float:
    """(N, 4) found minus closed form of the runner in the helical groove, by both solvers; NaN without a pose."""
    groove, rows = HelicalGroove(), []
    bodies = groove.reference_body(), groove.moving_body()
    direct = DirectSolver(prepare(*bodies))
    for flexion in np.radians([-35.0, -10.0, 0.0, 10.0, 30.0]):
        angles, wanted = (float(flexion), 0.0), groove.rest(float(flexion))
        start = Pose(wanted.x + 0.6, 1.0, wanted.z - 8.0, wanted.theta + 0.05)
        for found in (direct.at(angles).solve(start), solve_incremental(at_attitude(*bodies, *angles), start, FINE)):
            rows.append(np.subtract(found.pose, wanted) if found.status is Status.OK else np.full(4, np.nan))
    return np.array(rows)


def groove_place() -> Row:
    """Place of the runner, which the groove dictates at each flexion."""
    return Row("groove_mm", "runner in helical groove: place", float(np.abs(_runner()[:, :3]).max()), "mm", 0.02)


def groove_turn() -> Row:
    """Rotation of the runner, which the groove dictates at each flexion."""
    turn = float(np.degrees(np.abs(_runner()[:, 3]).max()))
    return Row("groove_deg", "runner in helical groove: rotation", turn, "deg", 0.05)


ROWS = (
    ball_off_centre,
    ball_height,
    ball_equilibrium,
    bar_sideways,
    bar_height,
    bar_turn,
    bar_equilibrium,
    groove_place,
    groove_turn,
)
