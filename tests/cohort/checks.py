"""What must be so when a cohort has ended, however often it was killed on the way."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.cohort.place import CohortPlace
from tests.cohort.breakages import Breakage
from tests.cohort.cohort_cases import CohortCases
from tests.cohort.figures import case_spans, repeats

#: Judges a table from the outside, with none of this project's code; where it is beside the checkout.
OUTSIDE = Path(__file__).resolve().parents[3] / "shared/tools/check_package.py"
#: So many tables are judged by it.
SAMPLE = 10
WITH_TABLE = frozenset({"PASS", "REVIEW"})


def problems_of(place: CohortPlace, cases: CohortCases, code: int | None) -> list[str]:
    """Everything that is not as it must be, a line each; empty when all is well."""
    healthy = [name for name in cases.ids if name not in cases.breakages]
    return [
        *_code(code, cases),
        *_table(_rows(place), cases),
        *_page(place, cases),
        *_packages(place.results, healthy),
        *_outside(place.results, healthy),
        *_twice(place, cases),
        *_leftovers(place.results),
    ]


def _code(code: int | None, cases: CohortCases) -> Iterator[str]:
    wanted = {10} if cases.broken else {0, 11}
    if code not in wanted:
        yield f"exit code {code}, expected {sorted(wanted)}"


def _rows(place: CohortPlace) -> Mapping[str, Mapping[str, str]]:
    with place.summary.open(encoding="utf-8-sig", newline="") as file:
        return {row["id"]: row for row in csv.DictReader(file)}


def _table(rows: Mapping[str, Mapping[str, str]], cases: CohortCases) -> Iterator[str]:
    if tuple(sorted(rows)) != cases.ids:
        yield f"cohort.csv has {len(rows)} cases, expected the {cases.count} that were given"
    for name, row in rows.items():
        yield from _row(row, cases.breakages.get(name))


def _row(row: Mapping[str, str], broken: Breakage | None) -> Iterator[str]:
    name = row["id"]
    if broken is None:
        if row["word"] not in WITH_TABLE or not row["package"]:
            yield f"{name}: {row['word']} {row['code']} {row['problem']}, expected a package"
    elif (row["word"], row["code"]) != ("REJECTED", broken.code) or not re.search(broken.problem, row["problem"]):
        told = f"{row['word']} {row['code']} {row['problem']}"
        yield f"{name} ({broken.name}): {told}, expected {broken.code} {broken.problem}"
    elif row["package"]:
        yield f"{name} ({broken.name}) was refused and has a package"


def _page(place: CohortPlace, cases: CohortCases) -> Iterator[str]:
    found = re.findall(r'<tr[^>]* data-case="([^"]+)"', (place.results / "index.html").read_text())
    if sorted(found) != sorted(cases.ids):
        yield f"index.html has {len(found)} lines, expected {cases.count}"


def _packages(results: Path, names: list[str]) -> Iterator[str]:
    program = str(Path(sys.executable).with_name("ct2lut"))

    def verified(name: str) -> subprocess.CompletedProcess[str]:
        command = [program, "verify", name, "--results", str(results)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    with ThreadPoolExecutor(2) as pool:
        for name, told in zip(names, pool.map(verified, names), strict=True):
            if told.returncode != 0:
                yield f"{name}: verify ends with {told.returncode}: {told.stdout}{told.stderr}"
            elif not _lut(results / name):
                yield f"{name}: no lut.h5 in its package"


def _lut(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob("90_package/**/lut.h5"))), None)


def _outside(results: Path, names: list[str]) -> Iterator[str]:
    if not OUTSIDE.exists():
        return
    for name in names[:: max(1, len(names) // SAMPLE)][:SAMPLE]:
        lut = _lut(results / name)
        command = [sys.executable, str(OUTSIDE), str(lut), "--cells", "20", "--midpoints", "0"]
        told = subprocess.run(command, capture_output=True, text=True, check=False)
        if told.returncode != 0:
            yield f"{name}: judged from the outside: {told.stdout[-500:]}{told.stderr[-500:]}"


def _twice(place: CohortPlace, cases: CohortCases) -> Iterator[str]:
    told = repeats(place.results, cases.ids)
    yield from (f"{what}: computed more than once" for what in told.computed_twice)
    # told again where its process was killed before its batch could write the refusal down
    killed = {one.case_id for one in case_spans(place, [math.inf]) if one.killed}
    refused = (what for what in told.refused_twice if what.split()[0] not in killed)
    yield from (f"{what}: refused more than once" for what in refused)


def _leftovers(results: Path) -> Iterator[str]:
    left = [path for path in results.rglob(".*") if re.search(r"\.(partial|old)-[0-9a-f]{8}", path.name)]
    yield from (f"left behind: {path.relative_to(results)}" for path in left)
