"""Prints one table and writes build/bench.json: patients, contact queries, both solvers, look-up."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from pipeline.adapters.workers import get_ready
from pipeline.artifacts import ANATOMY, MOVING_BODY, REFERENCE_BODY
from pipeline.config import load_settings
from pipeline.contact_params import ContactParams
from pipeline.engine.outcome import Execution, RunOutcome
from pipeline.engine.runner import CaseJob, run_case
from pipeline.flow import FLOW
from pipeline.kinematics.body_frames import scan_pose
from pipeline.kinematics.contact import AttitudeContact
from pipeline.kinematics.descent import drop
from pipeline.playback import Lut
from tests.bench import Figure, seconds, sweeps
from tests.bench.knees import cases
from tests.bench.memory import PeakMemory
from tests.end_to_end.knee_runs import Silent, left

REPORT = Path("build/bench.json")


def patient(case: Path, folder: Path) -> tuple[RunOutcome, RunOutcome, float]:
    """A patient from labels to package with every default, and again from the cache; the seconds of the second."""
    settings = load_settings(FLOW, case, "clinical")
    job = CaseJob("bench", case, folder / "results")

    def process() -> RunOutcome:
        return run_case(job, FLOW, settings, Execution(2, get_ready), Silent())

    first = process()
    start = time.perf_counter()
    again = process()
    took = time.perf_counter() - start
    assert {stage.state for stage in again.stages} == {"cached"}
    return first, again, took


def patient_figures(first: RunOutcome, cached_s: float) -> Iterator[Figure]:
    """Each stage, the whole, and the cached run."""
    total = sum(stage.seconds for stage in first.stages)
    for stage in first.stages:
        yield Figure(f"stage_{stage.stage}_s", stage.seconds, "s", f"{stage.seconds / total:.0%} of the patient")
    yield Figure("patient_s", total, "s")
    yield Figure("cached_rerun_s", cached_s, "s", f"{total / cached_s:.0f} times quicker than the first run")


def contact_figures(results: Path) -> Iterator[Figure]:
    """Queries of the exact collision test, and a drop."""
    anatomy = left(results, ANATOMY)
    reference = left(results, REFERENCE_BODY)
    moving = left(results, MOVING_BODY)
    params = ContactParams()
    bodies = params.pair(reference, moving, anatomy).bodies()
    contact = AttitudeContact(bodies, np.radians(anatomy.scan_attitude[0]), np.radians(anatomy.scan_attitude[1]))
    rest = drop(contact, scan_pose(anatomy.scan_attitude), params.motion())
    assert rest is not None
    yes_no = seconds(lambda: contact.touches(rest), 50)
    yield Figure("collide_ms", 1e3 * yes_no, "ms", "at contact, yes or no")
    gap = seconds(lambda: contact.gap("medial", rest), 10)
    yield Figure("distance_ms", 1e3 * gap, "ms", f"{gap / yes_no:.1f} yes/no tests")
    features = seconds(lambda: contact.contacts(rest, params.contact_band_mm), 10)
    yield Figure("contacts_ms", 1e3 * features, "ms", f"{features / yes_no:.1f} yes/no tests")
    fall = seconds(lambda: drop(contact, rest._replace(z=rest.z - 1.0), params.motion()), 10)
    yield Figure("drop_ms", 1e3 * fall, "ms", f"{fall / yes_no:.1f} yes/no tests")


def lookup_figures(lut: Lut) -> Iterator[Figure]:
    """One pose at a time, and many at once."""
    angles = np.random.default_rng(0).uniform([0.0, -2.0], [120.0, 2.0], (20_000, 2))
    pairs = [(float(f), float(v)) for f, v in angles[:2000]]
    one = seconds(lambda: [lut.pose(f, v) for f, v in pairs], 5) / len(pairs)
    many = seconds(lambda: lut.pose(angles[:, 0], angles[:, 1]), 5) / len(angles)
    yield Figure("lookup_us", 1e6 * one, "us")
    yield Figure("lookups_per_s", 1.0 / many, "1/s", f"{one / many:.0f} times one at a time")


def patient_and_queries(folder: Path) -> Iterator[Figure]:
    """The real knee from labels to package where it is present, else the phantom; then what it is made of."""
    _, case = list(cases(folder))[-1]
    with PeakMemory() as memory:
        first, _, cached_s = patient(case, folder)
    yield from patient_figures(first, cached_s)
    yield Figure(
        "peak_rss_mb", memory.peak_mb, "MB", "all processes of a patient together, what they share counted in each"
    )
    yield from contact_figures(folder / "results")
    yield from lookup_figures(Lut.open(folder / "results" / "90_package" / "lut.h5"))


def main() -> None:
    """Measure and print each row as soon as it is known."""
    measured = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for figure in chain(patient_and_queries(folder / "patient"), sweeps.figures(folder / "sweeps")):
            measured[figure.name] = figure.value
            sys.stdout.write(f"{figure.name:<38}{figure.value:>12.4g} {figure.unit:<5}{figure.ratio}\n")
            sys.stdout.flush()
    measured |= sweeps.headlines(measured)
    REPORT.parent.mkdir(exist_ok=True)
    REPORT.write_text(json.dumps(measured, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
