"""Datasets in BIDS to try things with: empty images under the right names, or a phantom knee."""

from __future__ import annotations

import json
from pathlib import Path

from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import LabelVolume
from tests.files.label_samples import nifti_bytes

#: What a segmentation of a knee may call its labels; not our names, and not our order of words.
LOOKUP = {
    "Femur": 5,
    "Tibia": 6,
    "Patella": 7,
    "Fibula": 8,
    "Femoral cartilage": 1,
    "Cartilage, medial tibia": 2,
    "Lateral tibial cartilage": 3,
    "PatellarCartilage": 4,
    "Lateral meniscus": 9,
    "Meniscus (medial)": 10,
}
DESCRIPTION = {"Name": "Knees", "BIDSVersion": "1.11.0", "DatasetType": "raw"}
SEGMENTED = {**DESCRIPTION, "DatasetType": "derivative", "GeneratedBy": [{"Name": "drawn by hand"}]}


def put(dataset: Path, name: str, content: str | bytes = "image") -> Path:
    """A file of the dataset, with its folders."""
    path = dataset / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def lookup(values: dict[str, int] = LOOKUP) -> str:
    """A ``dseg.tsv``."""
    return "".join(f"{value}\t{name}\n" for name, value in {"name": "index", "background": 0, **values}.items())


def empty_dataset(dataset: Path, *names: str) -> Path:
    """A dataset whose images are no images."""
    put(dataset, "dataset_description.json", json.dumps(DESCRIPTION))
    for name in names:
        put(dataset, name)
    return dataset


def phantom_dataset(dataset: Path, subject: str, spec: PhantomSpec, *, ct: bool = False) -> PhantomSpec:
    """The labels of a phantom as a derivative, and its CT as the data; the sidecar says the side."""
    labels = phantom_labels(spec)
    derivative = "derivatives/manual"
    put(dataset, "dataset_description.json", json.dumps(DESCRIPTION))
    put(dataset, f"{derivative}/dataset_description.json", json.dumps(SEGMENTED))
    put(dataset, f"{derivative}/dseg.tsv", lookup())
    put(dataset, f"{derivative}/sub-{subject}/anat/sub-{subject}_dseg.nii.gz", nifti_bytes(labels))
    put(
        dataset, f"{derivative}/sub-{subject}/sub-{subject}_dseg.json", json.dumps({"Laterality": spec.side[0].upper()})
    )
    if ct:
        x, y, z = map(float, labels.spacing_mm)
        bones = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}
        scan = synthetic_ct(labels, bones, SyntheticCtSpec(spacing_mm=(x, y, z)))
        put(
            dataset,
            f"sub-{subject}/ct/sub-{subject}_ct.nii.gz",
            nifti_bytes(LabelVolume(scan.values, scan.lps_from_index)),
        )
    return spec
