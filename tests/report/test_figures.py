"""What is written on the pictures, and that they show what they are of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pipeline.adapters.pictures import Image
from pipeline.geometry.volume import CtVolume
from pipeline.kinematics.table import Status
from pipeline.records import Side
from pipeline.report import figure_curves
from pipeline.report.evidence import Evidence
from pipeline.report.figure_bones import bones_picture
from pipeline.report.figure_curves import shown_varus
from pipeline.report.figure_poses import body_colors, contact_picture, distance_colors, near_distances, poses_picture
from pipeline.report.figure_slices import ct_cuts, slices_picture
from pipeline.report.figures import drawn, expected_figures
from pipeline.report.palette import BONE, OVERLAP, structure_color
from pipeline.report.settings import Limits, PictureSettings
from tests.report.sample import sample_evidence, with_status

SMALL = PictureSettings(panel_px=150, flexions_deg=[0.0, 90.0])
Draw = Callable[[Evidence, PictureSettings], Image]
DRAWN: tuple[Draw, ...] = (slices_picture, bones_picture, poses_picture, contact_picture)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("draw", DRAWN)
def test_every_picture_says_whose_it_is_and_which_way_up(draw: Draw, side: Side, written: list[str]) -> None:
    draw(sample_evidence(side, "CASE-7"), SMALL)
    assert f"Case CASE-7  |  {side.upper()} knee ({side[0].upper()})" in written
    assert "Research use - not for diagnosis" in written
    assert {"medial", "lateral", "anterior", "posterior"} <= set(written)


@pytest.mark.parametrize("draw", [poses_picture, contact_picture])
def test_every_pose_says_its_attitude(draw: Draw, written: list[str]) -> None:
    draw(sample_evidence(), SMALL)
    assert {"flexion 0°, varus 0°", "flexion 90°, varus 0°"} <= set(written)


def test_a_left_knee_is_the_mirror_image_of_a_right_one() -> None:
    def silhouette(side: Side) -> Image:
        return poses_picture(sample_evidence(side), PictureSettings(panel_px=200, flexions_deg=[0.0, 60.0]))

    right, left = silhouette("right"), silhouette("left")
    # Anterior view at 60 deg, below the words; the fibula makes it lopsided.
    panel = (slice(64 + 50, 64 + 185), slice(206 + 45, 206 + 155))
    shown, other = (np.asarray((image[panel] < 235).any(axis=-1)) for image in (right, left))
    assert np.mean(shown != other[:, ::-1]) < 0.03
    assert np.mean(shown != other) > 0.05


def test_an_attitude_without_a_pose_says_why(written: list[str]) -> None:
    evidence = with_status(sample_evidence(), (9, 1), Status.SLID_OFF)
    poses_picture(evidence, SMALL)
    assert {"No stable pose here:", "slid off"} <= set(written)


@pytest.mark.parametrize("draw", [poses_picture, contact_picture])
def test_no_pose_at_all_is_no_picture(draw: Draw) -> None:
    evidence = with_status(with_status(sample_evidence(), (9, 1), Status.SLID_OFF), (0, 1), Status.NO_CONTACT)
    with pytest.raises(ValueError, match="no attitude that is shown has a stable pose"):
        draw(evidence, SMALL)


def test_what_the_table_does_not_move_is_named(written: list[str]) -> None:
    poses_picture(sample_evidence(), SMALL)
    assert any(line.endswith("left out, as the table does not move it: patella") for line in written)


def test_surfaces_that_were_made_are_drawn_and_said_to_be(written: list[str]) -> None:
    evidence = sample_evidence()
    structure = evidence.origins[1].structure
    origins = (evidence.origins[0], replace(evidence.origins[1], origin="synthesised"), *evidence.origins[2:])
    shown = replace(evidence, origins=origins, meshes={**evidence.meshes, structure: evidence.reference})
    poses_picture(shown, SMALL)
    assert f"{structure.replace('_', ' ')} (made by the program)" in written
    assert (body_colors(shown, "reference") == structure_color(structure)).all(axis=1).any()


def test_distances_are_exact_within_reach_and_infinite_beyond() -> None:
    evidence = sample_evidence()
    frame = evidence.scan_from_reference
    offsets = np.array([20.0 + 1.5, 20.0 - 0.5, 90.0])
    points = frame[:3, 3] - offsets[:, None] * frame[:3, 1] + 22.0 * frame[:3, 0]
    distance = near_distances(points, evidence.reference, 6.0)
    assert distance[:2] == pytest.approx([1.5, -0.5], abs=0.1)
    assert distance[2] == np.inf


def test_distance_colours() -> None:
    colors = distance_colors(np.array([0.0, 3.9, 4.1, np.inf, -0.1, -0.2]), SMALL)
    assert tuple(colors[0]) == tuple(colors[4])
    assert colors[1].sum() > colors[0].sum()
    assert [tuple(color) for color in colors[2:4].tolist()] == [BONE, BONE]
    assert tuple(colors[5].tolist()) == OVERLAP


def test_a_case_of_meshes_has_no_slices() -> None:
    evidence = sample_evidence()
    meshes = replace(evidence, facts=replace(evidence.facts, source="meshes"), labels=None)
    assert next(figure.name for figure in expected_figures(evidence)) == "slices"
    assert "slices" not in [figure.name for figure in expected_figures(meshes)]
    with pytest.raises(ValueError, match="brought surfaces, neither CT nor label map"):
        slices_picture(meshes, SMALL)


def cut_ct(evidence: Evidence) -> Evidence:
    """The same case with a CT: bone where the labels are, soft tissue in one half of the scan, air in the other."""
    assert evidence.labels is not None
    labelled = np.asarray(evidence.labels.values) > 0
    values = np.full(labelled.shape, -1000, dtype=np.int16)
    values[: len(values) // 2] = 40
    values[labelled] = 1400
    ct = CtVolume(values, evidence.labels.lps_from_index)
    return replace(evidence, ct_cuts=ct_cuts(evidence, ct, SMALL))


def test_slices_show_the_ct_in_a_bone_window(written: list[str]) -> None:
    evidence = sample_evidence()
    shown, plain = slices_picture(cut_ct(evidence), SMALL), slices_picture(evidence, SMALL)
    assert "CT (bone window, -250 to 1250 HU) and outlines of the surfaces (colour)" in written
    assert shown.shape == plain.shape
    greys = shown[(np.ptp(shown.astype(np.int64), axis=-1) == 0)]
    bone, tissue, air = ((greys == level).all(axis=-1).sum() for level in (255, 49, 0))
    assert min(bone, tissue, air) > 1000


def test_a_ct_beside_meshes_is_shown() -> None:
    evidence = cut_ct(sample_evidence())
    meshes = replace(evidence, facts=replace(evidence.facts, source="meshes"), labels=None)
    assert expected_figures(meshes)[0].name == "slices"
    assert np.array_equal(slices_picture(meshes, SMALL), slices_picture(evidence, SMALL))


def test_charts_hold_at_most_five_varus_with_the_neutral_one() -> None:
    evidence = sample_evidence()
    grid = replace(evidence.smooth.grid, varus_deg=np.arange(-5.0, 6.0))
    wide = replace(evidence, smooth=replace(evidence.smooth, grid=grid))
    assert shown_varus(evidence) == [0, 1, 2]
    assert len(shown_varus(wide)) == figure_curves.MAX_CURVES
    assert 5 in shown_varus(wide)


def test_a_figure_that_cannot_be_drawn_keeps_its_reason() -> None:
    evidence = sample_evidence()
    for i in range(13):
        for j in range(3):
            evidence = with_status(evidence, (i, j), Status.NO_CONTACT)
    done = {f.name: drawn(f, evidence, SMALL, Limits()) for f in expected_figures(evidence) if f.name != "slices"}
    assert done["checks"].problem == "no entry of the table is usable"
    assert not done["poses"].data
    assert done["curves"].data
