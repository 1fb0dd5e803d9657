"""The numbers of the verdict: pure functions from evidence to metrics.

A number has a limit only where the program guarantees something: closed meshes that stand for their labels, a pose for
every entry, contact without gap or overlap. Everything else informs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.mesh import TriangleMesh, edge_defects
from pipeline.kinematics.interpolation import usable_entries
from pipeline.kinematics.table import RawTable, SmoothTable, Status
from pipeline.records import CrossCheck, Metric, SweepFacts
from pipeline.report.contact_paths import contact_paths, excursion_mm
from pipeline.report.evidence import Evidence
from pipeline.report.settings import Limits
from pipeline.suggestions import plain

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """A number before it is judged; the fields are those of :class:`pipeline.records.Metric`."""

    name: str
    title: str
    value: float
    unit: str
    meaning: str


def info(measured: Measured) -> Metric:
    """A number without a limit."""
    return Metric(**vars(measured), limit="none", state="info")


def at_most(measured: Measured, limit: float) -> Metric:
    """A number that must not exceed a limit."""
    return _judged(measured, f"at most {limit:g}", ok=measured.value <= limit)


def at_least(measured: Measured, limit: float) -> Metric:
    """A number that must reach a limit."""
    return _judged(measured, f"at least {limit:g}", ok=measured.value >= limit)


def _judged(measured: Measured, limit: str, *, ok: bool) -> Metric:
    return Metric(**vars(measured), limit=limit, state="ok" if ok else "review")


def all_metrics(evidence: Evidence, limits: Limits) -> tuple[Metric, ...]:
    """Every number of the verdict, in the order of the flow; one that cannot be measured is left out."""
    return (
        *_mesh_metrics(evidence, limits),
        *_anatomy_metrics(evidence),
        *_sweep_metrics(evidence, limits),
        *_scan_pose_metrics(evidence),
        *_smooth_metrics(evidence, limits),
        *_path_metrics(evidence),
    )


def open_edges(mesh: TriangleMesh) -> int:
    """Number of edges that keep a mesh from being a closed, oriented surface."""
    return sum(vars(edge_defects(mesh.triangles)).values())


def _mesh_metrics(evidence: Evidence, limits: Limits) -> Iterator[Metric]:
    meshes = [*evidence.meshes.values(), evidence.reference, evidence.moving]
    defects = sum(open_edges(mesh) for mesh in meshes)
    meaning = "Edges of surfaces that do not close; a surface with a hole has no inside, and contact means nothing."
    yield at_most(Measured("open_edges", "Open edges of all surfaces", float(defects), "edges", meaning), 0)
    if evidence.mesh_quality:
        errors = {q.name: 100.0 * abs(q.volume_mm3 / q.label_volume_mm3 - 1.0) for q in evidence.mesh_quality}
        worst = max(errors, key=lambda name: errors[name])
        meaning = f"How much a surface is larger or smaller than its label; worst in {plain(worst)}."
        volume = Measured("mesh_volume_error", "Volume of surface against label", errors[worst], "%", meaning)
        yield at_most(volume, limits.max_volume_error_percent)
        far = max(evidence.mesh_quality, key=lambda q: q.deviation_max_mm)
        meaning = f"Largest distance of a surface from the border of its label; in {plain(far.name)}."
        yield info(Measured("mesh_deviation_max", "Surface off its label", far.deviation_max_mm, "mm", meaning))


def _anatomy_metrics(evidence: Evidence) -> Iterator[Metric]:
    anatomy = evidence.anatomy
    if anatomy.landmarks:
        worst = max(anatomy.landmarks, key=lambda landmark: landmark.uncertainty_mm)
        meaning = f"One standard deviation of the least certain landmark, {plain(worst.name)}."
        yield info(Measured("landmark_uncertainty", "Landmark uncertainty", worst.uncertainty_mm, "mm", meaning))
    for axis in anatomy.axes:
        title = f"Uncertainty of {plain(axis.name)}"
        meaning = f"One standard deviation of its direction ({axis.method}); it leaks into rotation and varus."
        yield info(Measured(f"axis_uncertainty.{axis.name}", title, axis.uncertainty_deg, "deg", meaning))
    meaning = "Anatomical signs that told medial from lateral and agree with the declared side."
    yield info(
        Measured("side_signs", "Signs that confirm the side", float(len(anatomy.side_evidence)), "signs", meaning)
    )


def _sweep_metrics(evidence: Evidence, limits: Limits) -> Iterator[Metric]:
    raw = evidence.raw
    found = usable_entries(raw.poses)
    shown = usable_entries(evidence.smooth.poses)
    meaning = "Attitudes that may be shown: stable, or marked as smoothed over between stable ones."
    cells = Measured("usable_cells", "Usable entries of the table", float(shown.sum()), "entries", meaning)
    yield at_least(cells, shown.size)
    for status in Status:
        count = int((raw.poses.status == status).sum())
        if count and not status.usable:
            meaning = f"Attitudes where the search ended so: {status.words}."
            title = f"Raw entries: {status.words}"
            yield info(Measured(f"raw_status.{status.name.lower()}", title, float(count), "entries", meaning))
    if found.any():
        meaning = "Pulled back by so much the bones are clear, pushed on by so much they meet: exact test, worst entry."
        gaps = np.stack([raw.gap_before_mm[found], raw.gap_after_mm[found]])
        limit = limits.max_raw_contact_error_mm
        yield from _worst(
            Measured("raw_contact_gap", "Contact of raw poses proven within", 0.0, "mm", meaning), gaps, limit
        )
        yield from _repeatability_metrics(evidence)


def _repeatability_metrics(evidence: Evidence) -> Iterator[Metric]:
    raw = evidence.raw
    meaning = (
        "Largest difference of bending and straightening at the scan's varus; below 1 mm and 2 deg in the literature."
    )
    for values, unit in ((raw.hysteresis_mm, "mm"), (raw.hysteresis_deg, "deg")):
        if np.isfinite(values).any():
            title = f"Hysteresis ({'shift' if unit == 'mm' else 'rotation'})"
            yield info(Measured(f"hysteresis_{unit}", title, float(np.nanmax(values)), unit, meaning))
    yield from _margin_metrics(raw)
    yield from _jump_metrics(evidence.sweep)
    yield from _cross_check_metrics(evidence.sweep.cross_check)


def _margin_metrics(raw: RawTable) -> Iterator[Metric]:
    meaning = (
        "How far a pose may be pushed straight, the rest held, before its depth stops falling; median, coarse "
        "(steps of 1 mm and 2 deg up to 5 mm and 10 deg)."
    )
    for name, title, values, unit in (
        ("lateral", "sideways", raw.margin_lateral_mm, "mm"),
        ("anterior", "forwards or backwards", raw.margin_anterior_mm, "mm"),
        ("rotation", "rotation", raw.margin_rotation_deg, "deg"),
    ):
        if np.isfinite(values).any():
            measured = Measured(
                f"margin_{name}", f"Stability margin ({title})", float(np.nanmedian(values)), unit, meaning
            )
            yield info(measured)


def _jump_metrics(facts: SweepFacts) -> Iterator[Metric]:
    meaning = "Neighbouring raw poses that differ far more than is usual along their line; rough surfaces make jumps."
    for name, title, jumped in (
        ("before", "as first found", facts.jumps_before),
        ("after", "solved again from both sides", facts.jumps_after),
    ):
        yield info(Measured(f"jumps_{name}", f"Jumps, {title}", float(jumped.count), "jumps", meaning))
    meaning = "Largest difference between two neighbouring raw poses."
    yield info(Measured("jump_mm", "Largest step (shift)", facts.jumps_after.largest_mm, "mm", meaning))
    yield info(Measured("jump_deg", "Largest step (rotation)", facts.jumps_after.largest_deg, "deg", meaning))


def _cross_check_metrics(check: CrossCheck) -> Iterator[Metric]:
    if not check.cells:
        return
    meaning = (
        f"Share of {check.cells} attitudes where the other solver, from the same start, finds the same pose; "
        f"in {check.unsolved} more it finds none."
    )
    share = 100.0 * check.agreeing / check.cells
    yield info(Measured("cross_check_agreeing", "Solvers agree", share, "%", meaning))
    meaning = "Largest difference of the two solvers; where a maximum is not unique they may choose differently."
    yield info(Measured("cross_check_mm", "Solvers differ (shift)", check.shift_mm, "mm", meaning))
    yield info(Measured("cross_check_deg", "Solvers differ (rotation)", check.rotation_deg, "deg", meaning))
    meaning = f"How much less deep the table's pose is than the other solver's, in {check.shallower} attitudes."
    yield info(Measured("cross_check_shallower", "Table shallower by", check.shallower_mm, "mm", meaning))


def _scan_pose_metrics(evidence: Evidence) -> Iterator[Metric]:
    returns = evidence.scan_returns
    labelled = all(origin.origin == "labelled" for origin in evidence.origins)
    hint = "small where cartilage and menisci were labelled" if labelled else "surfaces are missing: expect millimetres"
    settled = [one for one in returns if one.settled]
    if settled:
        starts = f"let go {len(returns)} times at and around the scan pose, at the attitude of the scan"
        worst = max(one.shift_mm for one in settled)
        meaning = f"Largest distance from the scan at rest, {starts}; {hint}."
        yield info(Measured("scan_pose_mm", "Scan pose found again (shift)", worst, "mm", meaning))
        worst = max(one.rotation_deg for one in settled)
        meaning = f"Largest rotation from the scan at rest, {starts}; {hint}."
        yield info(Measured("scan_pose_deg", "Scan pose found again (rotation)", worst, "deg", meaning))
    lost = float(len(returns) - len(settled))
    meaning = "Releases near the scan pose that came to no rest; the seat of the scan is not stable if there are any."
    yield info(Measured("scan_pose_lost", "Scan pose lost", lost, "releases", meaning))


def _smooth_metrics(evidence: Evidence, limits: Limits) -> Iterator[Metric]:
    smooth = evidence.smooth
    for fit in smooth.fits:
        title = f"Smoothing residual of {plain(fit.name.removesuffix('_' + fit.unit))}"
        meaning = f"Root mean square of raw minus fitted; largest {fit.residual_max:.3g} {fit.unit}."
        yield info(Measured(f"residual_rms.{fit.name}", title, fit.residual_rms, fit.unit, meaning))
    meaning = "Largest gap or overlap that is left at an entry after smoothing: exact test on the triangles."
    entry = Measured("contact_error", "Contact at the entries", 0.0, "mm", meaning)
    yield from _worst(entry, smooth.contact_error_mm, limits.max_contact_error_mm)
    meaning = "The same half-way between entries, as a viewer interpolates; 0.145 mm is the limit of perception."
    midpoint = Measured("midpoint_error", "Contact between entries", 0.0, "mm", meaning)
    yield from _worst(midpoint, smooth.midpoint_error_mm, limits.max_midpoint_error_mm)
    meaning = "Usable entries, and middles between two of them, whose contact was not tested."
    yield at_most(Measured("untested", "Untested entries", float(untested(smooth)), "entries", meaning), 0)
    yield from _balance_metrics(evidence)


def _path_metrics(evidence: Evidence) -> Iterator[Metric]:
    for path in contact_paths(evidence):
        if path.touching.any():
            meaning = (
                f"How far the middle of contact wanders forwards and backwards at neutral varus, {path.side} side."
            )
            title = f"Path of contact, {path.side} side"
            yield info(Measured(f"contact_path_{path.side}", title, excursion_mm(path), "mm", meaning))


def untested(smooth: SmoothTable) -> int:
    """Number of usable entries, and of middles between usable entries along flexion, without a contact error."""
    shown = usable_entries(smooth.poses)
    entries = shown & ~np.isfinite(smooth.contact_error_mm)
    middles = shown[1:] & shown[:-1] & ~np.isfinite(smooth.midpoint_error_mm)
    return int(entries.sum() + middles.sum())


def _worst(measured: Measured, values: Float, limit: float) -> Iterator[Metric]:
    known = np.abs(values[np.isfinite(values)])
    if known.size:
        yield at_most(replace(measured, value=float(known.max())), limit)


def _balance_metrics(evidence: Evidence) -> Iterator[Metric]:
    for kind, poses in (("raw", evidence.raw.poses), ("smoothed", evidence.smooth.poses)):
        values = poses.equilibrium_residual[usable_entries(poses)]
        if np.isfinite(values).any():
            meaning = "How far the contact forces are from balance, median; 0 is perfect rest, 1 is none."
            title = f"Equilibrium of {kind} poses"
            yield info(Measured(f"equilibrium_{kind}", title, float(np.nanmedian(values)), "", meaning))
    poses = evidence.smooth.poses
    for side, gap in (("medial", poses.medial_gap_mm), ("lateral", poses.lateral_gap_mm)):
        values = gap[usable_entries(poses)]
        if np.isfinite(values).any():
            meaning = f"Largest distance left on the {side} side; both sides touch only where the varus fits."
            yield info(Measured(f"{side}_gap", f"Largest {side} gap", float(np.nanmax(values)), "mm", meaning))
