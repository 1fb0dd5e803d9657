"""The small facts that stages leave for one another, as frozen dataclasses; on disk they are JSON.

Arrays (volumes, meshes, tables) have types of their own in ``geometry`` and ``kinematics``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Side = Literal["right", "left"]
Vector = tuple[float, float, float]
Matrix = tuple[tuple[float, float, float, float], ...]
Word = Literal["PASS", "REVIEW"]
BaselineName = Literal["hinge", "walker"]


@dataclass(frozen=True)
class CaseFacts:
    """What intake established about a case.

    Attributes
    ----------
    case_id : str
    joint : str
        Name of the joint file, such as ``knee``.
    side : "right" or "left"
        As declared; confirmed by anatomy later.
    source : "ct", "labels" or "meshes"
        Where the bones come from: found in a CT, or as the case brought them.
    source_files : dict of str to str
        Input file name (relative to the case folder) -> SHA-256.
    structures : dict of str to int
        Structure name -> label value in the canonical label volume (0 where the case brought meshes).
    voxels : dict of str to int
        Structure name -> number of voxels (0 where the case brought meshes).
    spacing_mm : (i, j, k)
        Voxel size; zeros where the case brought meshes.
    shape : (i, j, k)
        Voxel counts; zeros where the case brought meshes.
    clipped_mm2 : dict of str to float
        Structure name -> area of it that lies on the border of the volume (a shaft always does).
    landmarks : dict of str to Vector
        Landmarks that the user gave, LPS mm.
    found_by : tuple of str
        Programs of the site that found the bones in the CT, with their versions; empty where this program did.
    """

    case_id: str
    joint: str
    side: Side
    source: Literal["ct", "labels", "meshes"]
    source_files: dict[str, str]
    structures: dict[str, int]
    voxels: dict[str, int]
    spacing_mm: Vector
    shape: tuple[int, int, int]
    clipped_mm2: dict[str, float]
    landmarks: dict[str, Vector]
    found_by: tuple[str, ...] = ()


@dataclass(frozen=True)
class LigamentFibre:
    """One fibre of a ligament, as the case gives it.

    Attributes
    ----------
    name : str
    reference, moving : Vector
        Attachments on the two bodies at the pose of the scan, LPS mm.
    slack_mm : float or None
        Length at which it begins to pull; None where only the scan is known.
    stiffness_n : float or None
        Pull (N) per unit of strain; None for a cord, which does not stretch.
    """

    name: str
    reference: Vector
    moving: Vector
    slack_mm: float | None
    stiffness_n: float | None


@dataclass(frozen=True)
class MeshQuality:
    """How well one mesh stands for its label.

    ``deviation_*`` is the distance of the mesh from the unsmoothed label surface, mm.
    """

    name: str
    triangles: int
    volume_mm3: float
    label_volume_mm3: float
    deviation_rms_mm: float
    deviation_max_mm: float
    removed_voxels: int
    filled_voxels: int


@dataclass(frozen=True)
class Landmark:
    """A point of the anatomy, LPS mm, with how sure we are of it.

    ``uncertainty_mm`` is one standard deviation; ``source`` is ``found`` or ``given``.
    """

    name: str
    position: Vector
    uncertainty_mm: float
    source: Literal["found", "given"]


@dataclass(frozen=True)
class AxisEstimate:
    """A direction of the anatomy in LPS with one standard deviation of its angle and how it was got."""

    name: str
    direction: Vector
    uncertainty_deg: float
    method: str


@dataclass(frozen=True)
class Anatomy:
    """Landmarks, joint frames and delta of one joint, in scan space (LPS mm).

    Attributes
    ----------
    scan_from_reference, scan_from_moving : 4x4
        Kinematic frames, x lateral, y anterior, z proximal; the moving frame's z is delta. Left-handed (det -1)
        for a left joint, so that one formula serves both sides.
    delta : Vector
        Direction in which the moving body is pushed, unit vector in scan space at the scan pose.
    scan_attitude : 6 floats
        Flexion, varus, internal rotation (deg), lateral, anterior, proximal (mm) of the scan itself.
    axes : tuple of AxisEstimate
    landmarks : tuple of Landmark
    side_evidence : tuple of str
        One sentence for each anatomical sign that told medial from lateral.
    """

    side: Side
    landmarks: tuple[Landmark, ...]
    axes: tuple[AxisEstimate, ...]
    scan_from_reference: Matrix
    scan_from_moving: Matrix
    delta: Vector
    scan_attitude: tuple[float, float, float, float, float, float]
    side_evidence: tuple[str, ...]


@dataclass(frozen=True)
class SurfaceOrigin:
    """Which structures make one contact body, and whether they were labelled or made by us."""

    body: Literal["reference", "moving"]
    structure: str
    origin: Literal["labelled", "synthesised", "absent"]


@dataclass(frozen=True)
class ScanReturn:
    """Let go near the scan's own pose, at the scan's attitude: how far from it the body came to rest.

    Attributes
    ----------
    start_lateral_mm, start_anterior_mm, start_rotation_deg : float
        Where it was let go, relative to the scan pose.
    settled : bool
        Whether a stable pose was found; the differences are 0 where not.
    shift_mm, rotation_deg : float
        Length of the difference of (x, y), and of the rotation.
    sinking_mm : float
        How far along delta it came to rest beyond the scan pose: the play that the scan left (negative: overlap).
    """

    start_lateral_mm: float
    start_anterior_mm: float
    start_rotation_deg: float
    settled: bool
    shift_mm: float
    rotation_deg: float
    sinking_mm: float


@dataclass(frozen=True)
class JumpCount:
    """Neighbouring attitudes whose poses jump, and the largest difference between any two neighbours.

    Attributes
    ----------
    count : int
    largest_mm, largest_deg : float
        Of (x, y), and of the rotation.
    """

    count: int
    largest_mm: float
    largest_deg: float


@dataclass(frozen=True)
class CheckedAttitude:
    """One attitude that both solvers solved: how far apart their poses are, (x, y) and rotation."""

    flexion_deg: float
    varus_deg: float
    shift_mm: float
    rotation_deg: float


@dataclass(frozen=True)
class CrossCheck:
    """A sample of the cells solved by the other solver from the same start.

    Attributes
    ----------
    cells, unsolved, agreeing, shallower : int
        Compared; asked for in vain, since the other solver found no pose; equal within the other's resolutions; where
        the table's pose is less deep.
    shift_mm, rotation_deg : float
        Largest differences.
    deeper_mm, shallower_mm : float
        How much deeper, and shallower, the table's pose is at most.
    attitudes : tuple of CheckedAttitude
        Those compared, one by one.
    """

    cells: int
    unsolved: int
    agreeing: int
    shallower: int
    shift_mm: float
    rotation_deg: float
    deeper_mm: float
    shallower_mm: float
    attitudes: tuple[CheckedAttitude, ...] = ()


@dataclass(frozen=True)
class BaselineCost:
    """What a motion that ignores the surfaces costs on these bones, at the flexions where it is known.

    Attributes
    ----------
    name : str
        A plain hinge about the flexion axis, or the published average motion of Walker et al. (1988).
    flexion_deg : tuple of float
    way_mm : tuple of float
        Signed way along delta to first contact: + a gap, - an overlap.
    """

    name: BaselineName
    flexion_deg: tuple[float, ...]
    way_mm: tuple[float, ...]


@dataclass(frozen=True)
class SweepFacts:
    """What is known of a sweep as a whole.

    Attributes
    ----------
    solver : str
    push_n : float
        Push along delta against which ligament fibres pulled; 0 where they took no part.
    reference_strain : float
        How far fibres without a slack length of their own were stretched at the scan pose.
    jumps_before, jumps_after : JumpCount
        As first found, and after jumps were solved again from both sides.
    cross_check : CrossCheck
    baselines : tuple of BaselineCost
        Empty where they were not asked for.
    """

    solver: Literal["direct", "incremental"]
    push_n: float
    reference_strain: float
    jumps_before: JumpCount
    jumps_after: JumpCount
    cross_check: CrossCheck
    baselines: tuple[BaselineCost, ...] = ()


@dataclass(frozen=True)
class Metric:
    """One number of the verdict.

    ``limit`` is a sentence such as ``at most 0.02``; ``state`` is ``ok``, ``review`` or ``info`` (no limit).
    """

    name: str
    title: str
    value: float
    unit: str
    limit: str
    state: Literal["ok", "review", "info"]
    meaning: str


@dataclass(frozen=True)
class Verdict:
    """The judgement of one case: the word, at most three reasons in plain words, and every metric."""

    word: Word
    reasons: tuple[str, ...]
    metrics: tuple[Metric, ...]
