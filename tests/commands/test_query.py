"""``ct2lut query`` and ``ct2lut open``: what is printed, for people and for programs."""

from __future__ import annotations

import csv
import io
import json
import re
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline import cli
from pipeline.engine.outcome import RunOutcome, RunRecord, save_record
from pipeline.errors import ExitCode
from pipeline.files.lut_file import encode_lut
from pipeline.playback import Lut
from tests.files.lut_sample import content
from tests.toy_flow import TOY_FLOW

BAD = ((3, 1), (4, 1))
SIX = ["flexion_deg", "varus_deg", "internal_rotation_deg", "lateral_mm", "anterior_mm", "proximal_mm"]
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ct2lut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in a folder with a finished left knee, P001."""
    monkeypatch.chdir(tmp_path)
    package = Path("results/P001/90_package")
    package.mkdir(parents=True)
    (package / "lut.h5").write_bytes(encode_lut(content("left", bad=BAD)))

    def run(*arguments: str) -> tuple[int, str, str]:
        return cli.execute(arguments), *capsys.readouterr()

    return run


@pytest.fixture
def lut() -> Lut:
    return Lut(content("left", bad=BAD))


def printed(ct2lut: Run, *arguments: str) -> str:
    code, out, err = ct2lut("query", *arguments)
    assert (code, err) == (ExitCode.PASS, "")
    return out


def numbers(lines: list[str]) -> list[list[float]]:
    return [[float(word) for word in line.split()] for line in lines]


def test_all_of_one_attitude_is_shown(ct2lut: Run, lut: Lut) -> None:
    lines = printed(ct2lut, "P001", "--flexion", "60", "--varus", "2").splitlines()
    assert lines[0] == "P001   left knee"
    shown = {" ".join(words[:-2]): (float(words[-2]), words[-1]) for words in map(str.split, lines[1:7])}
    for name, value in lut.coordinates(60.0, 2.0)._asdict().items():
        words, _, unit = name.rpartition("_")
        number, shown_unit = shown[words.replace("_", " ")]
        assert number == pytest.approx(float(value), abs=1e-4)
        assert shown_unit == unit
    assert [line.partition(":")[0] for line in (lines[7], lines[12])] == ["moved_from_scan", "femur_from_tibia"]
    np.testing.assert_allclose(numbers(lines[8:12]), lut.pose(60.0, 2.0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(numbers(lines[13:]), lut.reference_from_moving(60.0, 2.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("frame", "names"),
    [
        (None, [*SIX, "moved_from_scan", "femur_from_tibia"]),
        ("jcs", SIX),
        ("scan", [*SIX[:2], "moved_from_scan"]),
        ("femur", [*SIX[:2], "femur_from_tibia"]),
    ],
)
@pytest.mark.parametrize("flexion", ["12.5", "0,12.5,60"])
def test_json_holds_what_was_asked_for(
    ct2lut: Run, lut: Lut, frame: str | None, names: list[str], flexion: str
) -> None:
    options = ["--frame", frame] if frame else []
    found = json.loads(printed(ct2lut, "P001", "--flexion", flexion, "--varus", "1.5", "--json", *options))
    assert list(found) == ["table", "joint", "side", "asked_flexion_deg", "asked_varus_deg", *names]
    assert [found[name] for name in ("table", "joint", "side")] == ["P001", "knee", "left"]
    asked = [float(word) for word in flexion.split(",")]
    at = np.array(asked) if len(asked) > 1 else asked[0]
    expected = {**lut.coordinates(at, 1.5)._asdict(), "moved_from_scan": lut.pose(at, 1.5)}
    expected["femur_from_tibia"] = lut.reference_from_moving(at, 1.5)
    for name in names:
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-12, err_msg=name)
    assert found["asked_flexion_deg"] == (asked if len(asked) > 1 else asked[0])


def test_several_attitudes_are_a_table(ct2lut: Run, lut: Lut) -> None:
    rows = list(csv.DictReader(io.StringIO(printed(ct2lut, "P001", "--flexion", "-0,30,45.5", "--varus", "-0.5"))))
    assert [*rows[0]] == SIX
    assert rows[0]["flexion_deg"] == "0"
    for row, flexion in zip(rows, (0.0, 30.0, 45.5), strict=True):
        found = [float(number) for number in row.values()]
        np.testing.assert_allclose(found, lut.coordinates(flexion, -0.5), rtol=0, atol=1e-8)
    (row, _) = csv.DictReader(io.StringIO(printed(ct2lut, "P001", "--flexion", "45,60", "--frame", "scan")))
    assert list(row)[:2] == SIX[:2]
    matrix = [float(row[f"m{i}{j}"]) for i in range(4) for j in range(4)]
    np.testing.assert_allclose(np.reshape(matrix, (4, 4)), lut.pose(45.0), rtol=0, atol=1e-6)


def test_a_clamped_answer_says_so(ct2lut: Run, lut: Lut) -> None:
    lines = printed(ct2lut, "P001", "--flexion", "75", "--varus", "9", "--clamp", "--frame", "jcs").splitlines()
    assert lines[1] == "flexion 75, varus 9 deg has no pose; the nearest that has one:"
    assert [line.split()[1] for line in lines[2:4]] == ["60.0000", "2.5000"]
    rows = list(csv.DictReader(io.StringIO(printed(ct2lut, "P001", "--flexion", "30,75", "--clamp"))))
    assert [row["asked_flexion_deg"] for row in rows] == ["30", "75"]
    assert [row["flexion_deg"] for row in rows] == ["30", "60"]
    assert "nearest" not in printed(ct2lut, "P001", "--flexion", "30", "--clamp")


def test_a_file_is_a_table_too(ct2lut: Run) -> None:
    by_case = printed(ct2lut, "P001", "--flexion", "20", "--json")
    by_path = printed(ct2lut, "results/P001/90_package/lut.h5", "--flexion", "20", "--json")
    assert json.loads(by_path) == json.loads(by_case) | {"table": "lut.h5"}


def test_another_joint_has_no_femur(ct2lut: Run) -> None:
    Path("dish.h5").write_bytes(encode_lut(replace(content(), joint="ball_dish")))
    found = json.loads(printed(ct2lut, "dish.h5", "--flexion", "20", "--json"))
    assert list(found)[-2:] == ["moved_from_scan", "reference_from_moving"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--flexion", "75"], 'E-LUT-02  The table of "P001" has no such pose: flexion 75 deg is outside the table'),
        (
            ["--flexion", "17.5", "--varus", "-1"],
            "E-LUT-02 .* has no such pose: the table has no stable pose at flexion",
        ),
        (["--flexion", "thirty"], 'E-LUT-03  --flexion is "thirty"; expected degrees'),
        (["--flexion", "1,,2"], 'E-LUT-03  --flexion is "1,,2"; expected degrees'),
        (["--flexion", "nan", "--clamp"], 'E-LUT-03  --flexion is "nan"; expected degrees'),
        (["--flexion", "3", "--varus", "inf", "--clamp"], 'E-LUT-03  --varus is "inf"; expected degrees'),
    ],
)
def test_what_has_no_answer_is_refused(ct2lut: Run, arguments: list[str], message: str) -> None:
    code, out, err = ct2lut("query", "P001", *arguments)
    assert (code, out) == (ExitCode.USAGE, "")
    assert len(err.splitlines()) == 2
    assert re.match(message, err)


def test_a_damaged_table_is_no_usage_error(ct2lut: Run) -> None:
    Path("results/P001/90_package/lut.h5").write_bytes(b"damaged")
    code, out, err = ct2lut("query", "P001", "--flexion", "3")
    assert (code, out) == (ExitCode.REJECTED, "")
    assert err.startswith('E-CMP-02  The table of "P001" cannot be used: not a readable table')


@pytest.fixture
def report(ct2lut: Run, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The report of P001, in a flow whose last folder is that of qa, on a machine without a display."""
    monkeypatch.setattr(cli.shared, "flow", lambda: TOY_FLOW)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    page = Path("results/P001/80_qa/report/report.html")
    page.parent.mkdir(parents=True)
    page.write_text("<p>report</p>")
    return page


def test_open_on_a_server_says_where_the_report_is(ct2lut: Run, report: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda url: pytest.fail("there is no browser to ask"))
    code, out, err = ct2lut("open", "P001")
    assert (code, err) == (ExitCode.PASS, "")
    assert out.splitlines()[0] == f"report: {report}"
    assert out.splitlines()[1].startswith("No browser here.")


def test_open_shows_the_report_in_the_browser(ct2lut: Run, report: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def show(url: str) -> bool:
        shown.append(url)
        return True

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", show)
    assert ct2lut("open", "P001") == (ExitCode.PASS, f"report: {report}\n", "")
    assert shown == [report.resolve().as_uri()]


def test_a_display_that_shows_nothing_is_no_failure(ct2lut: Run, report: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(url: str) -> bool:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", refuse)
    code, out, err = ct2lut("open", "P001")
    assert (code, err) == (ExitCode.PASS, "")
    assert out.splitlines()[1].startswith("No browser here.")


@pytest.mark.usefixtures("report")
def test_open_says_when_the_page_is_not_that_of_the_last_run(ct2lut: Run) -> None:
    stopped = RunOutcome("P001", "ERROR", ExitCode.ERROR, (), "E-JOB-01", "P001 did not end within 30 min.", "Wait.")
    save_record(Path("results/P001"), RunRecord("finished", stopped))
    code, out, _ = ct2lut("open", "P001")
    assert code == ExitCode.PASS
    assert out.splitlines()[:3] == [
        "The last run left no report (ERROR E-JOB-01); this is the report of an earlier run.",
        "P001 did not end within 30 min.",
        "Wait.",
    ]
