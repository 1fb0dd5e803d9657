"""What a phantom knee is made of: the numbers that one may vary, with the range in which the anatomy stays a knee."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.records import Side, Vector

#: Sane range of every number: outside it the parts of the phantom no longer fit together, or it is no knee.
RANGES: dict[str, tuple[float, float]] = {
    "scale": (0.7, 1.4),
    "condyle_spacing_mm": (42.0, 52.0),
    "condyle_width_mm": (22.0, 28.0),
    "medial_radius_mm": (19.0, 25.0),
    "lateral_radius_mm": (18.0, 24.0),
    "distal_radius_excess_mm": (6.0, 14.0),
    "crown_mm": (5.0, 15.0),
    "cartilage_mm": (1.2, 3.5),
    "meniscus_height_mm": (4.0, 8.0),
    "posterior_slope_deg": (0.0, 12.0),
    "femoral_valgus_deg": (0.0, 9.0),
    "femoral_shaft_radius_mm": (10.0, 16.0),
    "tibial_shaft_radius_mm": (9.0, 15.0),
    "shaft_length_mm": (5.0, 200.0),
    "clearance_mm": (0.0, 0.5),
    "seat_play_mm": (0.0, 3.0),
    "roughness_mm": (0.0, 1.0),
    "flexion_deg": (0.0, 30.0),
    "varus_deg": (-5.0, 5.0),
    "internal_rotation_deg": (-10.0, 10.0),
    "margin_mm": (0.0, 50.0),
    "spacing_mm": (0.2, 5.0),
    "placement_deg": (-360.0, 360.0),
    "placement_mm": (-2000.0, 2000.0),
    "grid_tilt_deg": (-45.0, 45.0),
}


@dataclass(frozen=True)
class PhantomSpec:
    """A parametric knee, the pose in which it is scanned, and the voxel grid of the scan.

    The defaults are an adult knee of middle size. Lengths of the anatomy hold at ``scale`` 1 and are multiplied by
    it; the grid is in real millimetres.

    Attributes
    ----------
    side : "right" or "left"
    scale : float
        Overall size.
    condyle_spacing_mm, condyle_width_mm : float
        Distance of the two condyles' mid-planes; width of each condyle.
    medial_radius_mm, lateral_radius_mm : float
        Radius of the posterior condyles to the cartilage surface, in the condyle's mid-plane about the shared
        flexion axis.
    distal_radius_excess_mm : float
        How much larger the sagittal radius is in front of the contact of full extension: what makes the J shape.
    crown_mm : float
        How far the rounded coronal profile falls from the middle of a condyle to its edge.
    cartilage_mm : float
        Thickness of the cartilage of femur and tibia.
    meniscus_height_mm : float
        Height of the menisci above the plateau at their outer rim.
    posterior_slope_deg : float
        Slope of the tibial plateau, falling posteriorly.
    femoral_valgus_deg : float
        Lean of the femoral shaft towards lateral, going up.
    femoral_shaft_radius_mm, tibial_shaft_radius_mm : float
    shaft_length_mm : float
        Shaft in the field of view beyond each metaphysis.
    clearance_mm : float
        Gap between the femoral cartilage and its seat in the scan, measured at the deepest points along the push.
    seat_play_mm : float
        The radii of the seat exceed those of the condyles by the clearance and this. The looser the seat, the less
        it holds the rotation when one compartment is lifted: a shift of d costs d^2 / (2 (clearance + play)).
    roughness_mm : float
        RMS of a smooth random unevenness (wavelengths 8 to 25 mm) of the bones and of the seat.
    seed : int
        Of the unevenness.
    flexion_deg, varus_deg, internal_rotation_deg : float
        Attitude of the tibia in the scan.
    spacing_mm : (i, j, k)
        Voxel size.
    margin_mm : float
        Empty border beside the knee; shafts are cut by the border all the same.
    placement_deg, placement_mm : (x, y, z)
        Rigid placement of the whole scan in the patient space (LPS): turned about x, then y, then z, then shifted.
        It changes the header, never a voxel.
    grid_tilt_deg : (x, y, z)
        Turn of the voxel axes against the knee. A knee is never square to its scan; if it is, the voxels' terraces
        fall on the contacts.

    Raises
    ------
    ValueError
        When a number is not finite or outside its range, or the side is neither right nor left.
    """

    side: Side = "right"
    scale: float = 1.0
    condyle_spacing_mm: float = 46.0
    condyle_width_mm: float = 25.0
    medial_radius_mm: float = 22.0
    lateral_radius_mm: float = 20.5
    distal_radius_excess_mm: float = 8.0
    crown_mm: float = 10.0
    cartilage_mm: float = 2.5
    meniscus_height_mm: float = 6.0
    posterior_slope_deg: float = 5.0
    femoral_valgus_deg: float = 5.0
    femoral_shaft_radius_mm: float = 13.0
    tibial_shaft_radius_mm: float = 12.0
    shaft_length_mm: float = 60.0
    clearance_mm: float = 0.1
    seat_play_mm: float = 0.1
    roughness_mm: float = 0.0
    seed: int = 0
    flexion_deg: float = 8.0
    varus_deg: float = 1.0
    internal_rotation_deg: float = 3.0
    spacing_mm: Vector = (0.7, 0.7, 0.7)
    margin_mm: float = 5.0
    placement_deg: Vector = (0.0, 0.0, 0.0)
    placement_mm: Vector = (0.0, 0.0, 0.0)
    grid_tilt_deg: Vector = (6.0, 12.0, 9.0)

    def __post_init__(self) -> None:
        if self.side not in ("right", "left"):
            raise ValueError(f"side: expected right or left, got {self.side!r}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not (math.isfinite(number) and low <= number <= high):
                    raise ValueError(f"{name}: expected {low:g} to {high:g}, got {number!r}")

    @property
    def half_spacing_mm(self) -> float:
        """Distance of each condyle's mid-plane from the middle of the knee, at scale 1."""
        return self.condyle_spacing_mm / 2

    @property
    def half_width_mm(self) -> float:
        """Distance of the outer wall of the condyles from the middle of the knee, at scale 1."""
        return (self.condyle_spacing_mm + self.condyle_width_mm) / 2
