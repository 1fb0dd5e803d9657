"""BIDS: the call, which cases a dataset holds, and the case folder that is made of each."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from pipeline.case_declaration import label_preset, read_declaration
from pipeline.cohort.bids import prepare as bids
from pipeline.cohort.bids.call import BidsCall, bids_help, is_bids_call, parse_bids_call
from pipeline.cohort.bids.labels import structure_name
from pipeline.cohort.bids.layout import BidsCase, bids_cases
from pipeline.cohort.bids.prepare import prepare_case, write_dataset_files
from pipeline.engine.source import list_source
from pipeline.errors import CaseRejected, ConfigError
from pipeline.files.case_files import choose_files
from pipeline.files.ct_volumes import read_ct_volume
from pipeline.files.volumes import read_label_map
from pipeline.geometry.phantom import PHANTOM_LABELS
from pipeline.geometry.phantom_spec import PhantomSpec
from tests.cohort.bids_samples import empty_dataset, lookup, phantom_dataset, put

CT = "sub-01/ct/sub-01_ct.nii.gz"
DSEG = "derivatives/manual/sub-01/anat/sub-01_dseg.nii.gz"
TABLE = "derivatives/manual/dseg.tsv"


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path]:
    """``IN`` and ``OUT``."""
    return tmp_path / "in", tmp_path / "out"


def call_of(places: tuple[Path, Path], *more: str) -> BidsCall:
    return parse_bids_call([*map(str, places), "participant", *more])


def only_case(places: tuple[Path, Path], *more: str) -> BidsCase:
    (case,) = bids_cases(call_of(places, *more))
    return case


def prepared(places: tuple[Path, Path], *more: str) -> Path:
    return prepare_case(only_case(places, *more), places[1]).folder


def refusal(places: tuple[Path, Path], *more: str) -> CaseRejected:
    with pytest.raises(CaseRejected, match="E-BID-") as caught:
        prepared(places, *more)
    return caught.value


def ids(places: tuple[Path, Path], *more: str) -> list[str]:
    return [case.case_id for case in bids_cases(call_of(places, *more))]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("in out participant", True),
        ("in out group --jobs 2", True),
        ("in out session", False),
        ("compare A group", False),
        ("--cases out group", False),
        ("in out", False),
        ("", False),
    ],
)
def test_what_is_a_bids_call(line: str, expected: bool) -> None:  # noqa: FBT001
    assert is_bids_call(line.split(), {"run", "compare"}) is expected


def test_what_a_call_says(places: tuple[Path, Path]) -> None:
    call = call_of(
        places,
        *("--participant-label", "01", "sub-02", "sub-01", "--session_label", "ses-pre", "--set", "sweep.seed=1"),
        *("--set", "qa.x=2", "--protocol", "demo", "--n_cpus", "2", "--mem_mb", "900"),
        *("--time-limit-min", "1.5", "--skip_bids_validator"),
    )
    assert (call.dataset, call.out, call.level) == (*places, "participant")
    assert (call.labels, call.sessions, call.overrides) == (("01", "02"), ("pre",), ("sweep.seed=1", "qa.x=2"))
    assert (call.protocol, call.jobs, call.memory_mb, call.time_limit_min) == ("demo", 2, 900, 1.5)
    assert "changes nothing" in call.notes[0]
    assert parse_bids_call([*map(str, places), "group"]) == BidsCall(*places, "group")


def test_help_and_version_are_asked_for_and_not_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert parse_bids_call(["in", "in", "participant", "--help"]).show == "help"
    assert parse_bids_call(["in", "in", "participant", "--version"]).show == "version"
    assert "--participant-label" in bids_help()
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    "options",
    ["--participants 01", "--jobs -1", "--jobs x", "--time-limit-min nan", "--participant-label ../01", "extra"],
)
def test_a_call_that_cannot_be_understood(places: tuple[Path, Path], options: str) -> None:
    with pytest.raises(ConfigError, match="E-BID-01"):
        call_of(places, *options.split())


def test_the_dataset_is_never_the_place_of_results(tmp_path: Path) -> None:
    dataset = empty_dataset(tmp_path / "in", CT)
    for out in (".", "results", "derivatives", "sub-01"):
        with pytest.raises(ConfigError, match="E-BID-04"):
            call_of((dataset, dataset / out))
    ours = call_of((dataset, dataset / "derivatives" / "ct2lut"))
    put(ours.out, "sub-01/anat/sub-01_dseg.nii.gz")
    (case,) = bids_cases(ours)
    assert (len(case.ct), case.dseg) == (1, ())


def test_cases_are_subjects_sessions_and_sides(places: tuple[Path, Path]) -> None:
    empty_dataset(
        places[0],
        CT,
        "sub-02/ses-a/ct/sub-02_ses-a_ct.nii.gz",
        "sub-02/ses-b/anat/sub-02_ses-b_T1w.nii.gz",
        "sub-03/ct/sub-03_ct.nii",
        "derivatives/manual/sub-03/anat/sub-03_hemi-L_dseg.nii.gz",
        "derivatives/manual/sub-03/anat/sub-03_hemi-R_dseg.nii.gz",
        "derivatives/manual/sub-04/anat/sub-04_dseg.nii.gz",
        "derivatives/sub-05/sub-05_hemi-R_dseg.nii",
        "sourcedata/sub-06/ct/sub-06_ct.nii.gz",
    )
    every = ["sub-01", "sub-02_ses-a", "sub-02_ses-b", "sub-03_hemi-L", "sub-03_hemi-R", "sub-04", "sub-05_hemi-R"]
    assert ids(places) == every
    assert ids(places, "--participant-label", "03", "sub-01") == ["sub-03_hemi-L", "sub-03_hemi-R", "sub-01"]
    assert ids(places, "--session-label", "b") == ["sub-02_ses-b"]
    left, right = bids_cases(call_of(places, "--participant-label", "03"))
    assert left.ct == right.ct
    assert [file.name for file in left.dseg] == ["derivatives/manual/sub-03/anat/sub-03_hemi-L_dseg.nii.gz"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--participant-label 1", r"E-BID-03 The dataset has no subject 1.*; it has 01, 02\."),
        ("--session-label pre", r"E-BID-03 The dataset has no session pre; it has none\."),
    ],
)
def test_unknown_labels_name_the_known_ones(places: tuple[Path, Path], options: str, message: str) -> None:
    empty_dataset(places[0], CT, "sub-02/ct/sub-02_ct.nii.gz")
    with pytest.raises(ConfigError, match=message):
        bids_cases(call_of(places, *options.split()))


def test_what_is_no_dataset(places: tuple[Path, Path]) -> None:
    with pytest.raises(ConfigError, match="E-BID-02 The dataset is no folder"):
        bids_cases(call_of(places))
    empty_dataset(places[0], "code/sub-01.txt")
    with pytest.raises(ConfigError, match="E-BID-02 The dataset holds no folder of a subject"):
        bids_cases(call_of(places))
    empty_dataset(places[0], CT)
    put(places[0], "participants.tsv", "participant_id\tside\nsub-01\tL\textra\n")
    with pytest.raises(ConfigError, match=r"E-BID-02 participants\.tsv cannot be read: a line has more cells"):
        bids_cases(call_of(places))


def test_labels_of_which_no_id_can_be_made(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], "sub-a1/ct/sub-a1_ct.nii.gz", "sub-A1/ct/sub-A1_ct.nii.gz")
    with pytest.raises(ConfigError, match="E-BID-05 sub-A1 and sub-a1 differ only in upper and lower case"):
        bids_cases(call_of(places))
    (places[0] / "sub-A1").rename(places[0] / f"sub-{'z' * 61}")
    with pytest.raises(ConfigError, match='E-BID-05 "sub-zzz'):
        bids_cases(call_of(places))


def test_a_real_knee_in_bids_is_read_as_a_case(places: tuple[Path, Path]) -> None:
    spec = phantom_dataset(places[0], "01", PhantomSpec(side="left", spacing_mm=(2.0, 2.0, 2.0)), ct=True)
    before = {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in places[0].rglob("*")}
    folder = prepared(places)
    assert {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in places[0].rglob("*")} == before
    source = list_source("sub-01", folder)
    files = choose_files(source.files)
    declaration = read_declaration(folder)
    assert sorted(source.files) == ["case.yaml", "ct.nii.gz", "labels.nii.gz"]
    assert (files.ct, files.label_map) == (("ct.nii.gz",), "labels.nii.gz")
    assert (declaration.side, declaration.labels) == (spec.side, PHANTOM_LABELS)
    labels = read_label_map(source.read("labels.nii.gz"), "labels.nii.gz")
    scan = read_ct_volume(source.read("ct.nii.gz"), "ct.nii.gz")
    assert all(labels.counts[value] for value in PHANTOM_LABELS.values())
    assert all(big >= small for big, small in zip(scan.volume.values.shape, labels.volume.values.shape, strict=True))


def test_what_is_prepared_stays_until_the_dataset_changes(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], CT, DSEG)
    table = put(places[0], TABLE, lookup())
    folder = prepared(places)
    before = {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}
    assert (folder / "ct.nii.gz").samefile(places[0] / CT)
    assert prepared(places) == folder
    assert {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()} == before
    (places[0] / CT).unlink()
    put(places[0], CT.removesuffix(".gz"), "another scan")
    put(folder, f".ct.nii.gz.partial-{'0' * 32}", "left by a killed run")
    table.write_text(lookup({"femur": 2, "tibia": 1}))
    assert prepared(places) == folder
    assert sorted(path.name for path in folder.iterdir()) == ["case.yaml", "ct.nii", "labels.nii.gz"]
    assert (folder / "ct.nii").read_text() == "another scan"
    assert read_declaration(folder).labels == {"femur": 2, "tibia": 1}


def test_what_cannot_be_linked_is_copied_once(places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(18, "another disk")

    monkeypatch.setattr(os, "link", refuse)
    empty_dataset(places[0], CT)
    copy = prepared(places) / "ct.nii.gz"
    first = copy.stat()
    assert copy.read_bytes() == (places[0] / CT).read_bytes()
    assert not copy.samefile(places[0] / CT)
    assert first.st_mode & 0o777 == 0o640
    assert (prepared(places) / "ct.nii.gz").stat().st_ino == first.st_ino
    put(places[0], CT, "corrected")
    assert (prepared(places) / "ct.nii.gz").read_text() == "corrected"


def test_a_folder_that_is_killed_on_the_way_has_no_side(
    places: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    empty_dataset(places[0], CT, "sub-01/anat/sub-01_hemi-L_seg-mskt_dseg.nii.gz")
    folder = prepared(places)
    assert read_declaration(folder).side == "left"
    put(places[0], CT, "another scan, longer")
    (places[0] / CT).rename(places[0] / "moved")
    put(places[0], CT, "a third one")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt("killed")

    monkeypatch.setattr(bids, "_put", killed)
    with pytest.raises(KeyboardInterrupt, match="killed"):
        prepared(places)
    assert read_declaration(folder).side is None
    monkeypatch.undo()
    assert read_declaration(prepared(places)).side == "left"
    assert (folder / "ct.nii.gz").read_text() == "a third one"


@pytest.mark.parametrize(
    ("name", "content", "side"),
    [
        ("sub-01/ct/sub-01_ct.json", '{"Laterality": "L"}', "left"),
        ("ct.json", '{"ImageLaterality": "right"}', "right"),
        ("sub-01/sub-01_ct.json", '{"Laterality": "B", "ImageLaterality": null}', None),
        ("acq-bone_ct.json", '{"Laterality": "L"}', None),
        ("participants.tsv", "participant_id\tside\nsub-01\tLEFT\nsub-02\tR\n", "left"),
        ("participants.tsv", "\ufeffparticipant_id\tage\tside\r\nsub-01\t40\tn/a\r\n", None),
        ("participants.tsv", "participant_id\tage\nsub-01\t40\n", None),
        ("README", "left", None),
    ],
)
def test_who_says_the_side(places: tuple[Path, Path], name: str, content: str, side: str | None) -> None:
    empty_dataset(places[0], CT)
    put(places[0], name, content)
    assert read_declaration(prepared(places)).side == side


def test_the_nearest_sidecar_counts(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], CT)
    put(places[0], "ct.json", '{"Laterality": "L"}')
    put(places[0], "sub-01/ct/sub-01_ct.json", '{"Laterality": "R"}')
    assert read_declaration(prepared(places)).side == "right"


def test_the_table_of_sessions_says_the_side(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], "sub-01/ses-a/ct/sub-01_ses-a_ct.nii.gz", "sub-01/ses-b/ct/sub-01_ses-b_ct.nii.gz")
    put(places[0], "sub-01/sub-01_sessions.tsv", "session_id\tside\nses-a\tL\nses-b\tR\n")
    folders = [prepare_case(case, places[1]).folder for case in bids_cases(call_of(places))]
    assert [read_declaration(folder).side for folder in folders] == ["left", "right"]


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("participants.tsv", "participant_id\tside\nsub-01\tR\n", "says left, and participants.tsv says right"),
        ("sub-01/ct/sub-01_ct.json", '{"Laterality": "R"}', "says left, and Laterality of sub-01/ct/sub-01_ct.json"),
        ("ct.json", '{"Laterality": "LR"}', 'Laterality of ct.json names the side "LR"; expected L or R.'),
        ("ct.json", '{"Laterality": 1}', "names the side 1; expected L or R."),
    ],
)
def test_sides_that_contradict_are_refused(places: tuple[Path, Path], name: str, content: str, problem: str) -> None:
    empty_dataset(places[0], "sub-01/ct/sub-01_hemi-L_ct.nii.gz")
    put(places[0], name, content)
    error = refusal(places)
    assert error.code == "E-BID-13"
    assert problem in error.problem


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("Femur", "femur"),
        ("distal femur", "femur"),
        ("Tibial bone", "tibia"),
        ("Left Femur", "femur_left"),
        ("femur_right", "femur_right"),
        ("FemoralCartilage", "femoral_cartilage"),
        ("cartilage (patella)", "patellar_cartilage"),
        ("medial tibial cartilage", "medial_tibial_cartilage"),
        ("Meniscus, lateral, right", "lateral_meniscus_right"),
        ("tibial cartilage", "tibial_cartilage"),
        ("femoral component", "femoral_component"),
        ("femoral", "femoral"),
        ("Femur L", "femur_l"),
        ("left right femur", "left_right_femur"),
    ],
)
def test_spellings_of_structures(text: str, name: str) -> None:
    assert structure_name(text) == name


def test_the_nearest_look_up_table_counts_and_others_names_are_passed_on(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], DSEG)
    put(places[0], TABLE, lookup({"femur": 9}))
    near = {"Femur": 1, "Tibia": 2, "Screw": 3, "3rd thing": 4}
    put(places[0], "derivatives/manual/sub-01/anat/sub-01_dseg.tsv", lookup(near))
    put(places[0], "dseg.tsv", lookup({"femur": 8}))
    assert read_declaration(prepared(places)).labels == {"femur": 1, "tibia": 2, "screw": 3}


@pytest.mark.parametrize(("entity", "scheme"), [("seg-mskt", "mskt"), ("desc-TotalSegmentatorTotal", None)])
def test_a_scheme_of_ours_by_name(places: tuple[Path, Path], entity: str, scheme: str | None) -> None:
    empty_dataset(places[0], f"sub-01/anat/sub-01_{entity}_dseg.nii")
    assert read_declaration(prepared(places)).labels == label_preset(scheme or "totalsegmentator_total")


@pytest.mark.parametrize(
    ("files", "code", "problem"),
    [
        ({}, "E-BID-11", "holds neither a CT nor a segmentation of sub-01."),
        ({CT: "", "sub-01/ct/sub-01_run-2_ct.nii.gz": ""}, "E-BID-12", f"{CT}, sub-01/ct/sub-01_run-2_ct.nii.gz"),
        ({DSEG: "", "derivatives/net/sub-01/sub-01_dseg.nii.gz": ""}, "E-BID-12", "derivatives/net/sub-01/sub-01_dseg"),
        ({DSEG: ""}, "E-BID-14", "there is no look-up table"),
        ({DSEG.replace("_dseg", "_seg-mskt_desc-phantom_dseg"): ""}, "E-BID-14", "different label schemes"),
        ({DSEG: "", TABLE: "label\tname\n1\tfemur\n"}, "E-BID-17", "expected index and name among them"),
        ({DSEG: "", TABLE: "index\tname\n1.0\tfemur\n"}, "E-BID-17", "is no label"),
        ({DSEG: "", TABLE: "index\tname\n1\tfemur\n2\tdistal femur\n"}, "E-BID-17", "labels 1 and 2 are both femur"),
        ({DSEG: "", TABLE: "index\tname\n1\tfemur\n1\ttibia\n"}, "E-BID-17", "label 1 is both"),
        ({DSEG: "", TABLE: "index,name\n1,femur\n"}, "E-BID-17", "its columns are"),
        ({DSEG: "", TABLE: "index\tname\n0\tbackground\n"}, "E-BID-17", "it names no structure"),
        ({DSEG: "", TABLE: "", "derivatives/manual/desc-x_dseg.tsv": ""}, "E-BID-17", "dseg.tsv cannot be used"),
        ({"sub-01/ct/sub-02_ct.nii.gz": ""}, "E-BID-15", "is not named as one of them"),
        ({"sub-01/ct/sub-01_ses-a_ct.nii.gz": ""}, "E-BID-15", "is not named as one of them"),
        ({"sub-01/ct/sub-01_bone_window_ct.nii.gz": ""}, "E-BID-15", "is not named as one of them"),
        ({CT: "", "ct.json": "[" * 100_000}, "E-BID-17", "ct.json cannot be used"),
    ],
)
def test_what_is_refused(places: tuple[Path, Path], files: dict[str, str], code: str, problem: str) -> None:
    empty_dataset(places[0], "sub-01/anat/sub-01_T1w.nii.gz")
    for name, content in files.items():
        put(places[0], name, content)
    error = refusal(places)
    assert (error.code, problem in error.problem) == (code, True), error
    assert str(places[0]) not in str(error)
    assert not (places[1] / ".cases" / "sub-01").exists()


def test_a_refusal_removes_what_was_prepared_before(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], CT)
    folder = prepared(places)
    put(places[0], "sub-01/ct/sub-01_acq-bone_ct.nii.gz")
    assert refusal(places).code == "E-BID-12"
    assert not folder.exists()
    assert (places[0] / CT).read_text() == "image"


def test_one_of_several_files_is_chosen_by_its_entities(places: tuple[Path, Path]) -> None:
    empty_dataset(places[0], CT, "sub-01/ct/sub-01_acq-bone_run-02_ct.nii.gz", DSEG)
    put(places[0], "derivatives/net/sub-01/sub-01_seg-mskt_dseg.nii.gz")
    wanted = {"ct": {"acquisition": "bone", "run": 2}, "dseg": {"pipeline": "net", "desc": None}}
    chosen = put(places[0].parent, "filter.json", json.dumps(wanted))
    case = only_case(places, "--bids-filter-file", str(chosen))
    assert [file.name for file in case.ct] == ["sub-01/ct/sub-01_acq-bone_run-02_ct.nii.gz"]
    assert [file.name for file in case.dseg] == ["derivatives/net/sub-01/sub-01_seg-mskt_dseg.nii.gz"]
    chosen.write_text('{"ct": {"acq": null}}')
    assert [file.name for file in only_case(places, "--bids-filter-file", str(chosen)).ct] == [CT]


@pytest.mark.parametrize("text", ['{"t1w": {}}', '{"ct": 1}', '{"ct": {"run": [1]}}', "{", ""])
def test_a_filter_that_cannot_be_used(places: tuple[Path, Path], text: str) -> None:
    chosen = put(places[0].parent, "filter.json", text)
    with pytest.raises(ConfigError, match="E-BID-06 The filter file cannot be used"):
        call_of(places, "--bids-filter-file", str(chosen))


def test_content_kept_elsewhere_in_the_dataset_is_found(places: tuple[Path, Path]) -> None:
    dataset = empty_dataset(places[0])
    content = put(dataset, ".git/annex/objects/X1/content", "scan")
    (dataset / CT).parent.mkdir(parents=True)
    (dataset / CT).symlink_to("../../.git/annex/objects/X1/content")
    assert (prepared(places) / "ct.nii.gz").read_text() == "scan"
    content.unlink()
    assert "is a link to content that is not there" in refusal(places).problem


def test_a_link_out_of_the_dataset_is_not_followed(places: tuple[Path, Path]) -> None:
    dataset = empty_dataset(places[0])
    secret = put(places[0].parent, "secret", "secret")
    (dataset / CT).parent.mkdir(parents=True)
    (dataset / CT).symlink_to(secret)
    assert refusal(places).code == "E-BID-16"
    (dataset / CT).unlink()
    put(dataset, CT)
    (dataset / "ct.json").symlink_to(secret)
    assert re.match(r"ct.json leads out of the dataset", refusal(places).problem)


def test_a_loop_of_links_ends(places: tuple[Path, Path]) -> None:
    dataset = empty_dataset(places[0], CT)
    (dataset / "sub-01" / "ct" / "again").symlink_to(dataset / "sub-01")
    assert {file.base for file in only_case(places).ct} == {"sub-01_ct.nii.gz"}


def test_the_output_is_a_derivative(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_dataset_files(out)
    description = json.loads((out / "dataset_description.json").read_text())
    assert (description["DatasetType"], description["GeneratedBy"][0]["Name"]) == ("derivative", "ct2lut")
    (out / ".bidsignore").write_text("/mine\n")
    (out / "README.md").write_text("mine")
    write_dataset_files(out)
    lines = (out / ".bidsignore").read_text().splitlines()
    assert (lines[0], len(lines), len(set(lines))) == ("/mine", 8, 8)
    assert (out / "README.md").read_text() == "mine"


@pytest.mark.parametrize("text", ['{"Name": "Knees"}', '{"GeneratedBy": [{"Name": "fMRIPrep"}]}', "{"])
def test_a_dataset_of_something_else_is_not_written_to(tmp_path: Path, text: str) -> None:
    put(tmp_path, "dataset_description.json", text)
    with pytest.raises(ConfigError, match="E-BID-04 The output folder is a dataset that ct2lut did not make"):
        write_dataset_files(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset_description.json"]
