"""A phantom knee as a case folder, as a user would bring it."""

from __future__ import annotations

from pathlib import Path

from pipeline.engine.storage_faults import storage
from pipeline.engine.store import commit_folder, make_folder
from pipeline.errors import ConfigError
from pipeline.files.case_files import CT_FOLDER
from pipeline.files.dicom_writer import encode_series
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct


def write_phantom_case(folder: Path, spec: PhantomSpec, *, as_ct: bool = False) -> None:
    """Write a phantom as a label map, or as a synthetic CT in DICOM files; equal specs give equal bytes.

    Parameters
    ----------
    folder : Path
        Made whole or not at all; nothing may be there yet.
    spec : PhantomSpec
    as_ct : bool
        ``ct/`` without labels, in place of ``labels.nrrd``.

    Raises
    ------
    ConfigError
        ``E-PHA-01`` when there is something of that name.
    EnvironmentFault
        When the disk does not take it.
    """
    if folder.exists():
        raise ConfigError("E-PHA-01", f"The case {folder.name} is there already.", "Choose another ID, or remove it.")
    files = _ct_files(spec) if as_ct else _label_files(spec)
    with storage("Making the folder of the cases"):
        make_folder(folder.parent)
    commit_folder(folder, files)


def _label_files(spec: PhantomSpec) -> dict[str, bytes]:
    declaration = f"side: {spec.side}\njoint: knee\nlabels: phantom\n"
    return {"labels.nrrd": encode_nrrd(phantom_labels(spec)), "case.yaml": declaration.encode()}


def _ct_files(spec: PhantomSpec) -> dict[str, bytes]:
    """A synthetic CT of the phantom on its own grid."""
    labels = phantom_labels(spec)
    x, y, z = map(float, labels.spacing_mm)
    bones = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}
    ct = synthetic_ct(labels, bones, SyntheticCtSpec(spacing_mm=(x, y, z)))
    series = {f"{CT_FOLDER}{name}": data for name, data in encode_series(ct).items()}
    return {**series, "case.yaml": f"side: {spec.side}\njoint: knee\n".encode()}
