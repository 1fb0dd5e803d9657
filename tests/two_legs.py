"""A phantom knee and its mirror image in one label map, and a plain CT of them."""

from __future__ import annotations

from functools import cache

import numpy as np

from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.volume import CtVolume, LabelVolume
from pipeline.records import Side

BONES = ("femur", "tibia", "patella", "fibula")


@cache
def leg(side: Side = "right") -> LabelVolume:
    """One leg, voxels of 1.5 mm; the left one is the right one in reverse, with the same grid."""
    right = phantom_labels(PhantomSpec(spacing_mm=(1.5, 1.5, 1.5), shaft_length_mm=50.0))
    return right if side == "right" else LabelVolume(np.asarray(right.values)[::-1], right.lps_from_index)


def side_by_side(first: LabelVolume, second: LabelVolume, between: int = 20) -> LabelVolume:
    """Two volumes of one shape along the first index axis, the first at the patient's right, some voxels apart."""
    gap = np.zeros((between, *first.values.shape[1:]), dtype=np.uint8)
    return LabelVolume(np.concatenate([first.values, gap, second.values]), first.lps_from_index)


@cache
def two_legs() -> LabelVolume:
    """The right leg at the patient's right, the left one at the patient's left."""
    return side_by_side(leg("right"), leg("left"))


def plain_ct(labels: LabelVolume) -> CtVolume:
    """Bone of 900 HU, soft tissue of 40 HU."""
    bone = np.isin(labels.values, [PHANTOM_LABELS[name] for name in BONES])
    return CtVolume(np.where(bone, 900, 40).astype(np.int16), labels.lps_from_index)
