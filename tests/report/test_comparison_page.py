"""`compare`: its page is self-contained, inert and complete, and unusable input is refused with a code."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.adapters import plotting
from pipeline.commands.two_tables import compare_cases, comparison_lines
from pipeline.errors import CaseRejected, ConfigError, ExitCode, PipelineError
from pipeline.files.lut_content import LutFileContent
from pipeline.files.lut_file import encode_lut
from pipeline.kinematics.comparison import compare
from pipeline.kinematics.table import Grid
from pipeline.report import comparison_page
from pipeline.report.comparison_page import ComparedTable, ComparisonPage, comparison_html
from tests.files.lut_sample import GRID, content

HOSTILE = '"><script>alert(1)</script>{{ 7 * 7 }}$x$'


@pytest.fixture
def charts(monkeypatch: pytest.MonkeyPatch) -> list[plotting.Chart]:
    """Every chart that is drawn; drawing itself is left out."""
    seen: list[plotting.Chart] = []

    def remember(heading: str, footer: str, drawn: list[plotting.Chart]) -> bytes:
        seen.extend(drawn)
        return f"{heading}/{footer}/{len(seen)}".encode()

    monkeypatch.setattr(comparison_page, "charts_png", remember)
    return seen


def shifted(by_mm: float, side: str = "right") -> LutFileContent:
    made = content(side)
    poses = replace(made.smooth.poses, anterior_mm=made.smooth.poses.anterior_mm + by_mm)
    return replace(made, smooth=replace(made.smooth, poses=poses))


def page(second: LutFileContent, label: str = "P002") -> ComparisonPage:
    first = content()
    found = compare(first.table, second.table)
    return ComparisonPage(
        ComparedTable("P001", "knee", "right", first.software),
        ComparedTable(label, "knee", second.side, second.software),
        found,
    )


def stored(results: Path, case_id: str, table: LutFileContent) -> None:
    folder = results / case_id / "90_package"
    folder.mkdir(parents=True)
    (folder / "lut.h5").write_bytes(encode_lut(table))


def test_the_page_is_self_contained_inert_and_the_same_every_time() -> None:
    html = comparison_html(page(shifted(1.0)))
    assert html == comparison_html(page(shifted(1.0)))
    text = html.decode()
    assert "default-src 'none'; img-src data:; style-src 'unsafe-inline'" in text
    assert not re.search(r"<script|https?://|@import|url\(", text)
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', text)
    assert [base64.b64decode(data)[:8] for data in pictures] == 2 * [b"\x89PNG\r\n\x1a\n"]
    assert len(html) < 600_000


def test_texts_of_a_table_are_escaped() -> None:
    text = comparison_html(page(shifted(1.0), HOSTILE)).decode()
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;{{ 7 * 7 }}$x$" in text


def test_the_numbers_stand_in_their_rows(charts: list[plotting.Chart]) -> None:
    text = comparison_html(page(shifted(-1.0))).decode()
    rows = {
        cells[0]: cells[1:]
        for row in re.findall(r"<tr>(.*?)</tr>", text, re.DOTALL)
        if len(cells := re.findall(r"<td[^>]*>(.*?)</td>", row)) == 7
    }
    assert list(rows) == ["Lateral shift", "Anterior shift", "Proximal shift", "Internal rotation"]
    assert rows["Anterior shift"][:5] == ["1.00", "-1.00", "0.00", "-1.00", "mm"]
    assert rows["Internal rotation"][:5] == ["0.00", "0.00", "0.00", "0.00", "deg"]
    assert "the 52 attitudes" in text
    assert "RIGHT knee" in text


def test_the_charts_hold_both_motions_and_their_difference(charts: list[plotting.Chart]) -> None:
    comparison_html(page(shifted(1.0)))
    assert len(charts) == 8
    first, second = charts[1].curves
    poses = content().smooth.poses
    np.testing.assert_allclose(first.y, poses.anterior_mm[:, 2])
    np.testing.assert_allclose(second.y, poses.anterior_mm[:, 2] + 1.0)
    assert [curve.label for curve in charts[5].curves] == ["varus -4", "varus -1", "varus 0", "varus 2.5"]
    for curve in charts[5].curves:
        np.testing.assert_allclose(curve.y, 1.0)


@pytest.mark.parametrize(("side", "times"), [("right", 0), ("left", 1)])
def test_other_sides_are_said(side: str, times: int, charts: list[plotting.Chart]) -> None:
    assert comparison_html(page(shifted(1.0, side))).decode().count("A left and a right knee.") == times


def test_cases_and_paths_are_compared(tmp_path: Path) -> None:
    stored(tmp_path, "P001", content())
    stored(tmp_path, "P002", shifted(1.0, "left"))
    found = compare_cases("P001", "P002", tmp_path)
    assert (found.first.heading, found.second.heading) == ("P001, RIGHT knee", "P002, LEFT knee")
    lines = comparison_lines(found)
    assert lines[2] == "second minus first at 52 shared attitudes:"
    assert lines[4].startswith(
        "anterior           RMS    1.00  mean    1.00  about the mean    0.00  largest    1.00 mm"
    )
    by_path = compare_cases("P001", str(tmp_path / "P002" / "90_package" / "lut.h5"), tmp_path)
    assert by_path.second.label == "lut.h5"
    assert by_path.comparison.curves == found.comparison.curves


def unusable(case: str) -> tuple[str, LutFileContent | None]:
    """Second argument of the command, and the table of P002 if there is one."""
    far = content(grid=Grid(np.arange(70.0, 91.0, 5.0), GRID.varus_deg))
    return {
        "no such case": ("P003", None),
        "no such file": ("elsewhere/lut.h5", None),
        "no table": ("broken.h5", None),
        "another joint": ("P002", replace(content(), joint="elbow")),
        "nothing shared": ("P002", far),
    }[case]


@pytest.mark.parametrize(
    ("case", "kind", "message"),
    [
        ("no such case", ConfigError, r'^E-CMP-01 There is no finished table of "P003"\.'),
        ("no such file", ConfigError, r'^E-CMP-01 There is no finished table of "lut\.h5"\.'),
        ("no table", CaseRejected, r'^E-CMP-02 The table of "broken\.h5" cannot be used: not a readable table'),
        (
            "another joint",
            CaseRejected,
            r'^E-CMP-03 The tables of "P001" and "P002" .* the first is of the joint knee,',
        ),
        ("nothing shared", CaseRejected, r"^E-CMP-03 .* flexion 0 to 60 .* flexion 70 to 90"),
    ],
)
def test_unusable_input_is_refused(tmp_path: Path, case: str, kind: type[PipelineError], message: str) -> None:
    name, table = unusable(case)
    stored(tmp_path, "P001", content())
    (tmp_path / "broken.h5").write_bytes(b"not a table")
    if table is not None:
        stored(tmp_path, "P002", table)
    with pytest.raises(kind, match=message) as caught:
        compare_cases("P001", str(tmp_path / name) if "." in name else name, tmp_path)
    assert str(tmp_path) not in str(caught.value)
    assert caught.value.exit_code in (ExitCode.USAGE, ExitCode.REJECTED)
