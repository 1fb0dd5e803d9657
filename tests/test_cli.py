"""The command line: what is shown, what is returned, and that a mistake leaves nothing behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from pipeline import __version__, cli, config
from pipeline.commands import doctor
from pipeline.engine.outcome import load_record
from pipeline.errors import ExitCode
from tests.toy_flow import TOY_FLOW, write_toy_configs

CHECKOUT = Path(__file__).resolve().parents[1]
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ct2lut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command of the toy flow in a folder with one good case, P001; returns code, output, error output."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli.shared, "flow", lambda: TOY_FLOW)
    monkeypatch.setattr(config, "CONFIGS", write_toy_configs(tmp_path / "configs"))
    write_case(tmp_path / "cases" / "P001")

    def run(*arguments: str) -> tuple[int, str, str]:
        code = cli.execute(arguments)
        return code, *capsys.readouterr()

    return run


def write_case(folder: Path, declaration: str = "side: right\n") -> None:
    folder.mkdir(parents=True)
    (folder / "labels.txt").write_text("labels")
    (folder / "case.yaml").write_text(declaration)


def listing(folder: Path) -> Sequence[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_run_from_header_to_verdict(ct2lut: Run) -> None:
    code, out, err = ct2lut("run", "P001", "--jobs", "1")
    lines = out.splitlines()
    assert (code, err) == (ExitCode.PASS, "")
    assert lines[0] == "P001   right knee   protocol clinical"
    assert [line.split()[:3] for line in lines[1:3]] == [["[1/2]", "intake", "ok"], ["[2/2]", "qa", "ok"]]
    assert lines[3:] == ["PASS   P001", "report: results/P001/report.html"]
    assert Path("results/P001/80_qa/report/report.html").read_text() == "<p>labels fine</p>"


def test_a_second_run_has_nothing_to_do(ct2lut: Run) -> None:
    ct2lut("run", "P001")
    code, out, _ = ct2lut("run", "P001")
    assert code == ExitCode.PASS
    assert "PASS   P001   nothing to do: all 2 stages are up to date" in out


def test_a_review_names_at_most_three_reasons(ct2lut: Run) -> None:
    code, out, _ = ct2lut("run", "P001", "--set", "qa.review=true", "--set", "qa.count=5")
    lines = out.splitlines()
    verdict = lines.index("REVIEW   P001")
    assert code == ExitCode.REVIEW
    assert lines[verdict + 1 : verdict + 5] == ["  W-TOY-01  Look at the toy."] * 3 + ["  and 2 more in the report"]


def test_a_rejected_case_says_what_to_do(ct2lut: Run) -> None:
    write_case(Path("cases/P002"), "{}")
    code, out, _ = ct2lut("run", "P002")
    assert code == ExitCode.REJECTED
    verdict = out[out.index("REJECTED") :].splitlines()
    expected = [
        "REJECTED   P002   E-SIDE-01",
        "  The side is not given.",
        "  Add side: right or side: left to case.yaml.",
        "report: results/P002/report.html",
    ]
    assert verdict == expected
    assert "The side is not given." in Path("results/P002/report.html").read_text()


def test_a_wrong_declaration_is_the_fault_of_the_case(ct2lut: Run) -> None:
    write_case(Path("cases/P002"), "side: both")
    code, _, err = ct2lut("run", "P002")
    assert code == ExitCode.REJECTED
    assert err.startswith("E-CASE-03  case.yaml: side is 'both'; expected right or left.\n")


def test_a_wrong_declaration_is_left_where_the_overview_finds_it(ct2lut: Run) -> None:
    write_case(Path("cases/P002"), "sides: left\n")
    code, _, err = ct2lut("run", "P002")
    last = load_record(Path("results/P002"))
    assert last is not None
    assert last.outcome is not None
    assert (code, last.outcome.exit_code, last.outcome.code) == (ExitCode.REJECTED, ExitCode.REJECTED, "E-CASE-02")
    assert (last.outcome.problem or "-") in err
    assert ct2lut("status")[1].splitlines()[-1].endswith(f"REJECTED {last.outcome.problem}")


def test_a_case_whose_folder_lies_elsewhere(ct2lut: Run) -> None:
    write_case(Path("elsewhere/scan 7"), "side: left\n")
    code, out, _ = ct2lut("run", "P007", "--folder", "elsewhere/scan 7")
    assert code == ExitCode.PASS
    assert out.splitlines()[0] == "P007   left knee   protocol clinical"
    assert Path("results/P007/80_qa/report/report.html").is_file()


def test_a_missing_case_is_rejected(ct2lut: Run) -> None:
    code, out, _ = ct2lut("run", "P404")
    assert code == ExitCode.REJECTED
    assert "REJECTED   P404   E-IO-03" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "P001", "--set", "qa.wrod=x"], "E-CFG-01"),
        (["run", "P001", "--set", "qa.count=99"], "E-CFG-02"),
        (["run", "P001", "--protocol", "clinicl"], "E-CFG-03"),
        (["run", "../P001"], "E-ID-01"),
        (["plan", "../P001"], "E-ID-01"),
        (["check", "../P001"], "E-ID-01"),
        (["report", "../P001"], "E-ID-01"),
        (["verify", "../P001"], "E-ID-01"),
        (["status", "../P001"], "E-ID-01"),
        (["open", "../P001"], "E-ID-01"),
        (["phantom", "cases", "--id", "../P001"], "E-ID-01"),
        (["phantom", "cases", "--id", "P001"], "E-PHA-01"),
        (
            ["phantom", "cases", "--set", "sied=left"],
            "E-PHA-02  The phantom has no number 'sied' (did you mean 'side'?).",
        ),
        (["phantom", "cases", "--set", "scale=9"], "E-PHA-03"),
        (["phantom", "cases", "--set", "side=both"], "E-PHA-03"),
        (["run", "p001"], "E-ID-02"),
        (["open", "P001"], "E-OPN-01  P001 has no report yet."),
        (["query", "P001", "--flexion", "0"], "E-CMP-01  There is no finished table of"),
        (["query", "../P001/lut.h5", "--flexion", "0"], "E-CMP-01"),
        (["query", "P001"], "E-USE-01"),
        (["query", "P001", "--flexion", "0", "--frame", "tibia"], "E-USE-01"),
        (["overview"], "E-OVW-01"),
        (["overview", "--results", "cases", "--out", "list.txt"], "E-OVW-02"),
        (["run"], "E-USE-01"),
        (["run", "P001", "--job", "1"], "E-USE-01"),
        (["run", "P001", "--jobs", "-1"], "E-USE-01"),
        (["runn", "P001"], "E-USE-01"),
    ],
)
def test_usage_errors_do_nothing(ct2lut: Run, arguments: list[str], message: str) -> None:
    before = listing(Path())
    code, out, err = ct2lut(*arguments)
    assert (code, out) == (ExitCode.USAGE, "")
    assert err.startswith(message)
    assert len(err.splitlines()) == 2
    assert listing(Path()) == before


def test_plan_says_why_and_writes_nothing(ct2lut: Run) -> None:
    before = listing(Path())
    code, out, _ = ct2lut("plan", "P001")
    assert code == ExitCode.PASS
    assert [line.split()[:2] for line in out.splitlines()] == [["intake", "run"], ["qa", "run"]]
    assert listing(Path()) == before
    ct2lut("run", "P001")
    assert ct2lut("plan", "P001")[1] == "nothing to do: all 2 stages are up to date\n"
    planned = ct2lut("plan", "P001", "--set", "qa.word=other")[1].splitlines()
    assert planned[0].split()[:2] == ["intake", "skip"]
    assert planned[1].split()[:2] == ["qa", "run"]
    assert "word" in planned[1]


@pytest.fixture
def knee(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command of the real flow in a folder with a coarse phantom, P001."""
    monkeypatch.chdir(tmp_path)
    cli.execute(["phantom", "cases", "--id", "P001", "--set", "spacing_mm=[2,2,2]"])
    capsys.readouterr()

    def run(*arguments: str) -> tuple[int, str, str]:
        return cli.execute(arguments), *capsys.readouterr()

    return run


def test_a_check_that_finds_nothing(knee: Run) -> None:
    before = listing(Path())
    code, out, err = knee("check", "P001")
    lines = out.splitlines()
    assert (code, err) == (ExitCode.PASS, "")
    assert lines[0].startswith("OK    scan range    ")
    assert any(line.startswith("OK    joint space   ") for line in lines)
    assert lines[-2] == "OK    P001: nothing speaks against processing it."
    assert "quick look" in lines[-1]
    assert listing(Path()) == before


def test_a_check_with_something_to_look_at(knee: Run) -> None:
    code, out, _ = knee("check", "P001", "--set", "anatomy.max_long_axis_uncertainty_deg=1.5")
    lines = out.splitlines()
    femur = next(index for index, line in enumerate(lines) if line.startswith("LOOK  femur"))
    assert code == ExitCode.REVIEW
    assert "its axis is sure only from 143 mm on" in lines[femur]
    assert lines[femur + 1].strip().startswith("-> Scan or export more of the femur")
    assert "LOOK  P001: 2 to look at." in lines


def test_a_check_that_stops(knee: Run) -> None:
    Path("cases/P001/case.yaml").write_text("joint: knee\n")
    code, out, err = knee("check", "P001")
    expected = [
        "STOP  side          E-SIDE-01  The side of the body is not given with the case; it is never guessed.",
        "                    -> Write 'side: right' or 'side: left' in case.yaml.",
        "STOP  P001: a run would refuse this case.",
    ]
    assert (code, err) == (ExitCode.REJECTED, "")
    assert out.splitlines() == expected


def test_a_check_of_a_wrong_declaration_says_what_a_run_says(knee: Run) -> None:
    Path("cases/P001/case.yaml").write_text("side: both\n")
    assert knee("check", "P001") == knee("run", "P001")
    assert knee("check", "P001")[0] == ExitCode.REJECTED


def test_status_of_one_and_of_all(ct2lut: Run) -> None:
    assert ct2lut("status") == (0, "no results in results\n", "")
    ct2lut("run", "P001", "--set", "qa.review=true")
    one = ct2lut("status", "P001")[1].splitlines()
    assert one[0].split()[:3] == ["10", "intake", "done"]
    assert one[1].endswith("W-TOY-01 W-TOY-01 W-TOY-01")
    assert one[2] == "last run: REVIEW"
    every = ct2lut("status")[1]
    assert every.split()[:3] == ["P001", "2/2", "stages"]


def test_the_overview_is_a_page_of_all_cases(ct2lut: Run) -> None:
    write_case(Path("cases/P002"), "{}")
    ct2lut("run", "P001", "--set", "qa.review=true")
    ct2lut("run", "P002")
    expected = "2 cases, 2 read again\npage: results/index.html\n"
    assert ct2lut("overview") == (ExitCode.PASS, expected, "")
    text = Path("results/index.html").read_text()
    assert 'href="./P001/report.html"' in text
    assert "Look at the toy." in text
    assert "E-SIDE-01  The side is not given." in text
    assert ct2lut("overview", "--out", "list.html")[1].endswith("page: list.html\n")
    assert len(ct2lut("status")[1].splitlines()) == 2


def test_verify_finds_a_changed_file(ct2lut: Run) -> None:
    ct2lut("run", "P001")
    assert ct2lut("verify", "P001")[0] == ExitCode.PASS
    page = Path("results/P001/80_qa/report/report.html")
    page.chmod(0o640)
    page.write_text("other")
    code, out, _ = ct2lut("verify", "P001")
    assert code == ExitCode.ENVIRONMENT
    assert "report.html" in out


def test_report_shows_the_page(ct2lut: Run) -> None:
    code, out, _ = ct2lut("report", "P001")
    assert code == ExitCode.PASS
    assert out.splitlines()[-1] == "report: results/P001/report.html"


def test_a_bug_is_one_line(ct2lut: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli.shared, "flow", lambda: 1 / 0)
    code, _, err = ct2lut("plan", "P001")
    assert code == ExitCode.ERROR
    assert err.startswith("E-BUG-01  The program failed: ZeroDivisionError")
    assert "Traceback" not in err


def test_a_refusing_system_is_not_a_bug(ct2lut: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise PermissionError(13, "Permission denied", "/secret/place")

    monkeypatch.setattr(cli.shared, "flow", refuse)
    code, _, err = ct2lut("plan", "P001")
    assert code == ExitCode.ENVIRONMENT
    assert err.startswith("E-ENV-20  The operating system refused: Permission denied.\n")
    assert "secret" not in err


def test_a_phantom_is_a_case(ct2lut: Run) -> None:
    code, out, _ = ct2lut("phantom", "cases", "--id", "toy", "--set", "side=left", "--set", "spacing_mm=[4,4,4]")
    assert (code, out) == (ExitCode.PASS, "made the case cases/toy\n")
    assert "side: left" in Path("cases/toy/case.yaml").read_text()
    assert Path("cases/toy/labels.nrrd").stat().st_size > 0


def test_a_doctor_for_people_and_for_monitoring(ct2lut: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PROBES", {})
    before = listing(Path())
    code, out, err = ct2lut("doctor", "--results", "results")
    assert (code, err) == (ExitCode.PASS, "")
    assert [line.split()[:2] for line in out.splitlines()[:-1]] == [
        [n, "ok"] for n in ("cohorts", "disk", "results", "locks", "clock")
    ]
    assert out.splitlines()[-1] == "This machine is ready."
    code, out, err = ct2lut("doctor", "--results", "cases/P001/case.yaml", "--json")
    told = json.loads(out)
    assert (code, err, told["ok"]) == (ExitCode.ENVIRONMENT, "", False)
    assert told["checks"][2]["found"] == "cases/P001/case.yaml is not a folder"
    assert listing(Path()) == before


def test_version_and_help(ct2lut: Run) -> None:
    assert ct2lut("--version") == (0, f"ct2lut {__version__}\n", "")
    code, out, _ = ct2lut()
    assert code == 0
    assert "Research" in out
    assert all(
        command in out
        for command in ("run", "check", "plan", "status", "verify", "report", "query", "open", "phantom", "doctor")
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    write_case(tmp_path / "cases" / "P001")
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    with subprocess.Popen(
        [sys.executable, "-m", "tests.waiting_program", "run", "P001"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert "waiting\n" in iter(process.stdout.readline, "")
        started = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate(timeout=20)
    assert time.monotonic() - started < 5
    assert process.returncode == ExitCode.INTERRUPTED
    assert err.splitlines() == ["Interrupted.", "The same command goes on where this one stopped."]
    assert not [name for name in listing(tmp_path / "results" / "P001") if "intake" in name]


HEAVY = (
    "vtk",
    "vtkmodules",
    "fast_simplification",
    "matplotlib",
    "scipy",
    "trimesh",
    "fcl",
    "cv2",
    "SimpleITK",
    "meshio",
    "jinja2",
    "weasyprint",
)


def test_commands_load_no_heavy_library() -> None:
    check = f"import sys; import pipeline.cli, pipeline.flow; print(*sorted(set({HEAVY!r}) & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", check], cwd=CHECKOUT, capture_output=True, text=True, check=True)
    assert answer.stdout.split() == []
