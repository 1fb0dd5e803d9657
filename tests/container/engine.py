"""Buildah and podman, used as root without a daemon, and the base image that stands in for one of a registry."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
PROGRAMS = ("buildah", "podman", "runc", "debootstrap", "apt-get")
#: Set by `make test-container`: a build takes minutes, the network and 5 GB.
WANTED = "CT2LUT_TEST_CONTAINER"
IMAGE = "localhost/ct2lut-test"
BASE = "localhost/ct2lut-test-base:bookworm"
SUITE = "bookworm"
#: Folder of the base with the certificates of this machine.
STAND_IN = "/etc/stand-in"
#: Neither root nor the user of the image, and in no password file.
USER = 12345
PROXY = re.compile(r'Acquire::https?::Proxy "')
BUILD_SECONDS = 3600
RUN_SECONDS = 1800
#: Works where control groups are of two versions at once.
PODMAN = ("podman", "--runtime=runc", "--cgroup-manager=cgroupfs")
#: What a careful site takes away; the limits are named because raising them is a right that a machine may lack.
SEALED = (
    "--read-only",
    "--read-only-tmpfs=false",
    "--tmpfs=/tmp",
    "--network=none",
    "--cap-drop=all",
    "--security-opt=no-new-privileges",
    f"--user={USER}:{USER}",
    "--passwd=false",
    "--unsetenv=HOME",
    "--ulimit=nofile=1024:1024",
    "--ulimit=nproc=4096:4096",
)


def obstacle() -> str | None:
    """Why no image can be built here, or None."""
    if not os.environ.get(WANTED):
        return "the image takes minutes and the network: type make test-container"
    if os.geteuid() != 0:
        return "building an image without a daemon needs root: type sudo make test-container"
    missing = [name for name in PROGRAMS if shutil.which(name) is None]
    return f"{' '.join(missing)} missing: type make test-container" if missing else None


@dataclass(frozen=True)
class Answer:
    """How a program ended and what it said, both streams in one."""

    code: int
    text: str


def say(*command: str, seconds: float = RUN_SECONDS) -> Answer:
    """Run a program to its end."""
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=seconds, check=False, cwd=CHECKOUT
    )
    return Answer(done.returncode, done.stdout)


def must(*command: str, seconds: float = RUN_SECONDS) -> str:
    """What a program says; an AssertionError with its last words where it fails."""
    answer = say(*command, seconds=seconds)
    assert answer.code == 0, f"{' '.join(command[:3])}: exit code {answer.code}\n{answer.text[-3000:]}"
    return answer.text


def build(folder: Path) -> str:
    """Build the image of the Dockerfile, on a stand-in base that is made in ``folder`` where there is none yet."""
    if say("buildah", "inspect", "--type=image", BASE).code != 0:
        _make_base(folder / "root")
    # chroot: needs no cgroups of its own; docker: the other format drops the health check
    options = ("--isolation=chroot", "--pull-never", "--layers", "--format=docker", f"--build-arg=BASE={BASE}")
    must("buildah", "bud", *options, f"--tag={IMAGE}", ".", seconds=BUILD_SECONDS)
    return IMAGE


def sealed(*words: str, options: tuple[str, ...] = ()) -> Answer:
    """Run the image with nothing but what it needs.

    Parameters
    ----------
    *words : str
        For its entry point.
    options : tuple of str
        For podman, beside ``SEALED``: mounts, another entry point.
    """
    engine = (
        "podman",
        "--runtime=runc",
        "--cgroup-manager=cgroupfs",
        "run",
        "--rm",
        "--pull=never",
        "--no-healthcheck",
    )
    return say(*engine, *SEALED, *options, IMAGE, *words)


def _make_base(root: Path) -> None:
    """A minimal Debian from the mirror of this machine; how to reach the network from here goes into it alone."""
    mirror = must("apt-get", "indextargets", "--format", "$(SITE)", f"Codename: {SUITE}", "Component: main").split()[0]
    must("debootstrap", "--variant=minbase", SUITE, str(root), mirror, seconds=BUILD_SECONDS)
    must("chroot", str(root), "apt-get", "clean")
    _let_reach_the_network(root)
    container = must("buildah", "from", "scratch").strip()
    try:
        must("buildah", "add", "--quiet", container, str(root), "/")
        must("buildah", "commit", "--quiet", "--format=docker", container, BASE)
    finally:
        must("buildah", "rm", container)
    shutil.rmtree(root)


def _let_reach_the_network(root: Path) -> None:
    """Certificates of this machine for pip and apt, and the proxies of its apt."""
    bundle = Path(os.environ.get("SSL_CERT_FILE", "/etc/ssl/certs/ca-certificates.crt"))
    settings = [line for line in must("apt-config", "dump", "Acquire").splitlines() if PROXY.match(line)]
    if bundle.is_file():
        (root / STAND_IN[1:]).mkdir()
        shutil.copy(bundle, root / STAND_IN[1:] / "ca.pem")
        (root / "etc/pip.conf").write_text(f"[global]\ncert = {STAND_IN}/ca.pem\n")
        settings.append(f'Acquire::https::CaInfo "{STAND_IN}/ca.pem";')
    (root / "etc/apt/apt.conf.d/99stand-in").write_text("".join(f"{line}\n" for line in settings))
