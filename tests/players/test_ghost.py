"""The joint of another report as a ghost: where it lies, what is said of it, and what no report is.

``.venv/bin/python -P -m pytest tests/players/test_ghost.py``
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.mesh import transformed
from pipeline.kinematics.table import Grid, Status
from pipeline.report.evidence import Evidence
from pipeline.report.figure_viewer import viewer_data
from pipeline.report.settings import PictureSettings
from tests.players.browser import CHROMIUM, NEXT_FRAME, SOFTWARE_WEBGL, Browser
from tests.players.test_browser import pixels, put, share, text, written
from tests.report.sample import matrix, sample_evidence, with_status

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: the ghost is seen in no browser")

GHOST = (194, 24, 122)
FIELD = ".viewer input[type=file]"
#: Below and above the words on the picture.
PICTURE = slice(100, -60)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The page of a left knee, without a pose at flexion 90 deg, varus 4 deg."""
    shown = with_status(sample_evidence("left", "CASE-7"), (9, 2), Status.SLID_OFF)
    with Browser(tmp_path_factory.mktemp("profile"), *SOFTWARE_WEBGL) as one:
        one.open(written(tmp_path_factory.mktemp("page"), shown))
        one.run("document.querySelector('.viewer canvas').scrollIntoView()")
        one.run("document.querySelector('input[name=axes]').click()")
        yield one


@pytest.fixture
def browser(opened: Browser) -> Browser:
    """The page without a ghost, at flexion 0."""
    opened.run("document.querySelector('button.remove').click()")
    put(opened, flexion=0, varus=0)
    return opened


def chosen(browser: Browser, file: Path) -> None:
    """Pick a file and wait until the page has answered."""
    browser.run("document.querySelectorAll('.ghost-who, .ghost-problem').forEach(one => { one.textContent = '' })")
    browser.run(f"document.querySelector('{FIELD}').value = ''")
    browser.choose(FIELD, file)
    said = "[...document.querySelectorAll('.ghost-who, .ghost-problem')].some(one => one.textContent)"
    browser.run(f"(async () => {{ while (!({said})) await new Promise(done => setTimeout(done, 20)) }})()")
    browser.run(NEXT_FRAME)


def scanned_elsewhere(evidence: Evidence) -> Evidence:
    """The same joint in another scan: turned and shifted as a whole."""
    c, s = np.cos(0.4), np.sin(0.4)
    motion = np.array([[c, -s, 0.0, 70.0], [s, c, 0.0, -30.0], [0.0, 0.0, 1.0, -200.0], [0.0, 0.0, 0.0, 1.0]])
    anatomy = evidence.anatomy
    reference, moving = (matrix(motion @ frame) for frame in (evidence.scan_from_reference, evidence.scan_from_moving))
    return replace(
        evidence,
        meshes={name: transformed(mesh, motion) for name, mesh in evidence.meshes.items()},
        reference=transformed(evidence.reference, motion),
        moving=transformed(evidence.moving, motion),
        anatomy=replace(anatomy, scan_from_reference=reference, scan_from_moving=moving),
    )


def shifted(evidence: Evidence, **by: float) -> Evidence:
    """The same joint with a table whose coordinates are all larger by so much."""
    poses = evidence.smooth.poses
    changed = {name: getattr(poses, name) + value for name, value in by.items()}
    return replace(evidence, smooth=replace(evidence.smooth, poses=replace(poses, **changed)))


def bent_less(evidence: Evidence) -> Evidence:
    """The same joint with a table that ends at 60 deg of flexion and covers no varus but 0."""
    smooth = evidence.smooth
    kept = {name: getattr(smooth.poses, name)[:7, 1:2] for name in smooth.poses.__dataclass_fields__}
    grid = Grid(smooth.grid.flexion_deg[:7], smooth.grid.varus_deg[1:2])
    return replace(evidence, smooth=replace(smooth, grid=grid, poses=replace(smooth.poses, **kept)))


def ghostly(browser: Browser) -> float:
    """Part of the picture that is of the ghost's colour, whatever is behind it."""
    return share(pixels(browser)[PICTURE], GHOST, 30)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_same_joint_in_another_scan_coincides_with_it_also_mirrored(
    browser: Browser, tmp_path: Path, side: Any
) -> None:
    other = scanned_elsewhere(sample_evidence(side, "CASE-8"))
    put(browser, flexion=57, varus=1.3)
    before = ghostly(browser)
    chosen(browser, written(tmp_path, other))
    whose = f"Ghost: Case CASE-8  |  {side.upper()} knee ({side[0].upper()})"
    mirrored = ", mirrored to lie over this left one" if side == "right" else ""
    this_one = "This one: Case CASE-7  |  LEFT knee (L), in its own colours."
    assert text(browser, ".ghost-who") == f"{whose}{mirrored}. {this_one}"
    assert (
        text(browser, ".ghost-difference") == "The lower bone of the other stands as this one does, to 0.1 mm and 0.1°."
    )
    assert ghostly(browser) - before < 0.002
    chosen(browser, written(tmp_path, shifted(other, anterior_mm=6.0)))
    assert ghostly(browser) - before > 0.01


def test_the_difference_is_said_in_words_at_every_attitude(browser: Browser, tmp_path: Path) -> None:
    other = shifted(sample_evidence("right"), anterior_mm=1.2, internal_rotation_deg=3.0)
    chosen(browser, written(tmp_path, other))
    words = "The lower bone of the other is 1.2 mm more anterior, 3.0° more internally rotated; otherwise the same."
    for flexion in (0, 33):
        put(browser, flexion=flexion)
        assert text(browser, ".ghost-difference") == words
    other = shifted(sample_evidence(), lateral_mm=-0.3, anterior_mm=-2.0, proximal_mm=-1.0, internal_rotation_deg=-4.0)
    chosen(browser, written(tmp_path, other))
    assert text(browser, ".ghost-difference") == (
        "The lower bone of the other is 0.3 mm more medial, 2.0 mm more posterior, 1.0 mm more distal, "
        "4.0° more externally rotated."
    )


def test_the_ghost_bends_by_its_own_table(browser: Browser, tmp_path: Path) -> None:
    other = sample_evidence()
    poses = other.smooth.poses
    rising = np.arange(13.0)[:, None] * np.ones((1, 3))
    bending = replace(poses, proximal_mm=poses.proximal_mm - rising)
    chosen(browser, written(tmp_path, replace(other, smooth=replace(other.smooth, poses=bending))))
    assert "stands as this one does" in text(browser, ".ghost-difference")
    put(browser, flexion=45)
    assert text(browser, ".ghost-difference").startswith("The lower bone of the other is 4.5 mm more distal;")


def test_the_ghost_can_be_hidden_and_removed(browser: Browser, tmp_path: Path) -> None:
    alone = pixels(browser)
    chosen(browser, written(tmp_path, shifted(sample_evidence(), anterior_mm=6.0)))
    shown = pixels(browser)
    assert (shown != alone).any(axis=-1).mean() > 0.01
    for press in ("input[name=ghost]", "input[name=ghost]", "button.remove"):
        browser.run(f"document.querySelector('{press}').click()")
        browser.run(NEXT_FRAME)
        hidden = press == "button.remove" or not browser.run("document.querySelector('input[name=ghost]').checked")
        np.testing.assert_array_equal(pixels(browser), alone if hidden else shown)
    assert browser.run("document.querySelector('.haunted').hidden") is True
    assert browser.run(f"document.querySelector('{FIELD}').files.length") == 0


def test_where_one_of_the_two_has_no_pose_it_is_said(browser: Browser, tmp_path: Path) -> None:
    chosen(browser, written(tmp_path, bent_less(sample_evidence("right", "CASE-8"))))
    put(browser, flexion=60)
    with_both = ghostly(browser)
    put(browser, flexion=61)
    assert text(browser, ".ghost-difference") == (
        "The other has no stable pose at this attitude, so its lower bone is not shown; "
        "it covers flexion 0.0° to 60.0° and varus 0.0° to 0.0°."
    )
    assert ghostly(browser) <= with_both
    chosen(browser, written(tmp_path, sample_evidence()))
    put(browser, flexion=85, varus=2)
    assert text(browser, ".ghost-difference") == (
        "This one has no stable pose at this attitude, so there is nothing to compare."
    )


#: What is changed in the data of a good report, and what is said of it.
SPOILT: dict[str, tuple[Callable[[Any], None], str]] = {
    "no heading": (lambda data: data.update(heading=7), "no heading"),
    "long heading": (lambda data: data.update(heading="x" * 201), "no heading"),
    "no table": (lambda data: data.pop("lut"), "no table"),
    "side": (lambda data: data["lut"].update(side="both"), "side"),
    "axis": (lambda data: data["lut"]["flexion_deg"].reverse(), "flexion_deg"),
    "axis of words": (lambda data: data["lut"].update(varus_deg=["a"]), "varus_deg"),
    "row": (lambda data: data["lut"]["lateral_mm"].pop(), "lateral_mm"),
    "cell": (lambda data: data["lut"]["anterior_mm"][3].pop(), "anterior_mm"),
    "null": (lambda data: data["lut"]["proximal_mm"][3].__setitem__(0, None), "proximal_mm"),
    "status": (lambda data: data["lut"]["status"][0].__setitem__(0, 99), "status"),
    "frame": (lambda data: data["lut"]["scan_from_reference"][0].__setitem__(0, 5), "scan_from_reference"),
    "parts": (lambda data: data.update(parts=[]), "no surfaces"),
    "part": (lambda data: data["parts"].append(None), "surface"),
    "body": (lambda data: data["parts"][0].update(body="other"), "surface without a body"),
    "low": (lambda data: data["parts"][0].update(low=[0, 0]), "surface without a place"),
    "step": (lambda data: data["parts"][0].update(step_mm=-1), "surface without a scale"),
    "points": (lambda data: data["parts"][0].update(points="AA!="), "surface of no triangles"),
    "corners": (lambda data: data["parts"][0].update(corners="AAAA////"), "surface with a corner that is nowhere"),
}


@pytest.fixture(scope="module")
def model() -> dict[str, Any]:
    """The data of a good report."""
    return dict(json.loads(json.dumps(viewer_data(sample_evidence(), PictureSettings()))))


def report(data: object) -> str:
    """A page with these data."""
    return f'<!DOCTYPE html><script type="application/json" id="viewer-data">{json.dumps(data)}</script>'


@pytest.mark.parametrize("name", SPOILT)
def test_a_damaged_report_is_refused_in_words(
    browser: Browser, tmp_path: Path, model: dict[str, Any], name: str
) -> None:
    spoil, words = SPOILT[name]
    data = copy.deepcopy(model)
    file = tmp_path / "report.html"
    file.write_text(report(data))
    chosen(browser, file)
    assert text(browser, ".ghost-problem") == ""
    spoil(data)
    file.write_text(report(data))
    chosen(browser, file)
    assert text(browser, ".ghost-problem") == (
        f"The model in this report cannot be used ({words}): the file is damaged, or another version made it."
    )
    assert browser.run("document.querySelector('.haunted').hidden") is True
    assert not browser.said("Runtime.exceptionThrown")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "This file is not a report of this program. Choose the report.html of another case."),
        ("<p>another page</p>", "This file is not a report of this program. Choose the report.html of another case."),
        (report({}) * 2, "This file is not a report of this program. Choose the report.html of another case."),
        (report({}).replace("application/json", ""), "This file is not a report of this program."),
        (report({}).replace("{}", "{"), "The model in this report cannot be used (not JSON)"),
        (report(None), "The model in this report cannot be used (no model)"),
        ("\0\xff" * 1000, "This file is not a report of this program."),
    ],
)
def test_what_is_no_report_is_refused_in_words(browser: Browser, tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "other.html").write_text(content)
    chosen(browser, tmp_path / "other.html")
    assert text(browser, ".ghost-problem").startswith(words)
    assert not browser.said("Runtime.exceptionThrown")


def test_another_joint_is_refused(browser: Browser, tmp_path: Path, model: dict[str, Any]) -> None:
    (tmp_path / "other.html").write_text(report({**model, "joint": "elbow"}))
    chosen(browser, tmp_path / "other.html")
    assert text(browser, ".ghost-problem") == "That report is of another joint: elbow. This one: knee."


def test_nothing_is_asked_for_and_nothing_is_complained_of(browser: Browser) -> None:
    assert browser.complaints() == []
