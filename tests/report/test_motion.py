"""The film: every frame says whose joint and which attitude, and every pose is another picture."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pipeline.geometry.mesh import TriangleMesh
from pipeline.kinematics.table import Status
from pipeline.records import Side
from pipeline.report import motion
from pipeline.report.build import Page, picture_files, report_html, report_pdf
from pipeline.report.evidence import Evidence
from pipeline.report.figures import Drawn, drawn
from pipeline.report.motion import MOTION, expected_motion, motion_frames
from pipeline.report.settings import Limits, PictureSettings
from pipeline.report.verdict import judge
from tests.report.sample import only_one_attitude, sample_evidence, with_status

SMALL = PictureSettings(panel_px=150, motion_poses=7)
#: Where the panels of a frame of the small film are.
LATERAL, ANTERIOR = (slice(86, 236), slice(0, 150)), (slice(86, 236), slice(156, 306))
#: Where the attitude is written.
ATTITUDE = (slice(56, 86), slice(None))


def without(evidence: Evidence, *flexions: int) -> Evidence:
    """The same evidence with no pose at these flexions of neutral varus."""
    for index in flexions:
        evidence = with_status(evidence, (index, 1), Status.SLID_OFF)
    return evidence


def attitudes(lines: list[str]) -> list[str]:
    """The lines that say an attitude."""
    return [line for line in lines if line.startswith("flexion")]


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_frame_says_whose_it_is_and_where_it_is_seen_from(side: Side, written: list[str]) -> None:
    frames = motion_frames(sample_evidence(side, "CASE-7"), SMALL)
    assert f"Case CASE-7  |  {side.upper()} knee ({side[0].upper()})" in written
    assert "Research use - not for diagnosis" in written
    assert {"medial", "lateral", "anterior", "posterior", "seen from lateral", "seen from anterior"} <= set(written)
    heads, feet = ({frame[rows].tobytes() for frame in frames} for rows in (slice(0, 56), slice(236, None)))
    assert len(heads) == len(feet) == 1
    assert (frames[0][:56] < 128).any()


def test_the_controls_of_a_player_cover_nothing() -> None:
    frame = motion_frames(sample_evidence(), SMALL)[0]
    assert (frame[-64:] == 255).all()
    assert (frame[236:-64] < 128).any()


def test_the_flexion_goes_from_the_lowest_to_the_highest_that_has_a_pose(written: list[str]) -> None:
    motion_frames(sample_evidence(), SMALL)
    assert attitudes(written) == [f"flexion {flexion}.0°, varus 0.0°" for flexion in range(0, 121, 20)]
    written.clear()
    motion_frames(without(sample_evidence(), 0, 11, 12), SMALL)
    assert attitudes(written)[0] == "flexion 10.0°, varus 0.0°"
    assert attitudes(written)[-1] == "flexion 100.0°, varus 0.0°"


def test_a_picture_is_never_that_of_the_pose_before() -> None:
    """The renderer gives the pixels of the frame before unless it is told to draw again."""
    frames = motion_frames(sample_evidence(), SMALL)
    for one, other in pairwise(frames):
        for part in (LATERAL, ANTERIOR, ATTITUDE):
            assert (one[part] != other[part]).any(axis=-1).mean() > 0.003
    again = motion_frames(sample_evidence(), SMALL)
    assert all((one == same).all() for one, same in zip(frames, again, strict=True))


def test_the_lower_bone_swings_backwards_and_the_upper_one_stands() -> None:
    frames = motion_frames(sample_evidence(), SMALL)
    straight, bent = (np.asarray((frame[LATERAL] < 235).any(axis=-1)) for frame in (frames[0], frames[4]))
    # A right knee from lateral: anterior is on the right.
    below, behind = (slice(110, 135), slice(65, 90)), (slice(80, 90), slice(10, 40))
    assert straight[below].mean() > bent[below].mean() + 0.3
    assert bent[behind].mean() > straight[behind].mean() + 0.3
    shaft = (slice(86 + 48, 86 + 60), slice(70, 80))
    assert (frames[0][shaft] == frames[1][shaft]).all()
    assert (frames[0][shaft] < 250).any()


def test_a_left_knee_is_the_mirror_image_of_a_right_one() -> None:
    right, left = (motion_frames(sample_evidence(side), SMALL)[3][ANTERIOR] for side in ("right", "left"))
    body = (slice(45, 135), slice(30, 120))
    shown, other = (np.asarray((image[body] < 235).any(axis=-1)) for image in (right, left))
    assert np.mean(shown != other[:, ::-1]) < 0.03


def test_a_flexion_without_a_pose_is_a_frame_that_says_so(written: list[str]) -> None:
    evidence = without(sample_evidence(), 6)
    motion_frames(evidence, SMALL)
    assert attitudes(written)[3] == "flexion 60.0°, varus 0.0°"
    assert written.count("No stable pose here") == 1
    assert written.index("No stable pose here") < written.index("flexion 60.0°, varus 0.0°")


@pytest.mark.parametrize("kept", [0, 1])
def test_without_two_poses_there_is_no_film_and_the_reason_is_kept(kept: int) -> None:
    evidence = without(sample_evidence(), *range(kept, 13))
    done = drawn(MOTION, evidence, SMALL, Limits())
    assert done.data == b""
    assert done.problem == "fewer than two flexions have a stable pose at neutral varus"


def test_a_table_of_one_flexion_has_no_motion() -> None:
    assert expected_motion(sample_evidence()) == (MOTION,)
    assert expected_motion(only_one_attitude(sample_evidence())) == ()


def test_surfaces_that_were_made_are_said_to_be(written: list[str]) -> None:
    evidence = sample_evidence()
    origins = (evidence.origins[0], replace(evidence.origins[1], origin="synthesised"), *evidence.origins[2:])
    motion_frames(replace(evidence, origins=origins), SMALL)
    assert {"femur", "femoral cartilage (made by the program)", "tibia", "fibula"} <= set(written)
    assert "patella" not in written


@pytest.mark.parametrize("case_id", ["A", "A" * 64])
def test_the_side_is_not_cut_off_by_a_long_name(case_id: str) -> None:
    frame = motion_frames(sample_evidence("left", case_id), SMALL)[0]
    inked = np.flatnonzero((frame[:36] < 128).any(axis=(0, 2)))
    assert inked[0] >= 12
    assert inked[-1] <= frame.shape[1] - 10


def test_frames_fit_into_a_film_whatever_the_legend() -> None:
    for count in range(6):
        evidence = replace(sample_evidence(), origins=sample_evidence().origins[:count])
        height, width = motion_frames(evidence, replace_panel(151))[0].shape[:2]
        assert (height % 2, width % 2) == (0, 0)


def replace_panel(panel_px: int) -> PictureSettings:
    """Settings of a film of two frames."""
    return PictureSettings(panel_px=panel_px, motion_poses=2)


def test_large_bodies_are_drawn_with_fewer_triangles_and_look_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = sample_evidence()
    whole = motion_frames(evidence, SMALL)
    counts: list[int] = []
    fewer = motion._fewer

    def counted(mesh: TriangleMesh, most: int) -> TriangleMesh:
        counts.append(len(fewer(mesh, most).triangles))
        return fewer(mesh, most)

    monkeypatch.setattr(motion, "_fewer", counted)
    monkeypatch.setattr(motion, "TRIANGLES", len(evidence.reference.triangles) // 2)
    smaller = motion_frames(evidence, SMALL)
    assert counts[0] <= len(evidence.reference.triangles) // 2 + 2
    for one, other in zip(whole, smaller, strict=True):
        assert np.mean(np.abs(one.astype(int) - other).max(axis=-1) > 60) < 0.03


def test_the_film_is_the_same_every_time_and_stands_in_the_report() -> None:
    evidence = sample_evidence()
    film = drawn(MOTION, evidence, SMALL, Limits())
    assert film.problem == ""
    assert film == drawn(MOTION, evidence, SMALL, Limits())
    page = Page(evidence, judge((), (), {}), [film], (), SMALL)
    assert picture_files(page) == {"images/motion.webm": film.data}
    assert report_html(page).count(b'src="data:video/webm;base64,') == 1
    assert b"This film is missing" not in report_html(page)


def test_on_paper_a_sentence_stands_in_place_of_the_film(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.report.build.pdf", lambda html: html.encode())

    def paper(*films: Drawn) -> bytes:
        return report_pdf(Page(sample_evidence(), judge((), (), {}), films, (), SMALL))

    shown, missing = paper(Drawn(MOTION, b"film")), paper(Drawn(MOTION, b"", "there is no pose"))
    assert b"<video" not in shown + missing
    assert b"film" in shown
    assert b"film" not in paper()
    assert b"This film is missing" not in shown
    assert b'<p class="missing">This film is missing: there is no pose.</p>' in missing


def test_hostile_text_stays_within_its_quotes() -> None:
    evidence = sample_evidence("right", '"><script>alert(1)</script>')
    page = report_html(Page(evidence, judge((), (), {}), [Drawn(MOTION, b"film")], (), SMALL))
    assert b"<script>alert(1)" not in page
    assert b"case &#34;&gt;&lt;script&gt;" in page[page.index(b"<video") :].partition(b"</video>")[0]


def test_a_film_is_small_at_its_usual_size() -> None:
    film = drawn(MOTION, sample_evidence(), PictureSettings(), Limits())
    assert 20_000 < len(film.data) < 1_000_000
