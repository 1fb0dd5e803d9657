"""The charts of the report: what each line stands for, and which charts there are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from pipeline.adapters.plotting import Area, Band, Chart, Curve, Points, Words, Zone
from pipeline.kinematics.baselines import walker_motion
from pipeline.kinematics.table import Grid, Status
from pipeline.records import AxisEstimate, BaselineCost, Side
from pipeline.report import figure_checks, figure_curves, figure_neutral, figure_paths
from pipeline.report.contact_paths import ContactPath
from pipeline.report.evidence import Evidence
from pipeline.report.figure_checks import checks_png, repeats_png
from pipeline.report.figure_curves import curves_png
from pipeline.report.figure_neutral import baselines_png, neutral_png
from pipeline.report.figure_paths import paths_png
from pipeline.report.figures import expected_figures
from pipeline.report.published import CHANGES, HYSTERESIS_SOURCE
from pipeline.report.settings import Limits, PictureSettings
from tests.report.sample import only_one_attitude, sample_evidence, with_status

#: Draws the chart of an evidence with these paths.
DrawPaths = Callable[..., None]

LATERAL, ANTERIOR, PROXIMAL, ROTATION, VARUS = range(5)
#: Flexion, varus, rotation (deg), lateral, anterior, proximal (mm) of another scan.
SCAN = (12.0, 0.5, -2.0, 1.5, -3.0, -21.0)


@pytest.fixture
def charts(monkeypatch: pytest.MonkeyPatch) -> list[Chart]:
    """Every chart that is drawn; drawing itself is left out."""
    seen: list[Chart] = []

    def remember(heading: str, footer: str, drawn: list[Chart], *_: object) -> bytes:
        assert heading.startswith("Case SAMPLE-1  |  ")
        assert footer == "Research use - not for diagnosis"
        seen.extend(drawn)
        return b"PNG"

    for module in (figure_checks, figure_curves, figure_neutral, figure_paths):
        monkeypatch.setattr(module, "charts_png", remember)
    return seen


def labelled(chart: Chart, words: str) -> Iterator[Curve | Area]:
    """What of a chart has a label with these words."""
    return (one for one in (*chart.areas, *chart.curves) if words in one.label)


def scanned_at(evidence: Evidence) -> Evidence:
    return replace(evidence, anatomy=replace(evidence.anatomy, scan_attitude=SCAN))


def raw_off_by(evidence: Evidence, **away: float) -> Evidence:
    """The raw poses that differ from the smoothed ones by so much everywhere."""
    changed = {name: getattr(evidence.smooth.poses, name) + value for name, value in away.items()}
    return replace(evidence, raw=replace(evidence.raw, poses=replace(evidence.smooth.poses, **changed)))


def test_five_coordinates_are_shown_against_the_sixth(charts: list[Chart]) -> None:
    neutral_png(sample_evidence())
    assert [(chart.title, chart.y_label) for chart in charts] == [
        ("Lateral shift (mm)", "mm"),
        ("Anterior shift (mm)", "mm"),
        ("Proximal shift (mm)", "mm"),
        ("Internal rotation (deg)", "deg"),
        ("Varus at which both sides touch (deg)", "deg"),
    ]
    assert {chart.x_label for chart in charts} == {"Flexion (deg)"}


def test_the_blue_band_is_the_usual_distance_of_dots_and_line(charts: list[Chart]) -> None:
    evidence = raw_off_by(sample_evidence(), lateral_mm=0.3, internal_rotation_deg=-2.0)
    neutral_png(evidence)
    for number, name, wide in (
        (LATERAL, "lateral_mm", 0.3),
        (ANTERIOR, "anterior_mm", 0.0),
        (ROTATION, "internal_rotation_deg", 2.0),
    ):
        (band,) = labelled(charts[number], "usually lie off")
        assert isinstance(band, Band)
        values = getattr(evidence.smooth.poses, name)[:, 1]
        np.testing.assert_allclose([band.low, band.high], [values - wide, values + wide], rtol=0, atol=1e-12)


def test_the_blue_band_looks_no_farther_than_ten_degrees_and_knows_nothing_without_dots(charts: list[Chart]) -> None:
    evidence = raw_off_by(sample_evidence())
    anterior = evidence.raw.poses.anterior_mm.copy()
    anterior[3, 1] += 3.0
    anterior[7:, 1] = np.nan
    neutral_png(replace(evidence, raw=replace(evidence.raw, poses=replace(evidence.raw.poses, anterior_mm=anterior))))
    (band,) = labelled(charts[ANTERIOR], "usually lie off")
    assert isinstance(band, Band)
    # one of three dots is 3 mm off: the root of 9 / 3
    expected = [0.0, 0.0, 3.0, 3.0, 3.0, 0.0, 0.0, 0.0, *5 * [np.nan]]
    np.testing.assert_allclose((band.high - band.low) ** 2 / 4.0, expected, rtol=0, atol=1e-12)


def test_zones_say_where_bending_and_straightening_differ(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    shift, turn = evidence.raw.hysteresis_mm.copy(), evidence.raw.hysteresis_deg.copy()
    shift[2:4], turn[9] = 1.5, 2.5
    shift[:, 0] = 9.0
    neutral_png(replace(evidence, raw=replace(evidence.raw, hysteresis_mm=shift, hysteresis_deg=turn)))
    for number in (LATERAL, ANTERIOR, PROXIMAL, ROTATION):
        zones = [(one.first, one.last) for one in charts[number].areas if isinstance(one, Zone)]
        assert zones == [(20.0, 30.0), (90.0, 90.0)]


def test_baselines_pass_through_the_scan(charts: list[Chart]) -> None:
    evidence = scanned_at(sample_evidence())
    neutral_png(evidence)
    flexion = evidence.smooth.grid.flexion_deg
    for number, own in zip((LATERAL, ANTERIOR, PROXIMAL, ROTATION, VARUS), (*SCAN[3:], SCAN[2], SCAN[1]), strict=True):
        (hinge,) = labelled(charts[number], "plain hinge")
        assert isinstance(hinge, Curve)
        np.testing.assert_array_equal(hinge.y, np.full(len(flexion), own))
    (walker,) = labelled(charts[ROTATION], "Walker 1988")
    assert isinstance(walker, Curve)
    change = walker_motion(flexion).internal_rotation_deg - walker_motion(np.array(SCAN[0])).internal_rotation_deg
    np.testing.assert_allclose(walker.y, SCAN[2] + change, rtol=0, atol=1e-12)


def test_baselines_that_were_not_asked_for_are_not_shown(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    plain = replace(evidence, sweep=replace(evidence.sweep, baselines=()))
    neutral_png(plain)
    for chart in charts:
        assert not [*labelled(chart, "hinge"), *labelled(chart, "Walker")]
    assert "baselines" in [figure.name for figure in expected_figures(evidence)]
    assert "baselines" not in [figure.name for figure in expected_figures(plain)]


def test_published_changes_begin_at_this_knees_own_extension(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    own = evidence.smooth.poses.internal_rotation_deg[0, 1] + 4.0
    rotation = evidence.smooth.poses.internal_rotation_deg + 4.0
    neutral_png(
        replace(
            evidence,
            smooth=replace(evidence.smooth, poses=replace(evidence.smooth.poses, internal_rotation_deg=rotation)),
        )
    )
    (chen,), (span,) = labelled(charts[ROTATION], "Chen 2014"), labelled(charts[ROTATION], "Gasparutto 2017")
    assert isinstance(chen, Curve)
    assert isinstance(span, Band)
    # 11.6 +- 3.2 deg at 40 deg; up to 15 deg until 61 deg
    np.testing.assert_array_equal(chen.x, [40.0, 40.0])
    np.testing.assert_allclose(chen.y, [own + 8.4, own + 14.8], rtol=0, atol=1e-12)
    np.testing.assert_allclose([*span.x, *span.low, *span.high], [0.0, 61.0, own, own, own + 15.0, own + 15.0])
    (valgus,) = labelled(charts[VARUS], "Gasparutto 2017")
    assert isinstance(valgus, Band)
    assert [*valgus.low, *valgus.high] == [-10.0, -10.0, 0.0, 0.0]
    for number in (LATERAL, ANTERIOR, PROXIMAL):
        assert not [one for change in CHANGES for one in labelled(charts[number], change.source)]


def test_nothing_published_without_extension_nor_for_another_joint(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    bent = Grid(evidence.smooth.grid.flexion_deg + 10.0, evidence.smooth.grid.varus_deg)
    neutral = replace(evidence.neutral, flexion_deg=bent.flexion_deg)
    neutral_png(
        replace(
            evidence, smooth=replace(evidence.smooth, grid=bent), raw=replace(evidence.raw, grid=bent), neutral=neutral
        )
    )
    neutral_png(replace(evidence, facts=replace(evidence.facts, joint="elbow")))
    assert len(charts) == 10
    for chart in charts:
        assert not [one for change in CHANGES for one in labelled(chart, change.source)]


def test_the_bar_at_the_scan_is_what_its_two_axes_leave_open(charts: list[Chart]) -> None:
    evidence = scanned_at(sample_evidence())
    neutral_png(evidence)
    assert not list(labelled(charts[ROTATION], "axes are known"))
    # flexion axis 0.8 deg and tibial long axis 1.7 deg
    (bar,) = labelled(charts[VARUS], "axes are known")
    assert isinstance(bar, Curve)
    np.testing.assert_allclose(bar.y, SCAN[1] + np.array([-1.0, 1.0]) * np.hypot(0.8, 1.7), rtol=0, atol=1e-12)
    axes = (*evidence.anatomy.axes, AxisEstimate("tibial_mediolateral_axis", (1.0, 0.0, 0.0), 0.6, "plateau"))
    neutral_png(replace(evidence, anatomy=replace(evidence.anatomy, axes=axes)))
    (bar,) = labelled(charts[5 + ROTATION], "axes are known")
    assert isinstance(bar, Curve)
    np.testing.assert_allclose(bar.y, [SCAN[2] - 1.0, SCAN[2] + 1.0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(bar.x, [SCAN[0], SCAN[0]])


def test_the_cost_of_a_baseline_is_written_and_drawn(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    baselines_png(evidence, Limits(max_midpoint_error_mm=0.3))
    (hinge,) = labelled(charts[0], "plain hinge: overlap up to 1.2 mm, gap up to 0.5 mm")
    (walker,) = labelled(charts[0], "Walker 1988): overlap up to 4.0 mm, gap up to 0.0 mm")
    assert isinstance(hinge, Curve)
    assert isinstance(walker, Curve)
    assert (hinge.x.tolist(), hinge.y.tolist()) == ([0.0, 60.0, 120.0], [0.0, -1.25, 0.5])
    for chart in charts:
        (own,) = labelled(chart, "this table at varus 0 deg: at most 0.05 mm off contact")
        assert isinstance(own, Curve)
        np.testing.assert_array_equal(own.x, np.arange(0.0, 121.0, 5.0))
        np.testing.assert_array_equal(own.y, [0.005, *12 * [-0.05, 0.005]])
    limits = [one.y.tolist() for one in labelled(charts[1], "limit 0.3 mm") if isinstance(one, Curve)]
    assert limits == [[0.3, 0.3], [-0.3, -0.3]]


def test_baselines_that_meet_nothing_are_missed() -> None:
    evidence = sample_evidence()
    nothing = replace(evidence.sweep, baselines=(BaselineCost("hinge", (), ()),))
    with pytest.raises(ValueError, match="no pose of a baseline meets the other body"):
        baselines_png(replace(evidence, sweep=nothing), Limits())


def test_contact_is_shown_with_both_limits(charts: list[Chart]) -> None:
    checks_png(sample_evidence(), Limits(max_contact_error_mm=0.03, max_midpoint_error_mm=0.2))
    assert len(charts) == 4
    for chart, limit in zip(charts[:2], (0.03, 0.2), strict=True):
        lines = [one.y[0] for one in labelled(chart, "limit") if isinstance(one, Curve)]
        assert lines == [limit, -limit]
    assert [chart.title for chart in charts[2:]] == ["Gap of the medial side", "Gap of the lateral side"]


def test_how_sure_a_pose_is_has_four_charts(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    lateral = evidence.raw.margin_lateral_mm.copy()
    lateral[4] = [np.nan, 4.0, 1.0]
    repeats_png(replace(evidence, raw=replace(evidence.raw, margin_lateral_mm=lateral)))
    passes, solvers, shifts, turns = charts
    assert [one.y[0] for one in passes.curves] == [0.2, 0.3, 2.0]
    assert list(labelled(passes, HYSTERESIS_SOURCE))
    assert [(one.x.tolist(), one.y.tolist()) for one in solvers.curves] == [
        ([20.0, 70.0], [0.3, 0.1]),
        ([20.0, 70.0], [0.2, 0.7]),
    ]
    here, worst = shifts.curves[:2]
    assert (here.y[4], worst.y[4], worst.y[5]) == (4.0, 1.0, 4.0)
    assert (shifts.y_label, turns.y_label) == ("mm (no more than 5 is tried)", "deg (no more than 10 is tried)")
    assert (shifts.y_ends, turns.y_ends) == ((0.0, 5.5), (0.0, 11.0))


def test_what_is_not_known_of_a_pose_is_left_out(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    unknown = np.full(evidence.raw.grid.shape, np.nan)
    names = ("margin_lateral_mm", "margin_anterior_mm", "margin_rotation_deg")
    raw = replace(evidence.raw, **dict.fromkeys(names, unknown))  # type: ignore[arg-type]
    check = replace(evidence.sweep.cross_check, attitudes=())
    some = replace(evidence, raw=raw, sweep=replace(evidence.sweep, cross_check=check))
    repeats_png(some)
    assert [chart.title for chart in charts] == ["Bending against straightening (hysteresis), varus -4 deg"]
    none = replace(some, raw=replace(raw, hysteresis_mm=unknown))
    assert "repeats" in [figure.name for figure in expected_figures(some)]
    assert "repeats" not in [figure.name for figure in expected_figures(none)]
    with pytest.raises(ValueError, match="neither the way back, nor the other solver, nor a margin is known"):
        repeats_png(none)


@pytest.fixture
def draw_paths(monkeypatch: pytest.MonkeyPatch) -> DrawPaths:
    """Draw these paths of contact in place of those that the evidence gives."""

    def draw(evidence: Evidence, *paths: ContactPath) -> None:
        monkeypatch.setattr(figure_paths, "contact_paths", lambda _: paths)
        paths_png(evidence)

    return draw


def path_of(gap_mm: list[float]) -> ContactPath:
    steps = np.arange(float(len(gap_mm)))
    return ContactPath("medial", 10.0 * steps, -20.0 - steps, 5.0 + 2.0 * steps, np.array(gap_mm))


@pytest.mark.parametrize("knee", ["right", "left"])
def test_paths_lie_on_the_surface_as_an_observer_in_front_sees_it(
    knee: Side, charts: list[Chart], draw_paths: DrawPaths
) -> None:
    draw_paths(sample_evidence(knee), path_of([0.0, 0.3, 0.1]))
    above, forwards = charts
    assert above.backdrop is not None
    left, right, bottom, top = above.backdrop.edges
    # the lateral side of a right knee is at the right of one who faces the reader's way, of a left knee at the left
    assert (left < right) == (knee == "right")
    assert above.x_label == ("medial  ←  mm  →  lateral" if knee == "right" else "lateral  ←  mm  →  medial")
    assert (top > bottom, above.y_label) == (True, "posterior  ←  mm  →  anterior")
    height, width = above.backdrop.pixels.shape[:2]
    assert abs(right - left) / (top - bottom) == pytest.approx(width / height)
    solid, hollow = (one for one in above.marks if isinstance(one, Points))
    assert (solid.x.tolist(), solid.y.tolist(), hollow.x.tolist()) == ([-20.0, -22.0], [5.0, 9.0], [-21.0])
    assert (solid.hollow, hollow.hollow) == (False, True)
    assert [one.words for one in above.marks if isinstance(one, Words)] == ["0°", "20°"]
    assert above.scale is not None
    assert above.scale.ends == (0.0, 20.0)
    assert list(labelled(forwards, "medial: 4.0 mm from back to front"))
    (rings,) = labelled(forwards, "medial side open > 0.2 mm")
    assert isinstance(rings, Curve)
    assert rings.y.tolist() == [7.0]


def test_a_side_that_never_touches_has_no_excursion(charts: list[Chart], draw_paths: DrawPaths) -> None:
    draw_paths(sample_evidence(), path_of([0.3, 0.4]))
    assert list(labelled(charts[1], "medial: touches nowhere"))


def test_the_backdrop_shows_the_body_where_it_is(charts: list[Chart]) -> None:
    evidence = sample_evidence()
    paths_png(evidence)
    backdrop = charts[0].backdrop
    assert backdrop is not None
    left, right, bottom, top = backdrop.edges
    height, width = backdrop.pixels.shape[:2]

    def drawn_at(x: float, y: float) -> bool:
        column, row = int((x - left) / (right - left) * width), int((top - y) / (top - bottom) * height)
        return bool((backdrop.pixels[row, column] < 250).any())

    # the plateau is a disc of 33 mm, and a meniscus of 8 mm about (-20, -24) stands out over its rim
    assert all(drawn_at(31.0 * np.cos(t), 31.0 * np.sin(t)) for t in np.linspace(0.0, 6.0, 25))
    assert drawn_at(-22.0, -29.0)
    assert not drawn_at(22.0, -29.0)


@pytest.mark.parametrize("paths", [(), (path_of([np.nan, np.nan]),)])
def test_paths_without_contact_are_missed(paths: tuple[ContactPath, ...], draw_paths: DrawPaths) -> None:
    with pytest.raises(ValueError, match="no attitude at neutral varus has a contact to show"):
        draw_paths(sample_evidence(), *paths)


def test_one_attitude_has_charts_too(charts: list[Chart]) -> None:
    evidence = only_one_attitude(sample_evidence())
    for draw in (curves_png, neutral_png, paths_png, repeats_png):
        draw(evidence)
    assert len(charts) == 4 + 5 + 2 + 4


def test_every_picture_of_charts_is_drawn() -> None:
    evidence = with_status(sample_evidence(), (6, 1), Status.SLID_OFF)
    for figure in expected_figures(evidence):
        if figure.name in ("paths", "curves", "neutral", "baselines", "checks", "repeats"):
            assert figure.draw(evidence, PictureSettings(), Limits()).startswith(b"\x89PNG")
