"""A segmentation program as a site may have one: it thresholds a CT and tells bones apart by place and size.

fake_segmenter.py MODE CT LABELS SIDE [FILE]

``total`` writes femora as 75 (left) and 76 (right), ``appendicular`` patellae 1, tibiae 2 and fibulae 3 of both legs;
the other modes go wrong, each in its own way.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import nibabel
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

BONE_HU = 250


def bones(values: NDArray[np.int16], affine: NDArray[np.float64]) -> dict[str, list[NDArray[np.bool_]]]:
    """Masks of each kind of bone, by the patient's side: right, left (RAS)."""
    numbers, count = ndimage.label(values > BONE_HU)
    order = np.argsort(-np.bincount(numbers.ravel())[1:], kind="stable") + 1
    masks = [numbers == number for number in order]
    centres = [affine @ [*ndimage.center_of_mass(mask), 1.0] for mask in masks]
    joint = np.mean([centre[2] for centre in centres[: count // 2]])
    out: dict[str, list[NDArray[np.bool_]]] = {}
    for rank in np.argsort([-centre[0] for centre in centres]):
        above = centres[rank][2] > joint
        name = ("femur" if above else "tibia") if rank < count // 2 else ("patella" if above else "fibula")
        out.setdefault(name, []).append(masks[rank])
    return out


def labelled(mode: str, image: nibabel.Nifti1Image, side: str) -> NDArray[np.uint8]:
    """The label map of a mode."""
    values = np.asarray(image.dataobj)
    out = np.zeros(values.shape, dtype=np.uint8)
    if mode == "nothing":
        return out
    found = bones(values, image.affine)
    if mode in ("total", "moved"):
        for mask, value in zip(found["femur"], (76, 75) if len(found["femur"]) == 2 else (None,), strict=True):
            out[mask] = value or (76 if side == "right" else 75)
    if mode in ("appendicular", "moved"):
        for name, value in (("patella", 1), ("tibia", 2), ("fibula", 3)):
            out[np.any(found[name], axis=0)] = value
    if mode == "overlapping":
        out[np.any([*found["femur"], *found["tibia"]], axis=0)] = 2
    return np.pad(out, ((0, 0), (12, 0), (0, 0)))[:, :-12] if mode == "moved" else out


def main() -> None:
    """Do what the mode says."""
    mode, ct, labels, side, *rest = sys.argv[1:]
    if mode == "fail":
        sys.stderr.write(f"first line\n\x1b[31mno model in {ct}\x07 or '/srv/some models/a' (out of memory)\x1b[0m\n\n")
        sys.exit(3)
    if mode == "hang":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        Path(rest[0]).write_text(f"{child.pid}")
        time.sleep(600)
    if mode == "detach":
        subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    if mode == "chatter":
        sys.stderr.write("word " * 2_000_000)
    if mode == "silent":
        return
    if mode == "garbage":
        Path(labels).write_bytes(b"no label map")
        return
    image = nibabel.load(ct)
    values = (np.asarray(image.dataobj) > BONE_HU).astype(np.uint8)
    affine = np.array(image.affine)
    if mode == "shifted":
        affine[0, 3] += 2.5
    if mode == "cropped":
        values = values[1:]
    if mode not in ("shifted", "cropped", "detach", "chatter", "threshold"):
        values = labelled(mode, image, side)
    out = nibabel.Nifti1Image(values, affine)
    out.header.set_xyzt_units("mm")
    nibabel.save(out, labels)


if __name__ == "__main__":
    main()
