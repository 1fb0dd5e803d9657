"""Both solvers over grids and meshes of several sizes; how the cost grows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from pipeline.adapters.joint_work import Joint, SolverSettings
from pipeline.kinematics.body_frames import scan_pose
from pipeline.kinematics.sweep import Found, Place, kept, spine, walk_grid
from pipeline.kinematics.table import Grid
from tests.bench import Figure, seconds
from tests.bench.knees import Knee, cases, knee

JOBS = 2
TRIANGLES = (10_000, 20_000, 40_000, 80_000)
#: Rows and columns over 0..120 deg of flexion and -5..5 deg of varus; the second is the default grid.
GRIDS = ((11, 11), (121, 11), (250, 20))
DEFAULT = GRIDS[1]
STANDARD = 40_000
#: Neighbouring cells that the incremental solver does, from the scan on.
SLOW_CELLS = 6


def grid(shape: tuple[int, int]) -> Grid:
    """A grid of so many rows and columns over the clinical range."""
    return Grid(np.linspace(0.0, 120.0, shape[0]), np.linspace(-5.0, 5.0, shape[1]))


def sweep(joint: Joint, one: Knee, wanted: Grid) -> dict[Place, Found]:
    """A stable pose for every cell: the spine, out and back, then the ribs."""
    scan, (flexion, varus) = scan_pose(one.anatomy.scan_attitude), one.anatomy.scan_attitude[:2]
    return kept(walk_grid(wanted, (flexion, varus), scan, lambda walks: joint.walk(walks, lambda _: None)))


def sweep_seconds(one: Knee, shape: tuple[int, int], repeats: int) -> float:
    """Median time of a sweep by the direct solver, its bodies prepared and the machine code loaded."""
    joint = Joint(one.pair, SolverSettings(), JOBS)
    sweep(joint, one, grid((2, 3)))
    return seconds(partial(sweep, joint, one, grid(shape)), repeats)


def incremental_cells_per_s(one: Knee) -> float:
    """Cells that the incremental solver does in a second on the same cores, one degree apart from the scan on.

    Every worker walks the same cells, so that both cores are as busy as in a sweep.
    """
    joint = Joint(one.pair, SolverSettings(name="incremental"), JOBS)
    scan, (flexion, varus) = scan_pose(one.anatomy.scan_attitude), one.anatomy.scan_attitude[:2]
    cells = Grid(np.floor(flexion) + np.arange(1.0, SLOW_CELLS + 1.0), np.array([varus]))
    walk = spine(cells, flexion, varus, scan)[0]
    joint.walk([walk._replace(cells=(), attitudes_deg=())] * JOBS, lambda _: None)
    start = time.perf_counter()
    joint.walk([walk] * JOBS, lambda _: None)
    return JOBS * len(walk.cells) / (time.perf_counter() - start)


def exponent(sizes: tuple[int, ...], times: list[float]) -> float:
    """Slope of log time over log size: 1 is linear."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def figures(folder: Path) -> Iterator[Figure]:
    """Every knee, every size of mesh, every size of grid."""
    for name, case in cases(folder):
        yield from _knee_figures(name, case, folder)


def _knee_figures(name: str, case: Path, folder: Path) -> Iterator[Figure]:
    times = []
    for triangles in TRIANGLES:
        one = knee(name, case, folder, triangles)
        if triangles == STANDARD:
            standard = one
        times.append(sweep_seconds(one, DEFAULT, 3))
        cells = DEFAULT[0] * DEFAULT[1]
        yield Figure(f"{name}_sweep_{triangles // 1000}k_s", times[-1], "s", f"{cells / times[-1]:.0f} cells a second")
    yield from _summary(name, standard, times)


def _summary(name: str, one: Knee, times: list[float]) -> Iterator[Figure]:
    standard = times[TRIANGLES.index(STANDARD)]
    by_grid = [standard if shape == DEFAULT else sweep_seconds(one, shape, 1) for shape in GRIDS]
    cells = tuple(rows * columns for rows, columns in GRIDS)
    for count, took in zip(cells, by_grid, strict=True):
        yield Figure(f"{name}_sweep_{count}_cells_s", took, "s", f"{1e3 * took / count:.2f} ms a cell")
    slow = incremental_cells_per_s(one)
    fast = DEFAULT[0] * DEFAULT[1] / standard
    yield Figure(f"{name}_incremental_cells_per_s", slow, "1/s", "the paper's solver on the same bodies and cores")
    yield Figure(f"{name}_direct_cells_per_s", fast, "1/s", f"{fast / slow:.0f} times the incremental solver")
    yield Figure(f"{name}_speedup_over_incremental", fast / slow, "")
    yield Figure(f"{name}_growth_cells_exponent", exponent(cells, by_grid), "", "1 is linear in cells")
    yield Figure(f"{name}_growth_triangles_exponent", exponent(TRIANGLES, times), "", "1 is linear in triangles")


#: Figures of the knee that counts most, under the names that do not say which it was.
HEADLINES = (
    "sweep_1331_cells_s",
    "speedup_over_incremental",
    "growth_cells_exponent",
    "growth_triangles_exponent",
)


def headlines(measured: dict[str, float]) -> dict[str, float]:
    """The same figures of the real knee, or of the phantom where there is none."""
    chosen = "knee_mr_a" if "knee_mr_a_sweep_1331_cells_s" in measured else "phantom"
    return {name: measured[f"{chosen}_{name}"] for name in HEADLINES}
