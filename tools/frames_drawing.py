"""Drawings of the frames and signs, made with the phantom knee and the joint coordinates of the program itself.

Nothing is placed by hand: bones, axes and arrows are moved by :func:`moved_from_scan`, so a sign that is wrong in the
code is wrong in the drawing, and `tests/test_pictures.py` says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.adapters import pictures
from pipeline.adapters.mask_surface import SurfaceSettings, mask_to_mesh
from pipeline.adapters.pictures import BOLD, Color, Image, Text
from pipeline.adapters.rendering import Surface, snapshots
from pipeline.geometry.mesh import TriangleMesh, transformed
from pipeline.geometry.phantom import PHANTOM_LABELS, PhantomTruth, phantom_labels, phantom_truth
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.views import Direction, View, view
from pipeline.kinematics.joint_coordinates import JointCoordinates, attitude_rotation, moved_from_scan
from pipeline.records import Side, Vector
from pipeline.report.figure_frame import MARGIN_PX, RESEARCH_USE, mark_edges, title_panel
from pipeline.report.palette import AXIS, BONE, DELTA, MOVING, structure_color

Float = NDArray[np.float64]

#: The bones are drawn this far apart, so that shifts can be seen and nothing overlaps.
APART_MM = 15.0
#: Body -> its structures and its colour.
BODIES: Mapping[str, tuple[tuple[str, ...], Color]] = {
    "femur": (("femur", "femoral_cartilage"), BONE),
    "tibia": (
        ("tibia", "medial_tibial_cartilage", "lateral_tibial_cartilage", "medial_meniscus", "lateral_meniscus"),
        MOVING,
    ),
    "fibula": (("fibula",), structure_color("fibula")),
}
STILL, MOVED = ("femur",), ("tibia", "fibula")
TRIANGLES = 20_000
ARROW: Color = (150, 0, 90)
#: Points on the way of a marked point.
STEPS = 24
#: The last part of a way, which carries the head of the arrow.
HEAD_PX = 45.0
FRAME_PX, SIGN_PX = 460, 340
AXIS_MM = 24.0
#: Ends of the arrow of the push, along Δ from the tibia's origin, mm.
PUSH_MM = (-75.0, -25.0)


@dataclass(frozen=True)
class Sign:
    """One coordinate, raised from the start pose, and from where that is seen.

    Attributes
    ----------
    coordinate : str
        A field of :class:`JointCoordinates`.
    amount : float
        Radians or millimetres, positive.
    title, meaning : str
        What is written above and below.
    seen_from : str
        Where the observer stands.
    mark : str
        Landmark of the phantom's tibia whose way is drawn.
    toward : str
        Anatomical direction in which it goes.
    """

    coordinate: str
    amount: float
    title: str
    meaning: str
    seen_from: Direction
    mark: str
    toward: Direction

    @property
    def turns(self) -> bool:
        """Whether it is an angle."""
        return self.coordinate.endswith("_rad")


#: Angle -> its axis, which a panel shows from its end, and the colour of it.
AXES = {
    "flexion_rad": ("flexion axis", AXIS),
    "varus_rad": ("floating axis", AXIS),
    "internal_rotation_rad": ("Δ", DELTA),
}
_FAR, _FRONT = "tibial_shaft_end", "tibial_tuberosity"
SIGNS = (
    Sign("flexion_rad", np.radians(40.0), "+40° flexion", "the shank folds backwards", "lateral", _FAR, "posterior"),
    Sign("varus_rad", np.radians(12.0), "+12° varus", "the distal tibia goes medially", "anterior", _FAR, "medial"),
    Sign(
        "internal_rotation_rad", np.radians(25.0), "+25° internal rotation", "the front of the tibia turns medially",
        "proximal", _FRONT, "medial",
    ),
    Sign("lateral_mm", APART_MM, "+15 mm lateral", "the tibia goes laterally", "anterior", _FRONT, "lateral"),
    Sign("anterior_mm", APART_MM, "+15 mm anterior", "the tibia goes forwards", "lateral", _FRONT, "anterior"),
    Sign("proximal_mm", APART_MM, "+15 mm proximal", "the tibia goes to the femur", "anterior", _FRONT, "proximal"),
)  # fmt: skip


@dataclass(frozen=True)
class Knee:
    """The phantom of one side, scanned with all angles 0."""

    side: Side
    spacing_mm: float = 1.0

    @cached_property
    def spec(self) -> PhantomSpec:
        """What it is made of."""
        spacing: Vector = (self.spacing_mm,) * 3
        return PhantomSpec(
            side=self.side, spacing_mm=spacing, flexion_deg=0.0, varus_deg=0.0, internal_rotation_deg=0.0
        )

    @cached_property
    def truth(self) -> PhantomTruth:
        """Frames and landmarks in scan space, LPS mm."""
        return phantom_truth(self.spec)

    @cached_property
    def start(self) -> JointCoordinates:
        """Where the drawings begin: angles 0, the tibia below its seat."""
        lateral, anterior, proximal = self.truth.seat_attitude[3:].tolist()
        return JointCoordinates(0.0, 0.0, 0.0, lateral, anterior, proximal - APART_MM)

    @cached_property
    def bodies(self) -> dict[str, TriangleMesh]:
        """Meshes as scanned, LPS mm."""
        labels = phantom_labels(self.spec)
        return {
            name: mask_to_mesh(
                np.isin(labels.values, [PHANTOM_LABELS[part] for part in parts]),
                labels.lps_from_index,
                SurfaceSettings(TRIANGLES),
            ).mesh
            for name, (parts, _) in BODIES.items()
        }

    def motion(self, pose: JointCoordinates) -> Float:
        """(4, 4) motion of the tibia from the scan to a pose; scan space."""
        return moved_from_scan(self.truth.scan_from_reference, self.truth.scan_from_moving, pose)

    def moved(self, points: Float, pose: JointCoordinates) -> Float:
        """Points (N, 3) of the tibia, as scanned, at a pose; scan space."""
        motion = self.motion(pose)
        return np.asarray(points @ motion[:3, :3].T + motion[:3, 3])

    def surfaces(self, names: Sequence[str], pose: JointCoordinates) -> list[Surface]:
        """Bodies to draw; those that move, at a pose."""
        motion = self.motion(pose)
        meshes = {name: self.bodies[name] for name in names}
        return [
            Surface(transformed(mesh, motion) if name in MOVED else mesh, np.array(BODIES[name][1], np.uint8))
            for name, mesh in meshes.items()
        ]


def raised(start: JointCoordinates, sign: Sign, share: float = 1.0) -> JointCoordinates:
    """The start with a share of the sign's amount added to its one coordinate."""
    return start._replace(**{sign.coordinate: getattr(start, sign.coordinate) + share * sign.amount})


def way(knee: Knee, sign: Sign) -> Float:
    """(STEPS, 3) places of the marked point from the start to the raised pose; scan space, mm."""
    mark = knee.truth.landmarks[sign.mark][None]
    return np.vstack([knee.moved(mark, raised(knee.start, sign, share)) for share in np.linspace(0.0, 1.0, STEPS)])


def shift_steps(knee: Knee, pose: JointCoordinates) -> Float:
    """(4, 3) corners of d, drawn from the femur's origin: lateral, then anterior, then proximal; scan space, mm."""
    axes = attitude_rotation(pose.flexion_rad, pose.varus_rad)
    corners = np.vstack([np.zeros(3), np.cumsum(axes.T * np.array(pose[3:])[:, None], axis=0)])
    return _placed(knee.truth.scan_from_reference, corners)


def sign_view(knee: Knee, sign: Sign) -> View:
    """How a sign is looked at."""
    frame = knee.truth.scan_from_reference
    if sign.seen_from == "proximal":
        return view(frame, "proximal", _placed(frame, np.array([[0.0, 0.0, -50.0]]))[0], 52.0)
    behind_mm = 14.0 if sign.coordinate == "flexion_rad" else 0.0
    middle = np.array([[0.0, -behind_mm, -45.0 if sign.turns else -28.0]])
    return view(frame, sign.seen_from, _placed(frame, middle)[0], 140.0 if sign.turns else 100.0)


def signs_picture(knee: Knee) -> Image:
    """Six panels, one for each coordinate."""
    panels = [_sign_panel(knee, sign) for sign in SIGNS]
    title = "Each coordinate raised by itself; pale: before. The arrow is the way of one point of the tibia"
    words = f"{knee.side.upper()} knee ({knee.side[0].upper()}), positive signs"
    return _sheet(words, title, pictures.tiled([panels[:3], panels[3:]]))


def _sign_panel(knee: Knee, sign: Sign) -> Image:
    seen, end = sign_view(knee, sign), raised(knee.start, sign)
    still = () if sign.seen_from == "proximal" else STILL
    image = _with_ghost(knee.surfaces([*still, *MOVED], end), knee.surfaces(MOVED, knee.start), seen)
    size = (SIGN_PX, SIGN_PX)
    title_panel(image, sign.title)
    mark_edges(image, seen)
    if sign.turns:
        _draw_axis_from_its_end(image, sign, seen.pixels(_centre(knee, sign)[None], size))
    path = seen.pixels(way(knee, sign), size)
    pictures.draw_segments(image, np.stack([path[:-1], path[1:]], axis=1), ARROW, 4)
    tail = path[np.linalg.norm(path - path[-1], axis=1) < HEAD_PX][0]
    pictures.draw_arrow(image, np.stack([tail, path[-1]]), ARROW, 4)
    pictures.draw_dots(image, path[:1], ARROW, 5.0)
    return _captioned(image, f"{sign.meaning} (from {sign.seen_from})")


def _draw_axis_from_its_end(image: Image, sign: Sign, at: Float) -> None:
    name, color = AXES[sign.coordinate]
    pictures.draw_dots(image, at, color, 6.0)
    pictures.draw_tag(image, Text(name, 13, color=color), (at[0, 0], at[0, 1] - 12), 0.5)


def _centre(knee: Knee, sign: Sign) -> Float:
    """(3,) point of the axis about which a sign turns."""
    if sign.coordinate == "internal_rotation_rad":
        return np.asarray(knee.moved(knee.truth.scan_from_moving[None, :3, 3], knee.start)[0])
    return np.asarray(knee.truth.scan_from_reference[:3, 3])


def _with_ghost(surfaces: Sequence[Surface], ghost: Sequence[Surface], seen: View) -> Image:
    """A scene, and behind it, pale and with its outline over everything, what was there before."""
    size = (SIGN_PX, SIGN_PX)
    (image,), (before,) = snapshots(surfaces, [seen], size), snapshots(ghost, [seen], size)
    covers, covered = _drawn(before), _drawn(image)
    image[covers & ~covered] = (before[covers & ~covered] * 0.35 + 255 * 0.65).astype(np.uint8)
    image[_rim(covers)] = pictures.GREY
    return image


def _drawn(image: Image) -> NDArray[np.bool_]:
    return np.asarray((image < 250).any(axis=2))


def _rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    inner = mask.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(mask, step, axis=axis)
    return mask & ~inner


def frames_picture(knee: Knee) -> Image:
    """Both frames, d, delta and the flexion axis; the attitude frame; and the zero pose."""
    bent = knee.start._replace(flexion_rad=np.radians(60.0), anterior_mm=14.0)
    panels = [
        [_angles_zero(knee, "anterior"), _angles_zero(knee, "lateral")],
        [_attitude_panel(knee, bent), _zero_panel(knee)],
    ]
    words = f"{knee.side.upper()} knee ({knee.side[0].upper()}), frames and zero pose"
    title = "Blue: frame of the femur, flexion axis. Orange: tibia's frame; its z is Δ, the push. Drawn through bone"
    return _sheet(words, title, pictures.tiled(panels))


def _angles_zero(knee: Knee, side: Direction) -> Image:
    image, seen = _scene(knee, knee.start, side)
    _draw_frame(image, seen, knee.truth.scan_from_reference, AXIS, "xyz")
    _draw_frame(image, seen, knee.motion(knee.start) @ knee.truth.scan_from_moving, DELTA, "xyΔ")
    title_panel(image, "all angles 0")
    caption = f"seen from {side}; both frames are parallel, x lateral, y anterior, z proximal"
    return _captioned(image, caption)


def _attitude_panel(knee: Knee, pose: JointCoordinates) -> Image:
    image, seen = _scene(knee, pose, "lateral")
    _draw_frame(image, seen, knee.truth.scan_from_reference, AXIS, "xyz")
    _draw_push(image, seen, knee.motion(pose) @ knee.truth.scan_from_moving)
    corners = seen.pixels(shift_steps(knee, pose), (FRAME_PX, FRAME_PX))
    for ends in (corners[1:3], corners[2:4]):
        pictures.draw_arrow(image, ends, ARROW, 3)
    words = (f"anterior {pose.anterior_mm:+.0f} mm", f"proximal {pose.proximal_mm:+.0f} mm")
    for text, ends in zip(words, (corners[1:3], corners[2:4]), strict=True):
        at = ends.mean(axis=0)
        pictures.draw_tag(image, Text(text, 14, BOLD, ARROW), (at[0] + 10, at[1] + 5))
    title_panel(image, "flexion 60°")
    return _captioned(image, "shifts are along the axes turned by flexion and varus: proximal is along Δ")


def _draw_push(image: Image, seen: View, scan_from_moving: Float) -> None:
    along = np.array([[0.0, 0.0, at] for at in (0.0, *PUSH_MM)])
    origin, *ends = seen.pixels(_placed(scan_from_moving, along), (image.shape[1], image.shape[0]))
    pictures.draw_arrow(image, np.stack(ends), DELTA, 4)
    pictures.draw_dots(image, origin[None], DELTA, 5.0)
    pictures.draw_tag(image, Text("Δ push", 15, BOLD, DELTA), (ends[0][0], ends[0][1] + 24))


def _zero_panel(knee: Knee) -> Image:
    zero = JointCoordinates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    seen = _frame_view(knee, "lateral")
    size = (FRAME_PX, FRAME_PX)
    (femur,), (tibia,) = (snapshots(knee.surfaces(names, zero), [seen], size) for names in (STILL, MOVED))
    image = (femur.astype(np.uint16) * tibia // 255).astype(np.uint8)
    _draw_frame(image, seen, knee.truth.scan_from_reference, AXIS, "xyz")
    title_panel(image, "zero pose: all six coordinates 0")
    mark_edges(image, seen)
    return _captioned(image, "the frames coincide and the bones overlap: a definition, no knee stands so")


def _frame_view(knee: Knee, side: Direction) -> View:
    frame = knee.truth.scan_from_reference
    return view(frame, side, _placed(frame, np.array([[0.0, 0.0, -14.0]]))[0], 95.0)


def _scene(knee: Knee, pose: JointCoordinates, side: Direction) -> tuple[Image, View]:
    seen = _frame_view(knee, side)
    (image,) = snapshots(knee.surfaces([*STILL, *MOVED], pose), [seen], (FRAME_PX, FRAME_PX))
    if side == "anterior":
        ends = _placed(knee.truth.scan_from_reference, np.array([[-60.0, 0.0, 0.0], [60.0, 0.0, 0.0]]))
        pictures.draw_segments(image, seen.pixels(ends, (FRAME_PX, FRAME_PX))[None], AXIS, 1)
        tip = seen.pixels(ends, (FRAME_PX, FRAME_PX))[0]
        pictures.draw_tag(image, Text("flexion axis", 14, color=AXIS), (tip[0], tip[1] - 8), 0.5)
    mark_edges(image, seen)
    return image, seen


def _draw_frame(image: Image, seen: View, scan_from_frame: Float, color: Color, names: str) -> None:
    """Arrows along the three axes with their names; an axis towards the observer, a dot."""
    size = (image.shape[1], image.shape[0])
    ends = _placed(scan_from_frame, np.vstack([np.zeros(3), AXIS_MM * np.eye(3)]))
    origin, *tips = seen.pixels(ends, size)
    pictures.draw_dots(image, origin[None], color, 5.0)
    for name, tip in zip(names, tips, strict=True):
        along = tip - origin
        short = bool(np.linalg.norm(along) < 0.2 * AXIS_MM)
        if not short:
            pictures.draw_arrow(image, np.stack([origin, tip]), color, 3)
        at = origin + (np.array([-16.0, -14.0]) if short else along + 12.0 * along / np.linalg.norm(along))
        pictures.draw_tag(image, Text(name, 16, BOLD, color), (at[0], at[1] + 5), 0.5)


def _placed(scan_from_frame: Float, points: Float) -> Float:
    """Points (N, 3) of a frame in scan space."""
    return np.asarray(points @ scan_from_frame[:3, :3].T + scan_from_frame[:3, 3])


def _captioned(image: Image, words: str) -> Image:
    strip = pictures.blank(image.shape[1], 26)
    pictures.draw_text(strip, Text(words, 13), (image.shape[1] / 2, 18), 0.5)
    return np.vstack([image, strip])


def _sheet(heading: str, title: str, body: Image) -> Image:
    width = body.shape[1]
    header, footer = pictures.blank(width, 64), pictures.blank(width, 30)
    pictures.draw_text(header, Text(f"Phantom  |  {heading}", 22, BOLD), (MARGIN_PX, 28))
    pictures.draw_text(header, Text(title, 15), (MARGIN_PX, 53))
    pictures.draw_text(footer, Text(RESEARCH_USE, 15, BOLD, pictures.GREY), (width - MARGIN_PX, 21), 1.0)
    return np.vstack([header, body, footer])
