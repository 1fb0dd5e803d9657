"""The image is built from the Dockerfile, and a patient runs in it as anybody, on a read-only root, without network."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from pipeline import __version__
from tests.container import engine
from tests.container.engine import CHECKOUT, STAND_IN, USER, build, must, sealed

WHY_NOT = engine.obstacle()
pytestmark = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))

OUTSIDE = str(Path(sys.executable).with_name("ct2lut"))
RUN = ("run", "demo", "--protocol", "demo", "--jobs", "2")
#: A run in the container, then what was compiled on the way: that could lie in /tmp alone.
RUN_AND_LOOK = 'ct2lut "$@"; code=$?; find /tmp /results -name "*.nb[ic]"; exit $code'
#: What a program in the container finds, one JSON object.
LOOK = """
import json, os, pathlib, socket
def writable(folder):
    try:
        pathlib.Path(folder, "x").write_text("x")
    except OSError:
        return False
    return True
status = dict(line.split(":", 1) for line in pathlib.Path("/proc/self/status").read_text().splitlines())
print(json.dumps({
    "ids": [os.getuid(), os.getgid()],
    "home": writable(os.path.expanduser("~")),
    "written": [f for f in ("/", "/opt/ct2lut", "/data", "/var/tmp", "/dev/shm", "/tmp") if writable(f)],
    "network": [name for _, name in socket.if_nameindex()],
    "rights": int(status["CapEff"], 16) | int(status["CapBnd"], 16),
}))
"""


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    return build(tmp_path_factory.mktemp("base"))


@pytest.fixture(scope="module")
def site(image: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cases that nobody may write to, with a CT; an empty folder of results that belongs to the user."""
    folder = tmp_path_factory.mktemp("site")
    must(OUTSIDE, "phantom", str(folder / "cases"), "--id", "demo", "--ct")
    must("chmod", "-R", "a+rX", str(folder / "cases"))
    (folder / "results").mkdir()
    os.chown(folder / "results", USER, USER)
    return folder


@pytest.fixture(scope="module")
def patient(site: Path) -> Path:
    """The results of a case that ran in the container."""
    mounts = (f"--volume={site}/cases:/cases:ro", f"--volume={site}/results:/results", "--entrypoint=/bin/sh")
    words = ("-c", RUN_AND_LOOK, "ct2lut", *RUN, "--cases", "/cases", "--results", "/results")
    answer = sealed(*words, options=mounts)
    assert answer.code == 0, answer.text
    assert "PASS   demo" in answer.text.splitlines()
    assert ".nb" not in answer.text, "kernels were compiled while a patient waited"
    return site / "results" / "demo"


def configuration(image: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(must("buildah", "inspect", "--type=image", image))["Docker"]["config"]
    return document


def test_it_starts_as_the_version_of_this_checkout(image: str) -> None:
    assert sealed("--version") == engine.Answer(0, f"ct2lut {__version__}\n")


def test_what_is_written_on_it(image: str) -> None:
    config = configuration(image)
    assert config["User"] == "65532:65532"
    assert config["Healthcheck"]["Test"] == ["CMD", "ct2lut", "--version"]
    assert config["Labels"]["org.opencontainers.image.version"] == __version__
    assert config["Labels"]["org.opencontainers.image.base.name"] == engine.BASE


def test_the_seal_holds(image: str) -> None:
    """The test's own conditions: otherwise what follows would say little."""
    answer = sealed("-c", LOOK, options=("--entrypoint=/opt/ct2lut/bin/python",))
    assert json.loads(answer.text) == {
        "ids": [USER, USER],
        "home": False,
        "written": ["/dev/shm", "/tmp"],
        "network": ["lo"],
        "rights": 0,
    }


def test_the_package_is_whole(patient: Path) -> None:
    """Every file of the manifest with its checksum, the pages among them, and the verdict's word."""
    package = patient / "90_package"
    manifest = json.loads((package / "manifest.json").read_text())
    recorded = manifest["files"]
    for name, fact in recorded.items():
        assert hashlib.sha256((package / name).read_bytes()).hexdigest() == fact["sha256"], name
    assert {"lut.h5", "lut.json", "knee.glb", "report.html", "report.pdf"} <= set(recorded)
    assert (package / "report.pdf").read_bytes().startswith(b"%PDF-")
    assert manifest["verdict"] == {"word": "PASS", "reasons": []}
    assert json.loads((patient / "run.json").read_text())["outcome"]["word"] == "PASS"
    assert (patient / "report.html").stat().st_size > (package / "report.html").stat().st_size // 2


def test_every_file_belongs_to_the_user(patient: Path) -> None:
    owners = {(path.lstat().st_uid, path.lstat().st_gid) for path in [patient, *patient.rglob("*")]}
    assert owners == {(USER, USER)}


def test_the_table_is_the_one_of_this_machine(patient: Path, site: Path, tmp_path: Path) -> None:
    """Debian's Python and code for any processor give the numbers of the checkout's own environment."""
    folders = ("--cases", str(site / "cases"), "--results", str(tmp_path))
    must(OUTSIDE, *RUN, *folders)
    inside, outside = arrays(patient), arrays(tmp_path / "demo")
    assert inside.keys() == outside.keys()
    assert {"lut/moved_from_scan", "lut/internal_rotation_deg", "neutral/neutral_varus_deg"} <= inside.keys()
    for name, value in inside.items():
        np.testing.assert_allclose(value, outside[name], rtol=0, atol=1e-9, err_msg=name)


def arrays(case: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Every number of a table by its name in the file."""
    found = {}
    with h5py.File(case / "90_package" / "lut.h5") as file:

        def keep(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu":
                found[name] = item[()]

        file.visititems(keep)
    return found


def test_compiling_while_a_patient_waits_would_be_noticed(patient: Path, site: Path, tmp_path: Path) -> None:
    """For another processor the shipped code does not fit; new code has nowhere to go, and the run says so."""
    shutil.copytree(patient, tmp_path / "demo")
    must("chown", "-R", f"{USER}:{USER}", str(tmp_path))
    mounts = (f"--volume={site}/cases:/cases:ro", f"--volume={tmp_path}:/results", "--env=NUMBA_CPU_NAME=skylake")
    coarser = ("--set", "sweep.flexion_step_deg=20", "--cases", "/cases", "--results", "/results")
    answer = sealed(*RUN, *coarser, options=mounts)
    assert answer.code == 30, answer.text
    assert "read-only (EROFS)" in answer.text


def test_the_bill_of_materials_names_what_is_inside(image: str) -> None:
    listed = sealed("/opt/ct2lut/share/sbom.json", options=("--entrypoint=/bin/cat",)).text
    urls = {component["purl"].partition("?")[0] for component in json.loads(listed)["components"]}
    locks = [(CHECKOUT / name).read_text() for name in ("requirements.lock", "requirements-cohort.lock")]
    pins = [pin for lock in locks for pin in re.findall(r"^([a-z0-9-]+)==([^ ]+)(?= \\$)", lock, re.MULTILINE)]
    built_with = {"cython", "pip", "setuptools", "wheel"}
    assert {f"pkg:pypi/{name}@{version}" for name, version in pins if name not in built_with} <= urls
    assert not [url for url in urls for name in built_with if url.startswith(f"pkg:pypi/{name}@")]
    assert any(url.startswith("pkg:deb/debian/libgl1-mesa-dri@") for url in urls)


def test_a_cohort_runs_in_it(patient: Path, site: Path, tmp_path: Path) -> None:
    """The engine is inside: a case that is known and one that is refused, by the same seal; the table lists both."""
    shutil.copytree(site / "cases", tmp_path / "cases")
    shutil.copytree(patient, tmp_path / "results" / "demo")
    (tmp_path / "cases" / "empty").mkdir()
    must("chown", "-R", f"{USER}:{USER}", str(tmp_path))
    tmp_path.chmod(0o755)
    mounts = (f"--volume={tmp_path}/cases:/cases:ro", f"--volume={tmp_path}/results:/results")
    answer = sealed("cohort", "--cases", "/cases", "--results", "/results", "--protocol", "demo", options=mounts)
    assert answer.code == 10, answer.text
    table = (tmp_path / "results" / "cohort.csv").read_text(encoding="utf-8-sig").splitlines()
    assert [line.split(",")[:3] for line in table[1:]] == [["demo", "PASS", ""], ["empty", "REJECTED", "E-IO-03"]]


def test_the_doctor_finds_it_ready(patient: Path, site: Path) -> None:
    answer = sealed("doctor", "--results", "/results", options=(f"--volume={site}/results:/results",))
    assert answer.code == 0, answer.text
    assert "FAIL" not in answer.text
    assert re.search(r"^cohorts +ok +snakemake [\d.]+ \(ct2lut-cohort\)$", answer.text, re.MULTILINE), answer.text


def test_nothing_of_this_machine_is_in_what_the_dockerfile_adds(image: str) -> None:
    """How the network is reached from here comes with the stand-in base and with nothing else."""
    found = sealed("-rlsF", STAND_IN, "/etc", "/opt", "/usr", "/var", options=("--entrypoint=/bin/grep",))
    assert set(found.text.splitlines()) <= {"/etc/pip.conf", "/etc/apt/apt.conf.d/99stand-in"}
