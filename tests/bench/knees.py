"""The knees that are measured: the phantom, and a real one where ../shared/data is present."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.adapters.contact_pool import ContactPair
from pipeline.artifacts import ANATOMY, MOVING_BODY, REFERENCE_BODY
from pipeline.config import load_settings
from pipeline.contact_params import ContactParams
from pipeline.engine.outcome import Execution
from pipeline.engine.runner import CaseJob, run_case
from pipeline.files.phantom_case import write_phantom_case
from pipeline.flow import FLOW
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.records import Anatomy
from tests.end_to_end.knee_runs import Silent, left, up_to

REAL_KNEE = Path(__file__).resolve().parents[3] / "shared" / "data" / "knee_mr_a"


@dataclass(frozen=True, eq=False)
class Knee:
    """Two contact bodies and where they were scanned."""

    name: str
    pair: ContactPair
    anatomy: Anatomy


def cases(folder: Path) -> Iterator[tuple[str, Path]]:
    """Name and case folder of every knee; the phantom is made in ``folder``."""
    write_phantom_case(folder / "cases" / "phantom", PhantomSpec())
    yield "phantom", folder / "cases" / "phantom"
    if REAL_KNEE.exists():
        yield REAL_KNEE.name, REAL_KNEE


def knee(name: str, case: Path, folder: Path, triangles: int) -> Knee:
    """The contact bodies of a case with so many triangles each."""
    settings = load_settings(FLOW, case, "clinical", (f"contact.triangles={triangles}",))
    job = CaseJob(name, case, folder / "bodies" / name)
    run_case(job, up_to("contact"), settings, Execution(jobs=2), Silent())
    anatomy = left(job.results, ANATOMY)
    reference = left(job.results, REFERENCE_BODY)
    moving = left(job.results, MOVING_BODY)
    return Knee(name, ContactParams().pair(reference, moving, anatomy), anatomy)
