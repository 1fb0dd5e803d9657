"""A program that takes the place of ct2lut in a cohort: a case leaves one line for each time that it was done.

Like the real one it knows a finished case by what it left, and a second run of a batch waits for the first.
``RESULTS/stub.json`` says how it behaves: ``seconds`` a case, ``refused`` IDs, ``faulty`` batches, whose first attempt
ends with exit code 30.
"""

from __future__ import annotations

import argparse
import csv
import fcntl
import json
import os
import sys
import time
from pathlib import Path

FAULT = 30


def main() -> int:
    """Do a batch, or say how all ended."""
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=("batch", "cohort-summary"))
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--attempt", type=int, default=1)
    parser.add_argument("batch", nargs="?")
    given = parser.parse_intermixed_args()
    files = given.results / "cohort.files"
    if given.command == "cohort-summary":
        return _summary(given.results, files)
    return _batch(given.batch, given.attempt, files)


def _batch(name: str, attempt: int, files: Path) -> int:
    how = json.loads((files.parent / "stub.json").read_text())
    folder = files / "ledger"
    folder.mkdir(exist_ok=True)
    with (folder / f".{name}.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _note(folder / f"{name}.attempts", {"attempt": attempt, "job": os.environ.get("SLURM_JOB_ID", "")})
        if name in how["faulty"] and attempt == 1:
            return FAULT
        cases = _cases(files, name)
        for case in cases:
            _case(files.parent / case, how)
        done = files / "workflow" / "done" / f"{name}.csv"
        done.parent.mkdir(exist_ok=True)
        done.write_text("".join(f"{case}\n" for case in cases))
    return 0


def _case(folder: Path, how: dict[str, object]) -> None:
    result = folder / "result.jsonl"
    if result.exists():
        return
    folder.mkdir(exist_ok=True)
    time.sleep(float(str(how["seconds"])))
    word = "REJECTED" if folder.name in str(how["refused"]) else "PASS"
    _note(result, {"id": folder.name, "word": word})


def _note(path: Path, fields: dict[str, object]) -> None:
    with path.open("a") as file:
        file.write(json.dumps(fields) + "\n")


def _summary(results: Path, files: Path) -> int:
    cases = [
        case for batch in sorted((files / "workflow" / "batches").glob("*.csv")) for case in _cases(files, batch.stem)
    ]
    words = {case: json.loads((results / case / "result.jsonl").read_text().splitlines()[0])["word"] for case in cases}
    (results / "cohort.csv").write_text("".join(f"{case},{words[case]}\n" for case in sorted(words)))
    return 0


def _cases(files: Path, batch: str) -> list[str]:
    with (files / "workflow" / "batches" / f"{batch}.csv").open(newline="") as file:
        return [row["id"] for row in csv.DictReader(file)]


if __name__ == "__main__":
    sys.exit(main())
