"""A phantom knee as a case folder, as a user would bring it."""

from __future__ import annotations

from pathlib import Path

from pipeline.engine.storage_faults import storage
from pipeline.engine.store import commit_folder, make_folder
from pipeline.errors import ConfigError
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.geometry.phantom import phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec


def write_phantom_case(folder: Path, spec: PhantomSpec) -> None:
    """Write ``labels.nrrd`` and ``case.yaml`` of a phantom; equal specs give equal bytes.

    Parameters
    ----------
    folder : Path
        Made whole or not at all; nothing may be there yet.
    spec : PhantomSpec

    Raises
    ------
    ConfigError
        ``E-PHA-01`` when there is something of that name.
    EnvironmentFault
        When the disk does not take it.
    """
    if folder.exists():
        raise ConfigError("E-PHA-01", f"The case {folder.name} is there already.", "Choose another ID, or remove it.")
    declaration = f"side: {spec.side}\njoint: knee\nlabels: phantom\n"
    files = {"labels.nrrd": encode_nrrd(phantom_labels(spec)), "case.yaml": declaration.encode()}
    with storage("Making the folder of the cases"):
        make_folder(folder.parent)
    commit_folder(folder, files)
