"""Where a cohort keeps what it needs, inside its results folder; the only maker of these paths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class CohortPlace:
    """The results folder of a cohort, ``RESULTS``.

    ``RESULTS/<ID>`` are the cases; ``RESULTS/cohort.csv`` the summary; ``RESULTS/index.html`` the overview;
    ``RESULTS/cohort.files`` what only the program reads (the dot keeps it from being taken for a case).
    """

    results: Path

    @property
    def summary(self) -> Path:
        """One line a case, for people and spreadsheets."""
        return self.results / "cohort.csv"

    @property
    def files(self) -> Path:
        """What only the program reads."""
        return self.results / "cohort.files"

    @property
    def plan(self) -> Path:
        """What was asked for, and which case is in which batch."""
        return self.files / "plan.json"

    @property
    def workflow(self) -> Path:
        """Working folder of the workflow engine."""
        return self.files / "workflow"

    @property
    def engine_log(self) -> Path:
        """What the workflow engine says."""
        return self.files / "engine.log"

    @property
    def lock(self) -> Path:
        """Held as long as a driver or its engine is at work."""
        return self.files / "driver.lock"

    def case_list(self, batch: str) -> Path:
        """Cases of a batch: ``id,folder,signature``; rewritten only when it changes."""
        return self.workflow / "batches" / f"{batch}.csv"

    def done(self, batch: str) -> Path:
        """Made when every case of a batch has a result, be it a refusal."""
        return self.workflow / "done" / f"{batch}.csv"

    def ledger(self, batch: str) -> Path:
        """History of a batch, one JSON object a line."""
        return self.files / "ledger" / f"{batch}.jsonl"

    def batch_lock(self, batch: str) -> Path:
        """Held while a batch is at work; a second run of it waits."""
        return self.files / "ledger" / f".{batch}.lock"

    @property
    def watch_memory(self) -> Path:
        """Which case folders a watch has run, as they were then."""
        return self.files / "watch.json"

    @property
    def watch_lock(self) -> Path:
        """Held as long as a watch is at work."""
        return self.files / "watch.lock"
