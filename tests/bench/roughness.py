"""What makes raw curves rough: ``python -m tests.bench.roughness CASE ...`` sweeps each case with several surfaces.

Prints, for every smoothing of the contact bodies and number of triangles, the median second difference of AP and of
rotation along flexion, jumps, and how far from the scan the scan pose is found again.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from pipeline.adapters.mask_surface import SurfaceSettings
from pipeline.artifacts import RAW_TABLE, SCAN_RETURNS, SWEEP_FACTS
from pipeline.config import load_settings
from pipeline.engine.outcome import Execution
from pipeline.engine.runner import CaseJob, run_case
from pipeline.flow import FLOW
from pipeline.kinematics.table import Float
from tests.end_to_end.knee_runs import Silent, left, up_to

NARROW = ("sweep.varus_min_deg=-3", "sweep.varus_max_deg=3", "sweep.cross_check_fraction=0")


class Surface(NamedTuple):
    """How the contact bodies are made."""

    iterations: int
    pass_band: float
    triangles: int


SURFACES = (
    Surface(20, 0.1, 60_000),
    Surface(20, 0.05, 60_000),
    Surface(50, 0.01, 60_000),
    Surface(100, 0.003, 60_000),
    Surface(50, 0.01, 30_000),
    Surface(50, 0.01, 120_000),
)


def bends(curve: Float) -> float:
    """Median size of the second difference along flexion of a table of one coordinate (F, V)."""
    return float(np.nanmedian(np.abs(np.diff(curve, n=2, axis=0))))


def line(case: Path, surface: Surface) -> str:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        settings = load_settings(FLOW, case, "clinical", (*NARROW, f"contact.triangles={surface.triangles}"))
        job = CaseJob(case.name, case, Path(folder) / case.name)
        made = partial(SurfaceSettings, iterations=surface.iterations, pass_bands=(surface.pass_band,))
        with patch("pipeline.stages.contact.SurfaceSettings", made):
            run_case(job, up_to("sweep"), settings, Execution(jobs=2), Silent())
        raw, after = left(job.results, RAW_TABLE), left(job.results, SWEEP_FACTS).jumps_after
        settled = [one for one in left(job.results, SCAN_RETURNS) if one.settled]
    return (
        f"{case.name:<12}{surface.iterations:>6}{surface.pass_band:>7g}{surface.triangles:>9}"
        f"{bends(raw.poses.anterior_mm):>9.3f} mm{bends(raw.poses.internal_rotation_deg):>8.3f} deg"
        f"{after.count:>6} jumps{max(one.shift_mm for one in settled):>8.3f} mm"
        f"{max(one.rotation_deg for one in settled):>8.3f} deg"
    )


def main(cases: list[Path]) -> None:
    """Print the table."""
    sys.stdout.write("case     iterations band triangles  AP bends, rotation bends, jumps left, scan pose off by\n")
    for case in cases:
        for surface in SURFACES:
            sys.stdout.write(line(case, surface) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
