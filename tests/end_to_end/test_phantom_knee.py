"""The whole flow on a coarse phantom: what it leaves, and what may not change it."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import cli
from pipeline.engine.outcome import RunOutcome
from pipeline.errors import ExitCode
from pipeline.flow import FLOW
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.kinematics.neutral import EVEN_MM
from pipeline.kinematics.table import Status
from pipeline.playback import Lut
from tests.end_to_end.knee_runs import (
    COARSE,
    SPACING_MM,
    files_of,
    largest_difference,
    mirrored_case,
    neutral,
    phantom_case,
    poses,
    run,
)

CHECK_PACKAGE = Path(__file__).resolve().parents[3] / "shared" / "tools" / "check_package.py"


@dataclass(frozen=True)
class Done:
    case: Path
    results: Path
    outcome: RunOutcome

    @property
    def package(self) -> Path:
        return self.results / "90_package"


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Done]:
    """One full run of the right phantom, one worker."""
    folder = tmp_path_factory.mktemp("knee")
    case = phantom_case(folder / "cases", "right")
    yield Done(case, folder / "results" / "right", run(case, folder / "results", FLOW))
    shutil.rmtree(folder)


def test_the_case_passes(done: Done) -> None:
    assert [stage.state for stage in done.outcome.stages] == ["ran"] * len(FLOW)
    review = [f.message for s in done.outcome.stages for f in s.findings if f.severity == "review"]
    assert done.outcome.exit_code is ExitCode.PASS, review


def test_every_cell_is_in_proven_contact(done: Done) -> None:
    raw, smooth = poses(done.results)
    assert (raw.status == Status.OK).all()
    assert (smooth.status == Status.OK).all()
    assert np.nanmax(raw.equilibrium_residual) < 0.02


def test_at_neutral_varus_both_compartments_touch(done: Done) -> None:
    curve = neutral(done.results)
    assert (curve.status == Status.OK).all()
    assert np.abs(curve.uneven_mm).max() <= EVEN_MM
    assert np.abs(curve.varus_deg).max() <= 2.0


def test_a_stranger_can_verify_the_package(done: Done) -> None:
    if not CHECK_PACKAGE.exists():
        pytest.skip("shared/tools/check_package.py is not beside the checkout")
    command = [sys.executable, str(CHECK_PACKAGE), str(done.package / "lut.h5"), "--json", "--cells", "20"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    report = json.loads(answer.stdout)
    assert report["holds"]
    assert max(report["midpoints"]["worst_gap_mm"], report["midpoints"]["worst_intersection_mm"]) < 0.145


def test_exports_are_made_again_from_the_package_alone(
    done: Done, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = str(done.results.parent)
    assert cli.execute(["export", done.results.name, "--results", results, "--out", str(tmp_path)]) == ExitCode.PASS
    made = files_of(tmp_path)
    assert {"knee.glb", "lut.json", "lut.schema.json", "opensim/joint.osim"} <= made.keys()
    assert made.items() <= files_of(done.package).items()
    assert "knee.glb" in capsys.readouterr().out
    assert cli.execute(["export", done.results.name, "--results", results, "--format", "stl"]) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-EXP-02  unknown format 'stl'")
    assert cli.execute(["export", "P999", "--results", results]) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith("E-EXP-01  P999 has no finished package yet.")


def test_a_table_compared_with_itself(done: Done, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.html"
    table = str(done.package / "lut.h5")
    arguments = ["compare", done.results.name, table, "--results", str(done.results.parent), "--out", str(page)]
    assert cli.execute(arguments) == ExitCode.PASS
    assert capsys.readouterr().out.count(" RMS    0.00") == 4
    assert page.read_bytes().startswith(b"<!DOCTYPE html>")


def test_playback_moves_the_tibia_and_keeps_it_rigid(done: Done) -> None:
    lut = Lut.open(done.package / "lut.h5")
    motion = lut.pose(15.0, 1.0)
    assert motion[:3, :3] @ motion[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.norm(motion[:3, 3]) > 0.1


def test_running_again_does_nothing(done: Done) -> None:
    before = files_of(done.results)
    again = run(done.case, done.results.parent, FLOW)
    assert {stage.state for stage in again.stages} == {"cached"}
    assert files_of(done.results) == before


@pytest.mark.parametrize("jobs", [2, 4])
def test_workers_do_not_change_a_byte(done: Done, tmp_path: Path, jobs: int) -> None:
    results = tmp_path / "right"
    shutil.copytree(done.results, results)
    for folder in ("60_sweep", "70_smooth"):
        shutil.rmtree(results / folder)
    run(done.case, tmp_path, jobs=jobs)
    for folder in ("60_sweep", "70_smooth"):
        assert files_of(results / folder) == files_of(done.results / folder)


def test_the_mirrored_knee_gives_the_mirrored_table(done: Done, tmp_path: Path) -> None:
    run(mirrored_case(tmp_path / "cases", "left"), tmp_path / "results")
    for mine, other in zip(poses(done.results), poses(tmp_path / "results" / "left"), strict=True):
        assert max(largest_difference(mine, other)) < 1e-6
    here, there = neutral(done.results), neutral(tmp_path / "results" / "left")
    np.testing.assert_allclose(there.varus_deg, here.varus_deg, rtol=0, atol=1e-6)


def test_a_moved_header_gives_the_same_table(done: Done, tmp_path: Path) -> None:
    spec = replace(
        PhantomSpec(spacing_mm=SPACING_MM), placement_deg=(12.0, -20.0, 31.0), placement_mm=(80.0, -40.0, 7.0)
    )
    run(phantom_case(tmp_path / "cases", "moved", spec), tmp_path / "results")
    for mine, other in zip(poses(done.results), poses(tmp_path / "results" / "moved"), strict=True):
        mm, deg = largest_difference(mine, other)
        assert mm < 0.02
        assert deg < 0.02


@pytest.mark.fault("V18")
def test_a_wrong_side_is_refused_and_the_good_result_stays(done: Done, tmp_path: Path) -> None:
    case, results = tmp_path / "cases" / "right", tmp_path / "results" / "right"
    shutil.copytree(done.case, case)
    shutil.copytree(done.results, results)
    declaration = (case / "case.yaml").read_text()
    (case / "case.yaml").write_text(declaration.replace("right", "left"))
    outcome = run(case, results.parent, FLOW)
    assert outcome.word == "REJECTED"
    assert outcome.code == "E-SIDE-02"
    assert files_of(results / "90_package") == files_of(done.package)


def test_killed_in_every_stage_the_run_resumes_to_the_same_bytes(done: Done, tmp_path: Path) -> None:
    """SIGKILL as soon as a stage has begun; the next start goes on, the last one finishes."""
    overrides = [word for setting in COARSE for word in ("--set", setting)]
    arguments = [
        "run",
        "right",
        "--cases",
        str(done.case.parent),
        "--results",
        str(tmp_path),
        "--jobs",
        "1",
        *overrides,
    ]
    command = [sys.executable, "-P", "-c", "from pipeline.cli import main; main()", *arguments]
    kills = 0
    for stage in FLOW:
        kills += _killed_once_begun(command, tmp_path / "right", stage.folder)
    assert kills >= len(FLOW) - 2
    assert subprocess.run(command, capture_output=True, check=False).returncode == ExitCode.PASS
    finished = files_of(tmp_path / "right")
    assert b"How the run went" in finished.pop("report.html")  # of the command, with its times
    assert finished == files_of(done.results)


def _killed_once_begun(command: list[str], results: Path, stage: str) -> int:
    """Start the program, kill it when the log says that a stage has begun; 0 when it was over before."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    name = stage.split("_", 1)[1]
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline and process.poll() is None:
        if _begun(results / "log.jsonl", name):
            process.send_signal(signal.SIGKILL)
            process.wait()
            return 1
        time.sleep(0.02)
    process.wait()
    return 0


def _begun(log: Path, stage: str) -> bool:
    if not log.exists():
        return False
    lines = [line for line in log.read_text().splitlines() if line.endswith("}")]
    events = [json.loads(line) for line in lines]
    return any(event["stage"] == stage and event["msg"].startswith("runs, because") for event in events)
