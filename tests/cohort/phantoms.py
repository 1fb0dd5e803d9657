"""Phantom knees of varied anatomy for whole cohorts: the same index gives the same knee, byte for byte."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.files.phantom_case import write_phantom_case
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.records import Side

SEED = 20250611
#: One healthy case in so many is a CT without labels.
CASES_A_CT = 40
#: Within these every knee ends in a table: narrower than what a phantom may be, wider than what most patients are.
ANATOMY: dict[str, tuple[float, float]] = {
    "scale": (0.88, 1.12),
    "condyle_spacing_mm": (44.0, 49.0),
    "condyle_width_mm": (23.5, 26.5),
    "medial_radius_mm": (20.5, 23.5),
    "lateral_radius_mm": (19.5, 22.0),
    "distal_radius_excess_mm": (6.5, 10.0),
    "crown_mm": (8.0, 12.0),
    "cartilage_mm": (2.2, 3.2),
    "meniscus_height_mm": (5.0, 7.0),
    "posterior_slope_deg": (2.0, 9.0),
    "femoral_valgus_deg": (2.0, 8.0),
    "femoral_shaft_radius_mm": (11.5, 14.5),
    "tibial_shaft_radius_mm": (10.5, 13.5),
    "shaft_length_mm": (50.0, 75.0),
    "clearance_mm": (0.05, 0.2),
    "seat_play_mm": (0.05, 0.5),
    "roughness_mm": (0.0, 0.2),
    "flexion_deg": (4.0, 14.0),
    "varus_deg": (-1.0, 2.0),
    "internal_rotation_deg": (0.0, 6.0),
    "margin_mm": (4.0, 7.0),
}
#: How the knee lies in its scan.
SCAN: dict[str, tuple[float, float]] = {
    "spacing_mm": (1.0, 1.2),
    "placement_deg": (-15.0, 15.0),
    "placement_mm": (-200.0, 200.0),
    "grid_tilt_deg": (4.0, 14.0),
}


@dataclass(frozen=True)
class PhantomCase:
    """A healthy case: its ID, its knee, and whether it comes as a CT without labels."""

    case_id: str
    spec: PhantomSpec
    as_ct: bool = False

    def write(self, cases: Path) -> None:
        """The case folder, ``cases/ID``."""
        write_phantom_case(cases / self.case_id, self.spec, as_ct=self.as_ct)


def case_id(index: int) -> str:
    """ID of the case of this index, from 0."""
    return f"K{index + 1:03d}"


def phantom_spec(index: int) -> PhantomSpec:
    """The knee of this index, from 0."""
    random = np.random.default_rng([SEED, index])
    side: Side = "right" if random.random() < 0.5 else "left"
    anatomy = {name: float(random.uniform(*limits)) for name, limits in ANATOMY.items()}
    spacing, turn, place, tilt = (tuple(random.uniform(*limits, 3).tolist()) for limits in SCAN.values())
    return PhantomSpec(
        side=side,
        seed=index,
        **anatomy,
        spacing_mm=spacing,
        placement_deg=turn,
        placement_mm=place,
        grid_tilt_deg=tilt,
    )


def phantom_cases(count: int) -> Iterator[PhantomCase]:
    """The first so many cases, labels for most of them; the first CT comes early, so that small cohorts have one."""
    for index in range(count):
        yield PhantomCase(case_id(index), phantom_spec(index), as_ct=index % CASES_A_CT == 1)
