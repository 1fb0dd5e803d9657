"""Stage 60: a stable pose for every attitude of the grid, certified and proven, as found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from pipeline.adapters.joint_work import Joint, SolverName, SolverSettings, claims
from pipeline.artifacts import (
    ANATOMY,
    LIGAMENTS,
    MOVING_BODY,
    NEUTRAL_CURVE,
    RAW_TABLE,
    REFERENCE_BODY,
    SCAN_RETURNS,
    SWEEP_FACTS,
)
from pipeline.contact_params import ContactParams, fibres_of
from pipeline.engine.stage import Finding, Findings, Inputs, Outputs, Severity, Stage
from pipeline.errors import CaseRejected
from pipeline.kinematics.baselines import Baseline, hinge, probes, walker
from pipeline.kinematics.body_frames import scan_pose
from pipeline.kinematics.contact import Pose
from pipeline.kinematics.cross_check import Recheck, agreeing, differences, rechecks, shallower
from pipeline.kinematics.direct.settings import DirectSettings, MapSettings
from pipeline.kinematics.incremental import IncrementalSettings, StablePose
from pipeline.kinematics.jumps import JumpLimits, Jumps, jumps, mended, to_solve_again
from pipeline.kinematics.sweep import (
    Evidence,
    Found,
    Place,
    Release,
    Walk,
    assemble,
    hysteresis,
    kept,
    walk_grid,
)
from pipeline.kinematics.table import Grid, RawTable, Status
from pipeline.records import (
    Anatomy,
    BaselineCost,
    BaselineName,
    CheckedAttitude,
    CrossCheck,
    JumpCount,
    LigamentFibre,
    ScanReturn,
    SweepFacts,
)

MAX_CELLS = 100_000


class Params(ContactParams):
    """The grid, the solver and its bounds, and what is checked beside."""

    flexion_min_deg: float = Field(0.0, ge=-30, le=170, description="first flexion of the table")
    flexion_max_deg: float = Field(120.0, ge=-30, le=170, description="last flexion of the table")
    flexion_step_deg: float = Field(1.0, gt=0, le=90, description="spacing in flexion; divides the range")
    varus_min_deg: float = Field(-5.0, ge=-30, le=30, description="first varus angle (valgus is negative)")
    varus_max_deg: float = Field(5.0, ge=-30, le=30, description="last varus angle")
    varus_step_deg: float = Field(1.0, gt=0, le=30, description="spacing in varus; divides the range")
    solver: SolverName = Field("direct", description="direct, or incremental: the paper's, a hundred times slower")
    map_spacing_mm: float = Field(0.6, ge=0.05, le=5, description="nodes of the direct solver's height map")
    translation_step_mm: float = Field(1.0, gt=0, le=100, description="incremental: step of translations")
    translation_resolution_mm: float = Field(0.1, gt=0, le=5, description="step at which a translation is spent")
    rotation_step_deg: float = Field(1.0, gt=0, le=45, description="incremental: step of rotations about delta")
    rotation_resolution_deg: float = Field(0.1, gt=0, le=5, description="step at which a rotation is spent")
    slide_bound_mm: float = Field(30.0, gt=0, le=200, description="farther than this from the scan pose: slid off")
    rotation_bound_deg: float = Field(30.0, gt=0, le=179, description="farther than this from the scan pose: bound")
    rest_rotation_deg: float = Field(
        180.0, ge=0, le=180, description="a scan turned farther counts as turned by this much: begin and bounds"
    )
    max_motions: int = Field(400, ge=10, le=100_000, description="incremental: motions after which a cell is given up")
    classic: bool = Field(default=False, description="incremental: the paper's plain rules, not only deeper")
    ligaments: bool = Field(default=False, description="let the fibres of ligaments.csv pull")
    push_n: float = Field(10.0, gt=0, le=5000, description="push along delta that the fibres pull against, newtons")
    reference_strain_fraction: float = Field(
        0.0, gt=-0.5, le=0.5, description="stretch at the scan pose of fibres without a slack length of their own"
    )
    jump_mm: float = Field(
        0.75, gt=0, le=20, description="neighbours that differ by more, beyond what is usual: a jump"
    )
    jump_deg: float = Field(3.0, gt=0, le=45, description="the same for the rotation")
    jump_rounds: int = Field(1, ge=0, le=20, description="how often jumps are solved again from all sides")
    cross_check_fraction: float = Field(0.05, ge=0, le=1, description="share of cells that the other solver solves too")
    baselines: bool = Field(
        default=False, description="say how a plain hinge and a published average motion would fit these bones"
    )
    scan_shift_mm: float = Field(
        2.0, ge=0, le=20, description="how far from the scan pose the body is let go, as a test"
    )
    scan_turn_deg: float = Field(3.0, ge=0, le=30, description="the same for the rotation")

    @model_validator(mode="after")
    def _grid_is_whole(self) -> Self:
        cells = 1
        for name in ("flexion", "varus"):
            low, high, step = (getattr(self, f"{name}_{part}_deg") for part in ("min", "max", "step"))
            if high < low:
                raise ValueError(f"{name}_max_deg {high} is below {name}_min_deg {low}")
            if abs((high - low) / step - round((high - low) / step)) > 1e-9:
                raise ValueError(f"{name}_step_deg {step} does not divide the range {low} to {high}")
            cells *= round((high - low) / step) + 1
        if cells > MAX_CELLS:
            raise ValueError(f"the grid has {cells} cells, at most {MAX_CELLS}")
        return self

    @property
    def ligament_push_n(self) -> float:
        """The push that ligaments pull against; 0 where they take no part."""
        return self.push_n if self.ligaments else 0.0

    def grid(self) -> Grid:
        """The attitudes of the table."""
        return Grid(
            _values(self.flexion_min_deg, self.flexion_max_deg, self.flexion_step_deg),
            _values(self.varus_min_deg, self.varus_max_deg, self.varus_step_deg),
        )


def _values(low: float, high: float, step: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.linspace(low, high, round((high - low) / step) + 1)


def run(reads: Inputs, params: Params, out: Outputs) -> Findings:
    """Sweep the grid."""
    anatomy, grid = reads[ANATOMY], params.grid()
    rest = _at_rest(scan_pose(anatomy.scan_attitude), params.rest_rotation_deg)
    pair = params.pair(reads[REFERENCE_BODY], reads[MOVING_BODY], anatomy)
    fibres = fibres_of(_wanted(reads, params), anatomy, pair, params.ligament_push_n, params.reference_strain_fraction)
    joint = Joint(pair, replace(_settings(params), fibres=fibres), out.jobs)
    progress = _Progress(out, int(np.prod(grid.shape)) + grid.shape[0])
    ways = walk_grid(grid, anatomy.scan_attitude[:2], rest, lambda walks: joint.walk(walks, progress.of(walks)))
    found, limits = kept(ways), JumpLimits(params.jump_mm, params.jump_deg)
    before = jumps(grid, found, limits)
    found = mended(found, lambda now: to_solve_again(grid, now, limits, rest), joint.solve_again, params.jump_rounds)
    if not any(one.stable.status.usable for one in found.values()):
        raise _nothing_stable(found)
    asked = rechecks(grid, found, params.cross_check_fraction, rest)
    known = joint.certify(grid, found)
    claimed = claims(grid, found, known)
    proven, answers = joint.prove(tuple(claimed.values()), asked)
    proofs = dict(zip(claimed, proven, strict=True))
    table = assemble(grid, found, Evidence(known, proofs), hysteresis(grid, ways))
    out[RAW_TABLE] = table
    out[SCAN_RETURNS] = _scan_returns(anatomy, params, joint)
    out[NEUTRAL_CURVE] = joint.neutral(table, anatomy.scan_attitude[1], rest)

    baselines = _baselines(joint, anatomy, grid) if params.baselines else ()
    check = _cross_check(params, found, asked, answers)
    out[SWEEP_FACTS] = facts = _facts(params, (before, jumps(grid, found, limits)), check, baselines)
    return _findings(table, facts)


def _wanted(reads: Inputs, params: Params) -> tuple[LigamentFibre, ...]:
    fibres = reads[LIGAMENTS]
    if params.ligaments and not fibres:
        raise CaseRejected(
            "E-LIG-04",
            "The settings ask for ligaments, and the case has none.",
            "Add a ligaments.csv to the case folder, or set sweep.ligaments to false.",
        )
    return fibres


def _nothing_stable(found: Mapping[Place, Found]) -> CaseRejected:
    """The spine found nothing, so no rib was begun."""
    ends = [one.stable.status for one in found.values()]
    return CaseRejected(
        "E-SWP-01",
        f"No stable pose at any of {len(ends)} flexions at the varus of the scan ({_counts(ends)}).",
        "Check that cartilage and menisci are labelled, and that the bones are those of one joint.",
    )


def _at_rest(scan: Pose, most_deg: float) -> Pose:
    """The scan pose, its rotation taken to that of a joint at rest: a twisted scan is no middle of its bounds."""
    most = float(np.radians(most_deg))
    return scan._replace(theta=min(max(scan.theta, -most), most))


def _scan_returns(anatomy: Anatomy, params: Params, joint: Joint) -> tuple[ScanReturn, ...]:
    """The body let go at the scan's own attitude, at the scan pose, to every side of it, and aslant both ways."""
    scan = scan_pose(anatomy.scan_attitude)
    flexion, varus = anatomy.scan_attitude[:2]
    shift, turn = params.scan_shift_mm, float(np.radians(params.scan_turn_deg))
    aways = [(0.0, 0.0, 0.0)]
    aways += [way for s in (1.0, -1.0) for way in ((s * shift, 0.0, 0.0), (0.0, s * shift, 0.0), (0.0, 0.0, s * turn))]
    aways += [(s * 0.75 * shift, 0.75 * shift, s * turn) for s in (1.0, -1.0)]
    releases = [Release(flexion, varus, scan, away) for away in aways]
    found = joint.release(releases)
    return tuple(_scan_return(release, stable) for release, stable in zip(releases, found, strict=True))


def _scan_return(release: Release, stable: StablePose) -> ScanReturn:
    settled = stable.status is Status.OK
    dx, dy, dz, turn = np.subtract(stable.pose, release.scan) if settled else np.zeros(4)
    return ScanReturn(
        start_lateral_mm=release.away[0],
        start_anterior_mm=release.away[1],
        start_rotation_deg=float(np.degrees(release.away[2])),
        settled=settled,
        shift_mm=float(np.hypot(dx, dy)),
        rotation_deg=float(np.degrees(abs(turn))),
        sinking_mm=float(dz),
    )


class _Progress:
    """Cells done out of all, those of the way back as well, told as walks finish."""

    def __init__(self, out: Outputs, total: int) -> None:
        self.out, self.total, self.finished = out, total, 0

    def of(self, walks: Sequence[Walk]) -> Callable[[int], None]:
        """What to call with the index of each finished walk."""

        def done(index: int) -> None:
            self.finished += len(walks[index].cells)
            self.out.progress(self.finished, self.total)

        return done


def _settings(params: Params) -> SolverSettings:
    rotation_bound = float(np.radians(params.rotation_bound_deg))
    incremental = IncrementalSettings(
        translation_step_mm=params.translation_step_mm,
        translation_resolution_mm=params.translation_resolution_mm,
        rotation_step_rad=float(np.radians(params.rotation_step_deg)),
        rotation_resolution_rad=float(np.radians(params.rotation_resolution_deg)),
        contact_band_mm=params.contact_band_mm,
        slide_bound_mm=params.slide_bound_mm,
        rotation_bound_rad=rotation_bound,
        max_motions=params.max_motions,
        gain_mm=max(5e-4, 2.5 * params.contact_tolerance_mm),
        classic=params.classic,
        motion=params.motion(),
    )
    return SolverSettings(
        name=params.solver,
        incremental=incremental,
        direct=DirectSettings(slide_bound_mm=params.slide_bound_mm, rotation_bound_rad=rotation_bound),
        map=MapSettings(spacing_mm=params.map_spacing_mm),
        proof=params.proof(),
    )


def _facts(
    params: Params, jumped: tuple[Jumps, Jumps], cross_check: CrossCheck, baselines: tuple[BaselineCost, ...]
) -> SweepFacts:
    before, after = (JumpCount(len(one.places), round(one.largest_mm, 6), round(one.largest_deg, 6)) for one in jumped)
    return SweepFacts(
        solver=params.solver,
        push_n=params.ligament_push_n,
        reference_strain=params.reference_strain_fraction,
        jumps_before=before,
        jumps_after=after,
        cross_check=cross_check,
        baselines=baselines,
    )


def _cross_check(
    params: Params, found: Mapping[Place, Found], asked: Sequence[Recheck], answers: Sequence[StablePose]
) -> CrossCheck:
    different = differences(found, asked, answers)
    compared = [one.attitude_deg for one, other in zip(asked, answers, strict=True) if other.status.usable]
    return CrossCheck(
        cells=len(different.shift_mm),
        unsolved=different.unsolved,
        agreeing=agreeing(different, params.translation_resolution_mm, params.rotation_resolution_deg),
        shallower=shallower(different),
        shift_mm=float(different.shift_mm.max(initial=0.0)),
        rotation_deg=float(different.rotation_deg.max(initial=0.0)),
        deeper_mm=float(different.deeper_mm.max(initial=0.0)),
        shallower_mm=float((-different.deeper_mm).max(initial=0.0)),
        attitudes=tuple(
            CheckedAttitude(*attitude, round(float(shift), 6), round(float(turn), 6))
            for attitude, shift, turn in zip(compared, different.shift_mm, different.rotation_deg, strict=True)
        ),
    )


def _baselines(joint: Joint, anatomy: Anatomy, grid: Grid) -> tuple[BaselineCost, ...]:
    """What motions that ignore the shape of the joint would cost on these bones."""
    curves = [curve(grid.flexion_deg, anatomy.scan_attitude) for curve in (hinge, walker)]
    return (_cost(joint, "hinge", curves[0]), _cost(joint, "walker", curves[1]))


def _cost(joint: Joint, name: BaselineName, baseline: Baseline) -> BaselineCost:
    asked = probes(baseline)
    ways = zip(asked, joint.ways_to_contact(asked), strict=True)
    met = [(one.flexion_deg, round(way, 6)) for one, way in ways if np.isfinite(way)]
    return BaselineCost(name, tuple(flexion for flexion, _ in met), tuple(way for _, way in met))


def _counts(ends: Sequence[int]) -> str:
    values, counts = np.unique(np.asarray(ends, dtype=np.uint8), return_counts=True)
    return ", ".join(f"{Status(int(value)).words}: {count}" for value, count in zip(values, counts, strict=True))


def _findings(table: RawTable, facts: SweepFacts) -> Findings:
    status = table.poses.status.ravel()
    counts = _counts(status.tolist())
    found = [Finding("N-SWP-01", Severity.NOTE, f"{len(status)} attitudes ({counts}).")]
    failed = int((status != Status.OK).sum())
    if failed:
        why = _counts([end for end in status.tolist() if end != Status.OK])
        message = f"{failed} of {len(status)} attitudes have no stable pose ({why})."
        found.append(Finding("W-SWP-01", Severity.REVIEW, message))
    if facts.jumps_before.count:
        message = (
            f"{facts.jumps_before.count} jumps between neighbouring attitudes, {facts.jumps_after.count} after solving "
            f"them again from all sides; the largest left is {facts.jumps_after.largest_mm:.1f} mm, "
            f"{facts.jumps_after.largest_deg:.1f} deg."
        )
        found.append(Finding("N-SWP-02", Severity.NOTE, message))
    check = facts.cross_check
    if check.cells:
        message = (
            f"{check.cells} attitudes solved by the other solver too: {check.agreeing} agree within its resolutions; "
            f"largest difference {check.shift_mm:.2f} mm, {check.rotation_deg:.2f} deg. "
            f"The table's pose is shallower in {check.shallower} (at most {check.shallower_mm:.3f} mm)."
        )
        if check.unsolved:
            message += f" In {check.unsolved} more the other solver found no pose."
        found.append(Finding("N-SWP-03", Severity.NOTE, message))
    if facts.baselines:
        costs = "; ".join(_in_words(cost) for cost in facts.baselines)
        message = f"For comparison, on these bones and from the pose of the scan: {costs}."
        found.append(Finding("N-SWP-04", Severity.NOTE, message))
    return tuple(found)


def _in_words(cost: BaselineCost) -> str:
    titles = {"hinge": "a plain hinge about the flexion axis", "walker": "Walker's published average motion"}
    gap = max((0.0, *cost.way_mm))
    overlap = max((0.0, *(-way for way in cost.way_mm)))
    return f"{titles[cost.name]} would overlap by up to {overlap:.1f} mm and gape by up to {gap:.1f} mm"


STAGE = Stage(
    60,
    "sweep",
    (ANATOMY, REFERENCE_BODY, MOVING_BODY, LIGAMENTS),
    (RAW_TABLE, SCAN_RETURNS, NEUTRAL_CURVE, SWEEP_FACTS),
    Params,
    run,
)
