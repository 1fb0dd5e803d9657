"""Whatever bytes come in, a reader returns or refuses with a code: it never fails in another way, warns or hangs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import CaseRejected
from pipeline.files.ligaments_file import read_ligaments
from pipeline.files.markups import read_markups
from pipeline.files.meshes import encode_ply, encode_stl, read_mesh
from pipeline.files.volumes import read_label_map
from pipeline.geometry.mesh import TriangleMesh
from tests.files.label_samples import itk_bytes, knee_like, nifti_bytes, nrrd_bytes, segment_keys

Reader = Callable[[bytes, str], object]

_POINTS = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])
_MESH = TriangleMesh(_POINTS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))
_ASCII_PLY = b"""ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 4
property list uchar int vertex_indices
end_header
0 0 0 30 0 0 0 30 0 0 0 30
3 0 2 1 3 0 1 3 3 0 3 2 3 1 2 3
"""
_FCSV = b"# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n0,1.5,2.5,3.5,Medial\n1,4,5,6,Lateral\n"
_MARKUPS = (
    b'{"@schema": "https://x/markups-schema-v1.0.3.json#", "markups": [{"type": "Fiducial", "coordinateSystem": "LPS",'
    b' "controlPoints": [{"label": "a", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"}]}]}'
)
_LIGAMENTS = b"""name,reference_x,reference_y,reference_z,moving_x,moving_y,moving_z,slack_mm,stiffness_n,kind
ACL am,1.5,-2,30.25,4,5,-6,28.5,820,spring
PCL,5,10,0.5,6,12,-30,31.25,,cord
"""
#: File name -> writer and reader; mutations fall on the first bytes, where the headers are.
SAMPLES: dict[str, tuple[Callable[[Path], bytes], Reader]] = {
    "labels.nii": (lambda _: nifti_bytes(knee_like(), compressed=False), read_label_map),
    "labels.nii.gz": (lambda _: nifti_bytes(knee_like()), read_label_map),
    "labels.nrrd": (lambda _: nrrd_bytes(knee_like(), {"encoding": "raw"}), read_label_map),
    "labels.seg.nrrd": (lambda _: nrrd_bytes(knee_like(), segment_keys({"Femur": 5, "Tibia": 6})), read_label_map),
    "labels.mha": (lambda folder: itk_bytes(knee_like(), folder, "x.mha"), read_label_map),
    "femur.ply": (lambda _: encode_ply(_MESH), read_mesh),
    "ascii.ply": (lambda _: _ASCII_PLY, read_mesh),
    "femur.stl": (lambda _: encode_stl(_MESH), read_mesh),
    "landmarks.fcsv": (lambda _: _FCSV, read_markups),
    "landmarks.mrk.json": (lambda _: _MARKUPS, read_markups),
    "ligaments.csv": (lambda _: _LIGAMENTS, read_ligaments),
}


def mutated(data: bytes, random: np.random.Generator) -> bytes:
    """A few bytes changed, deleted or inserted among the first thousand."""
    out = bytearray(data)
    for kind in random.integers(0, 4, random.integers(1, 4)):
        place = int(random.integers(0, min(len(out), 1000)))
        if kind == 0:
            out[place] ^= 1 << int(random.integers(0, 8))
        elif kind == 1:
            out[place] = int(random.integers(0, 256))
        elif kind == 2:
            del out[place : place + int(random.integers(1, 9))]
        else:
            out[place:place] = random.integers(32, 127, random.integers(1, 5)).astype(np.uint8).tobytes()
    return bytes(out)


@pytest.mark.parametrize("name", SAMPLES)
def test_mutations_end_in_a_result_or_a_refusal(name: str, tmp_path: Path) -> None:
    write, read = SAMPLES[name]
    data = write(tmp_path)
    read(data, name)
    random = np.random.default_rng(20240501)
    refusals = 0
    for _ in range(300):
        try:
            read(mutated(data, random), name)
        except CaseRejected:
            refusals += 1
    assert 50 < refusals < 300


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("data", [b"", b"\0", b"\n", b"<html>404</html>", bytes(5000), b"\xff" * 5000])
def test_what_is_something_else_is_refused(name: str, data: bytes) -> None:
    with pytest.raises(CaseRejected, match=rf"^E-(IO|LMK|LBL|LIG)-\d\d .*{name}"):
        SAMPLES[name][1](data, name)
