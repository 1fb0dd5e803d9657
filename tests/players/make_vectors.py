"""Attitudes and the poses that the Python player answers, for players in other languages: ``vectors.json``.

``.venv/bin/python -m tests.players.make_vectors`` writes the file anew.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np

from pipeline.files.lut_content import LutFileContent
from pipeline.kinematics.interpolation import Outside
from pipeline.kinematics.table import Grid, Status
from pipeline.playback import Lut
from pipeline.report.figure_viewer import player_data
from tests.files.lut_sample import content

FILE = Path(__file__).with_name("vectors.json")
COUNT = 200
GRID = Grid(np.array([-5.0, 0.0, 5.0, 10.0, 20.0, 25.0, 40.0, 45.0, 60.0, 75.0]), np.array([-4.0, -1.0, 0.0, 2.5]))
#: Columns fall into runs of one, two, three and more usable entries.
BAD = ((3, 0), (5, 0), (2, 1), (9, 1), (0, 3), (7, 3))
ABOUT = (
    "Poses of a made-up left knee, from ct2lut's Python player. data: what a player is given; degrees and millimetres. "
    "cases: an attitude and the policy outside; then either error, the words of the refusal, or moved_from_scan, 4 x 4 "
    "row by row, with the attitude used, or neither: with the policy nan a player answers all NaN. An attitude 'nan' "
    "is not a number. Players agree to 1e-9."
)


def table() -> LutFileContent:
    """The table of the vectors, with two kinds of unusable entries and one that is smoothed."""
    made = content("left", GRID, BAD)
    made.smooth.poses.status[BAD[2]] = Status.NO_CONTACT
    made.smooth.poses.status[4, 2] = Status.SMOOTHED
    return made


def vectors() -> dict[str, Any]:
    """The content of the file."""
    made = table()
    lut = Lut(made)
    return {"about": ABOUT, "data": player_data(made.table), "cases": [_case(lut, *at) for at in _attitudes()]}


def _attitudes() -> list[tuple[float, float, str]]:
    """Every entry, attitudes on lines of the grid, between them, outside, and those that are always refused."""
    rng = np.random.default_rng(20)
    nodes = [(float(f), float(v), "raise") for f in GRID.flexion_deg for v in GRID.varus_deg]
    odd = [(float("nan"), 0.0, policy) for policy in ("raise", "clamp", "nan")] + [(10.0, 0.0, "nearest")]
    lines = [(float(f), float(v), "raise") for f in (2.5, 15.0, 50.0, 74.0) for v in GRID.varus_deg]
    free = COUNT - len(nodes) - len(odd) - len(lines)
    places = np.round(rng.uniform((-20.0, -6.0), (90.0, 4.5), (free, 2)), 6).tolist()
    places[: free // 2] = np.round(rng.uniform((-5.0, -4.0), (75.0, 2.5), (free // 2, 2)), 6).tolist()
    policies = ("raise", "clamp", "nan")
    between = [(f, v, policies[number % 3]) for number, (f, v) in enumerate(places)]
    return [*nodes, *lines, *between, *odd]


def _case(lut: Lut, flexion: float, varus: float, policy: str) -> dict[str, Any]:
    outside = cast("Outside", policy)
    case: dict[str, Any] = {"flexion_deg": "nan" if np.isnan(flexion) else flexion, "varus_deg": varus}
    case |= {"outside": policy, "error": None, "moved_from_scan": None, "used": None}
    try:
        motion, used = lut.pose(flexion, varus, outside), lut.coordinates(flexion, varus, outside)
    except ValueError as error:
        return case | {"error": str(error)}
    if np.isnan(motion).any():
        return case
    return case | {"moved_from_scan": motion.ravel().tolist(), "used": [float(used[0]), float(used[1])]}


def written() -> str:
    """The text of the file: one case a line."""
    found = vectors()
    cases = ",\n".join(json.dumps(case, allow_nan=False) for case in found["cases"])
    head = ",\n".join(f"{json.dumps(name)}: {json.dumps(found[name], allow_nan=False)}" for name in ("about", "data"))
    return f'{{\n{head},\n"cases": [\n{cases}\n]\n}}\n'


if __name__ == "__main__":
    FILE.write_text(written())
