"""Settings of the report: what is guaranteed, and what pictures show."""

from __future__ import annotations

from pydantic import Field

from pipeline.engine.stage import StrictParams

#: Where a report has room for how the run went; a page without it tells why there is no report.
RUN_MARK = b"<!-- the run -->\n"


class Limits(StrictParams):
    """Limits of the verdict; beyond one of them a person has to look."""

    max_volume_error_percent: float = Field(
        2.0, gt=0, le=50, description="largest difference between a mesh's volume and that of its label, percent"
    )
    max_contact_error_mm: float = Field(
        0.02, gt=0, le=1, description="largest gap or overlap left at an entry of the smoothed table, mm"
    )
    max_midpoint_error_mm: float = Field(
        0.145,
        gt=0,
        le=1,
        description="largest gap or overlap half-way between entries, mm; 0.145 mm is one arc minute seen from 0.5 m",
    )
    max_raw_contact_error_mm: float = Field(
        0.02, gt=0, le=1, description="largest distance from contact proven for an entry of the sweep, mm"
    )


class PictureSettings(StrictParams):
    """What the pictures show and how large."""

    panel_px: int = Field(300, ge=150, le=1200, description="width and height of one panel of a contact sheet, pixels")
    flexions_deg: list[float] = Field(
        [0.0, 30.0, 60.0, 90.0, 120.0], min_length=1, max_length=9, description="flexions shown, degrees"
    )
    field_of_view_mm: float = Field(
        200.0, gt=1, le=2000, description="most that a panel shows from bottom to top, mm; long shafts are cut"
    )
    contact_range_mm: float = Field(4.0, gt=0, le=50, description="end of the colour scale of the contact maps, mm")
    motion_poses: int = Field(
        31, ge=2, le=121, description="poses of the film on the way out; 31 make 61 frames, out and back"
    )
    carried: list[str] = Field(
        ["fibula"],
        description="structures that go with the moving body though they are not part of its contact surface",
    )
