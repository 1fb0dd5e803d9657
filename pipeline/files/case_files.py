"""Which files of a case folder are read, and their bytes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

from pipeline.engine.artifacts import SourceFolder
from pipeline.errors import CaseRejected
from pipeline.files.checksums import is_checksum_list
from pipeline.files.ct_volumes import CT_ENDINGS
from pipeline.files.ligaments_file import LIGAMENTS_FILE
from pipeline.files.markups import MARKUP_ENDINGS
from pipeline.files.meshes import MESH_ENDINGS
from pipeline.files.volumes import DETACHED_ENDINGS, LABEL_MAP_ENDINGS

#: Where a DICOM series lies in a case.
CT_FOLDER = "ct/"
#: A larger file is not read into memory at all.
MAX_FILE_BYTES = 4_000_000_000


@dataclass(frozen=True)
class CaseFiles:
    """Names of the files that intake reads, relative to the case folder.

    Attributes
    ----------
    ct : tuple of str
        Files of a DICOM series, or the one file of a CT in another format; empty where the case brought none.
    label_map : str or None
        None where the case brought meshes, or a CT alone.
    meshes : mapping of str to str
        Structure name -> file; empty where the case brought a label map.
    landmarks : str or None
    ligaments : str or None
    checksums : tuple of str
        Lists of checksums that came along.
    """

    ct: tuple[str, ...]
    label_map: str | None
    meshes: Mapping[str, str]
    landmarks: str | None
    ligaments: str | None
    checksums: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        chosen = (*self.ct, self.label_map, *self.meshes.values(), self.landmarks, self.ligaments)
        return tuple(name for name in chosen if name is not None)


def choose_files(names: Collection[str]) -> CaseFiles:
    """The CT, the label map or the meshes, the landmarks and the ligaments among the files of a case folder.

    Raises
    ------
    CaseRejected
        E-IO-15 when there is neither CT nor label map nor mesh, E-IO-16 when there is more than one candidate.
    """
    top = sorted(name for name in names if "/" not in name)
    maps = [name for name in top if _is_label_map(name.lower())]
    meshes = sorted(name for name in names if name.startswith("meshes/") and name.lower().endswith(MESH_ENDINGS))
    ct = _ct_files(names, top)
    if not (maps or meshes or ct):
        raise _no_segmentation(top)
    if len(maps) > 1 or (maps and meshes):
        raise _several("segmentation", [*maps, *meshes[:1]])
    by_structure = {PurePosixPath(name).stem: name for name in meshes}
    if len(by_structure) != len(meshes):
        raise _several("mesh of one structure", meshes)
    landmarks = _at_most_one("landmark file", [name for name in top if name.lower().endswith(MARKUP_ENDINGS)])
    ligaments = _at_most_one("ligament file", [name for name in top if name.lower() == LIGAMENTS_FILE])
    checksums = tuple(sorted(filter(is_checksum_list, names)))
    return CaseFiles(ct, maps[0] if maps else None, by_structure, landmarks, ligaments, checksums)


def read_file(source: SourceFolder, name: str) -> bytes:
    """Bytes of one file of the case.

    Raises
    ------
    CaseRejected
        E-IO-14 for a file beyond MAX_FILE_BYTES, E-IO-17 for one that changed since the run began.
    """
    try:
        if (size := (source.root / name).stat().st_size) > MAX_FILE_BYTES:
            problem = f"{name} has {size / 1e9:.1f} GB, expected at most {MAX_FILE_BYTES / 1e9:.0f} GB."
            raise CaseRejected("E-IO-14", problem, "Crop the label map to the joint.")
        return source.read(name)
    except (FileNotFoundError, ValueError) as error:
        action = "Wait until the file is copied completely, then run again."
        raise CaseRejected("E-IO-17", f"{name} changed while it was being read.", action) from error


def _ct_files(names: Collection[str], top: list[str]) -> tuple[str, ...]:
    """Everything in ``ct/``, or the one CT in a file of its own."""
    series = tuple(sorted(name for name in names if name.startswith(CT_FOLDER) and not is_checksum_list(name)))
    single = [name for name in top if name.lower().startswith("ct.") and name.lower().endswith(CT_ENDINGS)]
    if len(single) + bool(series) > 1:
        raise _several("CT", [*single, *([CT_FOLDER] if series else [])])
    return series or tuple(single)


def _is_label_map(name: str) -> bool:
    endings = LABEL_MAP_ENDINGS + DETACHED_ENDINGS  # the latter so that their reader can say why not
    return name.endswith((".seg.nrrd", ".seg.dcm")) or (name.startswith("labels.") and name.endswith(endings))


def _at_most_one(what: str, names: list[str]) -> str | None:
    if len(names) > 1:
        raise _several(what, names)
    return names[0] if names else None


def _no_segmentation(top: list[str]) -> CaseRejected:
    return CaseRejected(
        "E-IO-15",
        f"The case folder holds neither a CT nor a label map; it holds {', '.join(top[:8]) or 'no files'}.",
        "Put the DICOM files of the CT into its folder ct, or the segmentation there as labels.nii.gz, labels.nrrd or "
        "labels.dcm.",
    )


def _several(what: str, names: list[str]) -> CaseRejected:
    return CaseRejected(
        "E-IO-16",
        f"The case folder holds more than one {what}: {', '.join(names)}.",
        "Keep the one to be used and move the others out of the folder.",
    )
