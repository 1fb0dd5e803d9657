"""A small cohort without its runs: folders of cases, a plan, and events as batches write them."""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from pipeline.cohort.batches import PlanInputs, load_batch, write_plan
from pipeline.cohort.ledger import Event, Ledger, What, event_key
from pipeline.cohort.model import CaseEnd, CohortRequest, ListedCase, Plan
from pipeline.cohort.place import CohortPlace
from pipeline.engine.store import make_folder

REFUSED = ("E-SIDE-01", "The side is not given.", "Add side: right or side: left to case.yaml.")


def planned(root: Path, ids: Sequence[str], buckets: int = 0, key: str = "k") -> tuple[CohortPlace, Plan]:
    """The plan of cases that have a folder each, and the place of their results."""
    for name in ids:
        make_folder(root / "cases" / name)
    place = CohortPlace(root / "results")
    cases = tuple(ListedCase(name, root / "cases" / name) for name in ids)
    request = CohortRequest(str(root / "cases"), "demo", buckets=buckets)
    plan = write_plan(place, PlanInputs(request, key, cases, "ct2lut"))
    make_folder(place.ledger("any").parent)
    return place, plan


def refused(case_id: str, seconds: float = 1.0) -> CaseEnd:
    """A case that was refused."""
    return CaseEnd(case_id, "REJECTED", *REFUSED, seconds)


def lost(case_id: str) -> CaseEnd:
    """A case whose process the machine ended."""
    return CaseEnd(case_id, "ERROR", "E-JOB-03", "Its process was killed.", "Try again.", 9.0, transient=True)


class Batches:
    """Writes what the batches of a plan would."""

    def __init__(self, place: CohortPlace, plan: Plan) -> None:
        self._place = place
        self._batches = {case_id: name for name, ids in plan.batches.items() for case_id in ids}
        listed = [one for name in plan.batches for one in load_batch(place, name)]
        self.keys = {one.case.case_id: event_key(plan.key, one.signature, one.tries) for one in listed}

    def ledger(self, case_id: str) -> Path:
        return self._place.ledger(self._batches[case_id])

    def start(self, case_id: str) -> None:
        Ledger(self.ledger(case_id)).started(case_id, self.keys[case_id])

    def end(self, end: CaseEnd) -> None:
        Ledger(self.ledger(end.case_id)).ended(end, self.keys[end.case_id])

    def run(self, *ends: CaseEnd) -> None:
        for end in ends:
            self.start(end.case_id)
            self.end(end)

    def line(self, case_id: str, what: What, host: str = "", end: CaseEnd | None = None, key: str = "") -> bytes:
        """A line of a ledger as another machine, or an earlier request, would write it."""
        host, key = host or socket.gethostname(), key or self.keys[case_id]
        event = Event("2031-02-03T04:05:06.789+00:00", host, what, case_id, key, 1, end)
        return json.dumps(asdict(event)).encode() + b"\n"

    def add(self, case_id: str, data: bytes) -> None:
        with self.ledger(case_id).open("ab") as stream:
            stream.write(data)
