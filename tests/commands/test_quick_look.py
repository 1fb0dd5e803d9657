"""The look before a run: what it stops, the stages of a run stop with the same words, and the other way round."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline.commands.preflight import Row, State
from pipeline.commands.quick_look import examine
from pipeline.commands.request import Request
from pipeline.engine.outcome import Execution, RunOutcome
from pipeline.engine.runner import run_case
from pipeline.errors import CaseRejected
from pipeline.files.dicom_writer import SeriesSpec, encode_series
from pipeline.files.nrrd_format import encode_nrrd
from pipeline.flow import FLOW
from pipeline.geometry.phantom import PHANTOM_LABELS, phantom_labels
from pipeline.geometry.phantom_spec import PhantomSpec
from pipeline.geometry.synthetic_ct import SyntheticCtSpec, synthetic_ct
from pipeline.geometry.volume import CtVolume, LabelVolume, centroid_lps, in_lps_order
from tests.end_to_end.knee_runs import Silent, up_to
from tests.files.dicom_samples import with_positions

Files = Mapping[str, bytes]

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
BONES = {name: PHANTOM_LABELS[name] for name in ("femur", "tibia", "patella", "fibula")}
KNEE = PhantomSpec(shaft_length_mm=20.0, spacing_mm=(1.5, 1.5, 1.5), grid_tilt_deg=(0.0, 0.0, 0.0))
SCAN = SyntheticCtSpec(spacing_mm=(1.5, 1.5, 1.5))
RIGHT = b"side: right\njoint: knee\n"


@cache
def labels(spec: PhantomSpec = KNEE) -> LabelVolume:
    return phantom_labels(spec)


@cache
def scan(spec: SyntheticCtSpec = SCAN) -> CtVolume:
    return synthetic_ct(labels(), BONES, spec)


def series(ct: CtVolume, laterality: str = "") -> Files:
    return {f"ct/{name}": data for name, data in encode_series(ct, SeriesSpec(laterality=laterality)).items()}


@cache
def leg() -> Files:
    return series(scan())


def only(*names: str) -> CtVolume:
    """A CT of some of the bones."""
    kept = np.isin(labels().values, [BONES[name] for name in names])
    return synthetic_ct(LabelVolume(np.where(kept, labels().values, 0), labels().lps_from_index), BONES, SCAN)


def label_case(volume: LabelVolume, declared: str = "phantom") -> Files:
    return {"labels.nrrd": encode_nrrd(volume), "case.yaml": f"side: right\njoint: knee\nlabels: {declared}\n".encode()}


def moved(volume: LabelVolume, *shift_mm: float) -> LabelVolume:
    matrix = volume.lps_from_index.copy()
    matrix[:3, 3] += shift_mm
    return LabelVolume(volume.values, matrix)


def upside_down() -> LabelVolume:
    exchanged = np.array(labels().values)
    for name, other in (("femur", "tibia"), ("tibia", "femur")):
        exchanged[labels().values == BONES[name]] = BONES[other]
    return LabelVolume(exchanged, labels().lps_from_index)


def without_tibia() -> LabelVolume:
    return LabelVolume(np.where(labels().values == BONES["tibia"], 0, labels().values), labels().lps_from_index)


def tilted() -> Files:
    """The slices of a gantry tilted by 5 deg."""
    ct = scan()
    names = sorted(leg())
    drift = np.tan(np.radians(5.0)) * ct.lps_from_index[2, 2]
    first = ct.lps_from_index[:3, 3]
    step = ct.lps_from_index[:3, 2]
    places = {name: tuple(first + n * step + (0.0, n * drift, 0.0)) for n, name in enumerate(names)}
    return with_positions(dict(leg()), places)


def shaved() -> CtVolume:
    return CtVolume(np.minimum(scan().values, 90), scan().lps_from_index)


def changed(name: str, data: bytes | None) -> Files:
    """The leg with one slice replaced, or taken away."""
    files = {**leg()}
    del files[name]
    return files if data is None else {**files, name: data}


#: What is wrong with a case -> code of the refusal, its files.
REFUSED: dict[str, tuple[str, Callable[[], Files]]] = {
    "no files": ("E-IO-03", dict),
    "no side": ("E-SIDE-01", lambda: {**leg(), "case.yaml": b"joint: knee\n"}),
    "neither CT nor labels": ("E-IO-15", lambda: {"notes.txt": b"x", "case.yaml": RIGHT}),
    "a slice is missing": ("E-DCM-09", lambda: {**changed("ct/IM0050.dcm", None), "case.yaml": RIGHT}),
    "a slice ends early": (
        "E-IO-11",
        lambda: {**changed("ct/IM0040.dcm", leg()["ct/IM0040.dcm"][:3000]), "case.yaml": RIGHT},
    ),
    "a tilted gantry": ("E-GEO-04", lambda: {**tilted(), "case.yaml": RIGHT}),
    "the side of the headers": ("E-SIDE-03", lambda: {**series(scan(), "L"), "case.yaml": RIGHT}),
    "the side of the bones": ("E-SEG-01", lambda: {**leg(), "case.yaml": b"side: left\njoint: knee\n"}),
    "a femur alone": ("E-SEG-01", lambda: {**series(only("femur")), "case.yaml": RIGHT}),
    "no bone": ("E-CT-03", lambda: {**series(shaved()), "case.yaml": RIGHT}),
    "no tibia labelled": ("E-LBL-01", lambda: label_case(without_tibia())),
    "labels exchanged": ("E-LBL-06", lambda: label_case(upside_down())),
    "labels of another scan": ("E-LBL-08", lambda: {**label_case(moved(labels(), 14.0, 10.0, 12.0)), **leg()}),
}


def written(folder: Path, files: Files) -> Path:
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def request(tmp_path: Path) -> Request:
    return Request("P001", tmp_path / "cases", tmp_path / "results", "clinical")


def looked(tmp_path: Path, files: Files) -> list[Row]:
    written(tmp_path / "cases" / "P001", files)
    asked = request(tmp_path)
    return list(examine(asked, asked.settings(FLOW)))


def ran(tmp_path: Path) -> RunOutcome:
    """The run of the same case up to its bones."""
    asked, flow = request(tmp_path), up_to("segment")
    return run_case(asked.job(), flow, asked.settings(FLOW), Execution(jobs=1), Silent())


def states(rows: list[Row]) -> dict[str, State]:
    return {row.title: row.state for row in rows}


@pytest.mark.parametrize("name", REFUSED)
def test_a_stop_is_the_one_of_the_run(tmp_path: Path, name: str) -> None:
    code, files = REFUSED[name]
    rows = looked(tmp_path, files())
    outcome = ran(tmp_path)
    assert outcome.code == code
    assert [row.state for row in rows].count(State.STOP) == 1
    assert (rows[-1].found, rows[-1].action) == (f"{code}  {outcome.problem}", outcome.action)


@pytest.mark.skipif(not (DATA / "foot_ct").is_dir(), reason="shared/data/foot_ct is not there")
def test_a_real_ct_of_feet_is_stopped_as_by_the_run(tmp_path: Path) -> None:
    slices = {f"ct/{path.name}": path.read_bytes() for path in (DATA / "foot_ct" / "dicom").iterdir()}
    rows = looked(tmp_path, {**slices, "case.yaml": RIGHT})
    outcome = ran(tmp_path)
    assert outcome.code == "E-SEG-01"
    assert (rows[-1].state, rows[-1].found) == (State.STOP, f"E-SEG-01  {outcome.problem}")
    assert [row.title for row in rows[:3]] == ["CT series", "side", "slice gaps"]


def with_metal() -> CtVolume:
    x, y, z = (float(n) for n in centroid_lps(labels().values == BONES["femur"], labels().lps_from_index))
    return scan(replace(SCAN, metal_mm=(x, y, z)))


#: A case that a run takes -> its files.
TAKEN: dict[str, Callable[[], Files]] = {
    "one leg": leg,
    "two legs on a table": lambda: series(scan(replace(SCAN, other_leg="left", table_mm=10.0))),
    "metal in the femur": lambda: series(with_metal()),
    "labels": lambda: label_case(labels()),
    "labels and their CT": lambda: {**leg(), **label_case(labels())},
    "a short scan": lambda: series(cut(scan(), 0, 80)),
}


@pytest.mark.parametrize("name", TAKEN)
def test_what_the_run_takes_is_not_stopped(tmp_path: Path, name: str) -> None:
    rows = looked(tmp_path, {"case.yaml": RIGHT, **TAKEN[name]()})
    assert State.STOP not in {row.state for row in rows}
    assert ran(tmp_path).code is None
    looks = {title for title, state in states(rows).items() if state is State.LOOK}
    assert looks == {"metal in the femur": {"metal"}, "a short scan": {"femur", "border"}}.get(name, set())
    assert ("2 knees" in " ".join(row.found for row in rows)) is (name == "two legs on a table")


@pytest.mark.skipif(not (DATA / "knee_mr_a").is_dir(), reason="shared/data/knee_mr_a is not there")
def test_the_labels_of_a_real_knee_are_well(tmp_path: Path) -> None:
    real = {"labels.nrrd": (DATA / "knee_mr_a" / "labels.nrrd").read_bytes()}
    rows = looked(tmp_path, {**real, "case.yaml": b"side: right\njoint: knee\nlabels: mskt\n"})
    assert set(states(rows).values()) == {State.OK}
    found = {row.title: row.found for row in rows}
    assert "the fibula lies" in found["side (bones)"]
    # bone to bone, with cartilage and menisci of a grown-up between them
    assert 3.0 < float(found["joint space"].split()[1]) < 8.0


@pytest.mark.skipif(not (DATA / "legs_ssm").is_dir(), reason="shared/data/legs_ssm is not there")
def test_of_meshes_it_says_what_is_not_looked_at(tmp_path: Path) -> None:
    meshes = {f"meshes/{path.name}": path.read_bytes() for path in (DATA / "legs_ssm" / "mean").glob("*.stl")}
    rows = looked(tmp_path, {**meshes, "case.yaml": RIGHT})
    assert [(row.title, row.state) for row in rows] == [
        (title, State.OK) for title in ("bones", "structures", "not there")
    ]
    assert "not looked at" in rows[0].found


def cut(ct: CtVolume, low: int, high: int) -> CtVolume:
    """Some of the slices."""
    matrix = ct.lps_from_index.copy()
    matrix[:3, 3] += low * matrix[:3, 2]
    return CtVolume(np.ascontiguousarray(ct.values[:, :, low:high]), matrix)


def test_a_bone_cut_at_the_side_is_looked_at(tmp_path: Path) -> None:
    ct = in_lps_order(scan())
    middle = np.argwhere(ct.values > 300).mean(axis=0)[1]
    begin = int(middle) - 22
    matrix = ct.lps_from_index.copy()
    matrix[:3, 3] += begin * matrix[:3, 1]
    beside = CtVolume(np.ascontiguousarray(ct.values[:, begin:]), matrix)
    rows = looked(tmp_path, {**series(beside), "case.yaml": RIGHT})
    assert states(rows)["border"] is State.LOOK
    assert ran(tmp_path).code is None


def test_lengths_of_the_coarse_copy_are_those_of_the_labels(tmp_path: Path) -> None:
    of_ct = {row.title: row.found for row in looked(tmp_path / "a", {**leg(), "case.yaml": RIGHT})}
    of_labels = {row.title: row.found for row in looked(tmp_path / "b", label_case(labels()))}
    for bone in ("femur", "tibia"):
        mine, truth = ([float(word) for word in found[bone].split() if word.isdigit()] for found in (of_ct, of_labels))
        assert np.abs(np.subtract(mine, truth)).max() <= 3.0, bone
    spaces = [float(found["joint space"].split()[1]) for found in (of_ct, of_labels)]
    assert spaces[0] == pytest.approx(spaces[1], abs=1.3)


def test_programs_of_the_site_are_not_run_and_nothing_is_stopped_in_their_place(tmp_path: Path) -> None:
    written(tmp_path / "cases" / "P001", REFUSED["the side of the bones"][1]())
    asked = request(tmp_path)
    settings = asked.settings(FLOW)
    settings["segment"] = settings["segment"].model_copy(update={"commands": ("no program",)})
    rows = examine(asked, settings)
    assert (rows[-1].title, rows[-1].state) == ("bones", State.LOOK)
    assert "the site's programs are asked in the run" in rows[-1].found


def test_foreign_bytes_are_read_in_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise CaseRejected("E-IO-15", str(os.getpid()), "")

    monkeypatch.setattr("pipeline.stages.intake.run", refuse)
    (row,) = looked(tmp_path, {"case.yaml": RIGHT})
    assert row.found.split()[-1].isdigit()
    assert row.found != f"E-IO-15  {os.getpid()}"


def test_nothing_is_written(tmp_path: Path) -> None:
    looked(tmp_path, {**leg(), "case.yaml": RIGHT})
    names = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {f"cases/P001/{name}" for name in (*leg(), "case.yaml")}


def test_no_patient_and_no_folder_is_named(tmp_path: Path) -> None:
    secret = {name: data.replace(b"SYNTHETIC", b"MUELLER^J") for name, data in leg().items()}
    assert any(b"MUELLER^J" in data for data in secret.values())
    text = " ".join(f"{row.found} {row.action}" for row in looked(tmp_path, {**secret, "case.yaml": RIGHT}))
    assert "MUELLER" not in text
    assert str(tmp_path) not in text
