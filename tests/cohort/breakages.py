"""Twenty things that go wrong between a scanner and this program, each with the refusal that it must end in."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from pipeline.files.case_files import CT_FOLDER
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.files.nrrd_format import encode_nrrd, read_nrrd
from pipeline.files.phantom_case import write_phantom_case
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import CtVolume, LabelVolume

#: Coarse, since nearly all are refused at the door; away from the middle, so that left and right cannot be confused.
SPEC = PhantomSpec(spacing_mm=(1.6, 1.6, 1.6), shaft_length_mm=50.0, placement_mm=(-150.0, 60.0, 400.0))
#: A larger knee, bent otherwise.
OTHER_PATIENT = replace(SPEC, medial_radius_mm=25.0, condyle_spacing_mm=52.0, flexion_deg=25.0)

LABELS, DECLARATION = "labels.nrrd", "case.yaml"
BONES = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}


@dataclass(frozen=True)
class Breakage:
    """One thing that goes wrong.

    Attributes
    ----------
    name : str
    code : str
        Of the refusal; each has a code of its own.
    problem : str
        Pattern that its problem must hold.
    spoil : callable
        Does it to the folder of a healthy case.
    as_ct : bool
        Whether that case is a CT without labels.
    """

    name: str
    code: str
    problem: str
    spoil: Callable[[Path], None]
    as_ct: bool = False

    def write(self, folder: Path) -> None:
        """Write the case folder as it comes to the program."""
        for name, data in _healthy(self.as_ct).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        self.spoil(folder)


@cache
def _healthy(as_ct: bool) -> Mapping[str, bytes]:  # noqa: FBT001
    """The files of a case before anything goes wrong with it."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "case"
        write_phantom_case(folder, SPEC, as_ct=as_ct)
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@cache
def _labels() -> LabelVolume:
    return phantom_labels(SPEC)


@cache
def _ct() -> CtVolume:
    x, y, z = map(float, SPEC.spacing_mm)
    return synthetic_ct(_labels(), BONES, SyntheticCtSpec(spacing_mm=(x, y, z)))


# The declaration -----------------------------------------------------------------------------------------------------


def _declared(old: str, new: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        _replace(folder / DECLARATION, old.encode(), new.encode())

    return spoil


def _declaration_by_a_word_processor(folder: Path) -> None:
    path = folder / DECLARATION
    path.write_bytes(b"\x00\xd0\xcf\x11" + path.read_bytes())


# The label map -------------------------------------------------------------------------------------------------------


def _in_header(old: bytes, new: bytes) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        _replace(folder / LABELS, old, new)

    return spoil


def _relabelled(values: Mapping[int, int]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        labels = _labels()
        new = np.asarray(labels.values).copy()
        for old, value in values.items():
            new[labels.values == old] = value
        _put_labels(folder, LabelVolume(new, labels.lps_from_index))

    return spoil


def _cut_short(folder: Path) -> None:
    path = folder / LABELS
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _ct_in_its_place(folder: Path) -> None:
    ct = _ct()
    header, voxels = encode_nrrd(CtVolume(ct.values, ct.lps_from_index)), np.asarray(ct.values, dtype="<f4") + 0.25
    text = header[: header.index(b"\n\n") + 2].replace(b"type: int16", b"type: float").replace(b"gzip", b"raw")
    (folder / LABELS).write_bytes(text + voxels.tobytes(order="F"))


def _header_without_voxels(folder: Path) -> None:
    data = (folder / LABELS).read_bytes()
    end = data.index(b"\n\n")
    (folder / LABELS).unlink()
    (folder / "labels.nhdr").write_bytes(data[:end] + b"\ndata file: labels.raw.gz\n")


def _two_versions(folder: Path) -> None:
    (folder / "labels.seg.nrrd").write_bytes((folder / LABELS).read_bytes())


def _link_to_a_share(folder: Path) -> None:
    (folder / LABELS).unlink()
    (folder / LABELS).symlink_to("../../../segmentation_server/labels.nrrd")


def _landmarks_of_the_other_frame(folder: Path) -> None:
    volume = read_nrrd((folder / LABELS).read_bytes(), LABELS)
    voxel = np.argwhere(np.asarray(volume.values) == PHANTOM_LABELS["femur"])[0]
    lps = (volume.lps_from_index @ [*voxel, 1.0])[:3]
    point = {"label": "medial_condyle_centre", "position": lps.tolist()}
    markup = {"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": [point]}
    document = {"@schema": "https://x/markups-schema-v1.0.3.json#", "markups": [markup]}
    (folder / "landmarks.mrk.json").write_text(json.dumps(document))


# The CT --------------------------------------------------------------------------------------------------------------


def _slice_lost(folder: Path) -> None:
    files = sorted((folder / CT_FOLDER).iterdir())
    files[len(files) // 2].unlink()


def _second_series(folder: Path) -> None:
    _add(folder, {f"B{name}": data for name, data in encode_series(_ct(), SeriesSpec(seed="B")).items()})


def _labels_of_another_patient(folder: Path) -> None:
    _put_labels(folder, phantom_labels(OTHER_PATIENT))
    with (folder / DECLARATION).open("a") as file:
        file.write("labels: phantom\n")


# The folder ----------------------------------------------------------------------------------------------------------


def _emptied(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


def _archive(folder: Path) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(LABELS, (folder / LABELS).read_bytes())
    (folder / LABELS).unlink()
    (folder / "study.zip").write_bytes(buffer.getvalue())


def _replace(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert data.count(old) == 1, (path.name, old)
    path.write_bytes(data.replace(old, new))


def _put_labels(folder: Path, labels: LabelVolume) -> None:
    (folder / LABELS).write_bytes(encode_nrrd(labels))


def _add(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        (folder / CT_FOLDER / name).write_bytes(data)


FEMUR, TIBIA = PHANTOM_LABELS["femur"], PHANTOM_LABELS["tibia"]

BREAKAGES: tuple[Breakage, ...] = (
    Breakage("side not given", "E-SIDE-01", "The side of the body is not given", _declared("side: right\n", "")),
    Breakage("word misspelt", "E-CASE-02", "is not a known key", _declared("side:", "sied:")),
    Breakage("slice lost", "E-DCM-09", "missing inside the CT series", _slice_lost, as_ct=True),
    Breakage("label map cut short", "E-IO-11", "labels.nrrd is damaged or incomplete", _cut_short),
    Breakage("side wrong", "E-SIDE-02", "The case says left knee, but", _declared("right", "left")),
    Breakage("bones exchanged", "E-LBL-06", "below the tibia", _relabelled({FEMUR: TIBIA, TIBIA: FEMUR})),
    Breakage("folder empty", "E-IO-03", "holds no files", _emptied),
    Breakage("femur alone", "E-LBL-01", r"Label \d+ \(tibia\) is empty", _relabelled({TIBIA: 0})),
    Breakage("two series", "E-DCM-03", "of more than one study", _second_series, as_ct=True),
    Breakage("CT named labels", "E-LBL-02", "labels.nrrd is not a label map", _ct_in_its_place),
    Breakage("archive", "E-IO-15", "it holds .*study.zip", _archive),
    Breakage("no text", "E-CASE-01", "case.yaml cannot be read", _declaration_by_a_word_processor),
    Breakage("side in German", "E-CASE-03", "expected", _declared("right", "rechts")),
    Breakage(
        "metres",
        "E-GEO-05",
        "gives its lengths in",
        _in_header(b"dimension: 3\n", b'dimension: 3\nspace units: "m" "m" "m"\n'),
    ),
    Breakage("orientation lost", "E-GEO-01", "orientation of labels.nrrd", _in_header(b"space origin", b"content")),
    Breakage("two versions", "E-IO-16", "more than one segmentation", _two_versions),
    Breakage("voxels elsewhere", "E-IO-12", "its voxels are in another file", _header_without_voxels),
    Breakage("link to a share", "E-IO-02", "labels.nrrd is a link", _link_to_a_share),
    Breakage(
        "another patient's labels", "E-LBL-08", "does not belong to this CT", _labels_of_another_patient, as_ct=True
    ),
    Breakage("landmarks in RAS", "E-LMK-02", "would fit", _landmarks_of_the_other_frame),
)
