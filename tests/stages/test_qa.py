"""The stage as a whole: what it reads and leaves, that it is the same every time, and what it must not load."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from typing import Any

import numpy as np
import pytest

from pipeline.adapters import rendering
from pipeline.adapters.pictures import blank, png
from pipeline.adapters.workers import map_in_order
from pipeline.artifacts import CT, REPORT, VERDICT
from pipeline.engine.stage import Findings, Severity
from pipeline.errors import EnvironmentFault
from pipeline.geometry.volume import CtVolume
from pipeline.kinematics.table import Status
from pipeline.report import figures
from pipeline.report.build import STYLE, TEMPLATE
from pipeline.report.motion import MOTION
from pipeline.report.settings import Limits, PictureSettings
from pipeline.stages.qa import STAGE, Params, gather
from tests.adapters.worker_tasks import die
from tests.report.memory import MemoryOutputs, reads_of
from tests.report.sample import only_one_attitude, sample_evidence, with_status

SMALL = Params(pictures=PictureSettings(panel_px=150, flexions_deg=[0.0, 90.0], motion_poses=3))
IMAGES = {figure.file for figure in figures.expected_figures(sample_evidence())}
FILM = "images/motion.webm"
DOCUMENTS = {"report.html", "report.pdf"}


@pytest.fixture(scope="module")
def sound() -> tuple[Findings, MemoryOutputs]:
    """The stage run on a case with nothing wrong."""
    out = MemoryOutputs()
    return STAGE.run(reads_of(sample_evidence()), SMALL, out), out


def test_the_stage_tells_how_long_each_part_took(sound: tuple[Findings, MemoryOutputs]) -> None:
    _, out = sound
    assert out.parts[0] == "what the stages left, and numbers"
    assert "drawing 'The joint at several flexions'" in out.parts
    assert out.parts[-2:] == ["report.html", "report.pdf"]


def test_a_sound_case_passes_with_all_pictures(sound: tuple[Findings, MemoryOutputs]) -> None:
    findings, out = sound
    assert findings == ()
    assert out.value(VERDICT).word == "PASS"
    files = out.value(REPORT)
    assert set(files) == {*DOCUMENTS, *IMAGES, FILM}
    assert set(out.files) == {artifact.name for artifact in STAGE.writes}
    count = len(IMAGES) + 1
    assert (out.steps[0], out.steps[-1]) == ((0, count), (count, count))


def test_the_report_is_small_and_holds_the_same_pictures(sound: tuple[Findings, MemoryOutputs]) -> None:
    files = sound[1].value(REPORT)
    assert len(files["report.html"]) < 3_000_000
    assert len(files["report.pdf"]) < 1_500_000
    assert files["report.html"].count(b'<img alt="') == len(IMAGES)
    assert files["report.html"].count(b"<video ") == 1
    assert files[FILM][:4] == b"\x1a\x45\xdf\xa3"


def test_a_second_run_gives_the_same_bytes(sound: tuple[Findings, MemoryOutputs]) -> None:
    out = MemoryOutputs()
    STAGE.run(reads_of(sample_evidence()), SMALL, out)
    assert out.files == sound[1].files


def test_two_jobs_give_the_same_bytes(sound: tuple[Findings, MemoryOutputs]) -> None:
    out = MemoryOutputs(jobs=2)
    STAGE.run(reads_of(sample_evidence()), SMALL, out)
    assert out.files == sound[1].files
    assert out.steps == sound[1].steps


def test_a_worker_that_the_renderer_ends_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    rendering.require_renderer.cache_clear()
    monkeypatch.setattr("pipeline.stages.qa.map_in_order", lambda _, *rest: map_in_order(die, *rest))
    monkeypatch.setattr(rendering, "_PROBE", "import os; os.abort()")
    with pytest.raises(EnvironmentFault, match="E-ENV-10"):
        STAGE.run(reads_of(sample_evidence()), SMALL, MemoryOutputs(jobs=2))


def test_a_broken_guarantee_is_a_review_finding_of_its_number() -> None:
    evidence = with_status(sample_evidence(), (9, 1), Status.SLID_OFF)
    contact = np.where(np.arange(39).reshape(13, 3) == 7, 0.05, evidence.smooth.contact_error_mm)
    out = MemoryOutputs()
    findings = STAGE.run(
        reads_of(replace(evidence, smooth=replace(evidence.smooth, contact_error_mm=contact))), SMALL, out
    )
    assert [finding.code for finding in findings] == ["W-QA-03", "W-QA-05"]
    assert {finding.severity for finding in findings} == {Severity.REVIEW}
    assert out.value(VERDICT).word == "REVIEW"
    assert out.value(VERDICT).reasons == tuple(finding.message for finding in findings)


def test_a_picture_that_cannot_be_drawn_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> bytes:
        raise ValueError("nothing to see")

    def draw(figure: figures.Figure, **rest: Any) -> figures.Drawn:
        return figures.drawn(figure, **rest) if figure.name == "slices" else figures.Drawn(figure, png(blank(4, 3)))

    monkeypatch.setattr(figures, "SLICES", replace(figures.SLICES, draw=refuse))
    monkeypatch.setattr("pipeline.stages.qa.drawn", draw)
    out = MemoryOutputs()
    (finding,) = STAGE.run(reads_of(sample_evidence()), SMALL, out)
    assert finding.code == "W-QA-10"
    assert finding.message == "The picture 'Surfaces in three planes' is missing: nothing to see."
    assert b"This picture is missing: nothing to see." in out.value(REPORT)["report.html"]
    assert "images/slices.png" not in out.value(REPORT)


def test_a_film_that_cannot_be_made_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(figure: figures.Figure, **rest: Any) -> figures.Drawn:
        return figures.drawn(figure, **rest) if figure == MOTION else figures.Drawn(figure, png(blank(4, 3)))

    monkeypatch.setattr("pipeline.stages.qa.drawn", draw)
    evidence = sample_evidence()
    for flexion in range(1, 13):
        evidence = with_status(evidence, (flexion, 1), Status.SLID_OFF)
    out = MemoryOutputs()
    findings = STAGE.run(reads_of(evidence), SMALL, out)
    why = "fewer than two flexions have a stable pose at neutral varus"
    missed = [finding for finding in findings if finding.code == "W-QA-10"]
    assert [finding.message for finding in missed] == [f"The picture '{MOTION.title}' is missing: {why}."]
    assert f'<p class="missing">This film is missing: {why}.</p>'.encode() in out.value(REPORT)["report.html"]
    assert FILM not in out.value(REPORT)


def test_of_a_ct_the_report_keeps_the_planes_it_shows() -> None:
    evidence = sample_evidence()
    assert evidence.labels is not None
    ct = CtVolume(np.asarray(evidence.labels.values).astype(np.int16) * 100 - 50, evidence.labels.lps_from_index)
    reads = reads_of(evidence)
    assert gather(reads, SMALL.pictures).ct_cuts is None
    reads.values[CT.name] = ct
    cuts = gather(reads, SMALL.pictures).ct_cuts
    assert cuts is not None
    assert len(cuts) == 4
    for cut in cuts:
        assert set(np.unique(cut)) <= {-1024, *(100 * np.unique(evidence.labels.values).astype(int) - 50)}
        assert np.asarray(cut).max() > 0


def test_settings_read_as_a_protocol_gives_them() -> None:
    given = Params.model_validate_json('{"limits": {"max_contact_error_mm": 0.5}, "pictures": {"flexions_deg": [10]}}')
    assert given.limits == Limits(max_contact_error_mm=0.5)
    assert given.pictures.flexions_deg == [10.0]


def test_a_run_from_the_cache_loads_no_library_that_draws() -> None:
    heavy = ("vtk", "vtkmodules", "fast_simplification", "matplotlib", "cv2", "jinja2", "weasyprint")
    code = f"import sys, pipeline.stages.qa; print([n for n in {heavy} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_table_of_one_attitude_is_reported() -> None:
    evidence = only_one_attitude(sample_evidence("left"))
    out = MemoryOutputs()
    assert STAGE.run(reads_of(evidence), SMALL, out) == ()
    files = out.value(REPORT)
    assert set(files) == {*DOCUMENTS, *(figure.file for figure in figures.expected_figures(evidence))}
    assert FILM not in files
    assert b"<video " not in files["report.html"]


def test_a_change_of_any_part_of_the_page_runs_the_stage_again() -> None:
    parts, unread = set[str](), [TEMPLATE, STYLE]
    while unread:
        parts.add(name := unread.pop())
        unread += re.findall(r'{% include "(.+?)" %}', resources.files("pipeline.report").joinpath(name).read_text())
    assert len(parts) >= 4
    assert {f"pipeline.report:{name}" for name in parts} <= set(STAGE.resources)
