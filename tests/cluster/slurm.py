"""A real SLURM on this machine for as long as a test needs it: one node, loopback only, no database, no systemd.

SLURM looks for its configuration in one place, and the workflow engine takes away the variable that names another.
So it lies in /etc/slurm as long as the cluster stands, and goes with it.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

#: Set by `make test-cluster`.
WANTED = "CT2LUT_TEST_CLUSTER"
PROGRAMS = ("slurmctld", "slurmd", "sbatch", "squeue", "sinfo", "scancel", "scontrol", "munged", "munge")
CONFIGURATION = Path("/etc/slurm/slurm.conf")
MARK = "# test cluster of ct2lut"
HOSTS = Path("/etc/hosts")
MUNGE_FOLDER = Path("/run/munge")
#: After this time without a word of its daemon a node is down, and what ran on it starts again.
NODE_TIMEOUT_S = 6
#: Ten times as long, as it is only looked at now and then.
NODE_SECONDS = 120.0
START_SECONDS = 60.0
#: Two partitions, so that a site's choice can be seen.
TEMPLATE = """{mark} of process {process} in {folder}
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CryptoType=crypto/munge
MpiDefault=none
SwitchType=switch/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
DefMemPerCPU=512
SchedulerParameters=batch_sched_delay=1,sched_interval=2,bf_interval=2
MinJobAge=3600
ReturnToService=2
SlurmdTimeout={node_timeout}
KillWait=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
NodeName={host} NodeAddr=127.0.0.1 CPUs={processors} RealMemory={memory_mb} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
PartitionName=knees Nodes=ALL Default=NO MaxTime=INFINITE State=UP
"""


def obstacle() -> str | None:
    """Why no cluster can be started here, or None."""
    if not os.environ.get(WANTED):
        return "a cluster is started on this machine: type make test-cluster"
    if os.geteuid() != 0:
        return "the daemons of SLURM need root: type sudo make test-cluster"
    missing = [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]
    if missing:
        return f"{' '.join(missing)} missing: type make test-cluster"
    if CONFIGURATION.exists() and not _is_left_over():
        return f"{CONFIGURATION} is there already: this machine has a SLURM of its own, or another test is at work"
    return None


@dataclass(frozen=True)
class Cluster:
    """The cluster that runs, its files in ``folder``."""

    folder: Path

    def start_node(self) -> None:
        """Start the daemon of the node and wait until the node can take a job."""
        _say("slurmd", "-f", str(CONFIGURATION))
        self.wait_for_node("idle", "mixed", "allocated")

    def lose_node(self) -> None:
        """Kill the daemon of the node and all that runs on it, as a power cut would; wait until SLURM has noticed."""
        tree = [pid for job in _pids_of("slurmstepd") for pid in (job, *_descendants(job))]
        self.kill_node_daemon()
        for pid in tree:
            _kill(pid, signal.SIGKILL)
        self.wait_for_node("down", "down*")

    def kill_node_daemon(self) -> None:
        """Kill the daemon of the node alone; its jobs know nothing of it."""
        pid = int((self.folder / "slurmd.pid").read_text())
        _kill(pid, signal.SIGKILL)
        _wait(lambda: not _alive(pid), "the daemon of the node is gone")

    def wait_for_node(self, *states: str) -> None:
        """Wait until the node is in one of some states, as ``sinfo`` calls them."""
        asked = ("sinfo", "-h", "-o", "%T", "-p", "main")
        _wait(lambda: _say(*asked).strip() in states, f"the node is {' or '.join(states)}", NODE_SECONDS)

    def jobs(self) -> dict[str, str]:
        """State of every job, running and past, by its number."""
        rows = _say("squeue", "-h", "-a", "-t", "all", "-o", "%i %T").split("\n")
        return dict(row.split() for row in rows if row)

    def partition(self, job: str) -> str:
        """Where a job runs or ran."""
        return _say("squeue", "-h", "-t", "all", "-j", job, "-o", "%P").strip()

    def mend(self) -> None:
        """Start the daemon of the node again where a test has left it dead."""
        if not _alive(int((self.folder / "slurmd.pid").read_text())):
            self.start_node()

    def memory_mb(self, job: str) -> int:
        """What a job asked for."""
        return int(self._facts(job)["MinMemoryNode"].removesuffix("M"))

    def starts(self, job: str) -> int:
        """How often SLURM has started a job again."""
        return int(self._facts(job)["Restarts"])

    def waiting(self) -> list[str]:
        """Jobs that wait or run."""
        return _say("squeue", "-h", "-o", "%i").split()

    def cancel(self, *jobs: str) -> None:
        """End jobs, as anybody may."""
        _say("scancel", *jobs)

    def forget(self) -> None:
        """Cancel what is left of a test."""
        if left := self.waiting():
            self.cancel(*left)
        _wait(lambda: not self.waiting(), "no job is left")

    def _facts(self, job: str) -> dict[str, str]:
        return dict(word.split("=", 1) for word in _say("scontrol", "show", "job", job).split() if "=" in word)


@contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    """A cluster with an idle node; all that was started or made is stopped and removed at the end, whatever happens."""
    if CONFIGURATION.exists():
        _clean_left_over()
    with ExitStack() as stack:
        stack.enter_context(_named())
        stack.enter_context(_configured(folder))
        stack.enter_context(_munge())
        stack.callback(_stop, folder / "slurmd.pid")
        stack.callback(_stop, folder / "slurmctld.pid")
        _say("slurmctld", "-f", str(CONFIGURATION))
        stack.callback(_end_jobs)
        made = Cluster(folder)
        made.start_node()
        yield made


@contextmanager
def _configured(folder: Path) -> Iterator[None]:
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    controller, node = _free_ports()
    text = TEMPLATE.format(
        mark=MARK,
        process=os.getpid(),
        folder=folder,
        host=socket.gethostname(),
        controller_port=controller,
        node_port=node,
        node_timeout=NODE_TIMEOUT_S,
        processors=os.cpu_count(),
        memory_mb=memory * 8 // 10,
    )
    with CONFIGURATION.open("x") as file:
        file.write(text)
    try:
        yield
    finally:
        CONFIGURATION.unlink()


@contextmanager
def _munge() -> Iterator[None]:
    """The service that signs messages; where it runs already it is not touched."""
    if subprocess.run(["munge", "-n"], capture_output=True, check=False).returncode == 0:
        yield
        return
    made = not MUNGE_FOLDER.exists()
    _say("install", "-d", "-o", "munge", "-g", "munge", "-m", "755", str(MUNGE_FOLDER))
    _say("runuser", "-u", "munge", "--", "/usr/sbin/munged")
    try:
        yield
    finally:
        _stop(MUNGE_FOLDER / "munged.pid")
        if made:
            shutil.rmtree(MUNGE_FOLDER)


@contextmanager
def _named() -> Iterator[None]:
    """The name of this machine leads to an address."""
    try:
        socket.gethostbyname(socket.gethostname())
    except OSError:
        before = HOSTS.read_text()
        HOSTS.write_text(f"{before.rstrip()}\n127.0.0.1 {socket.gethostname()}\n")
        try:
            yield
        finally:
            HOSTS.write_text(before)
    else:
        yield


def _end_jobs() -> None:
    with suppress(AssertionError, subprocess.TimeoutExpired):
        _say("scancel", "--user=root")
        _wait(lambda: not _say("squeue", "-h").strip(), "no job is left")
    for step in _pids_of("slurmstepd"):
        for pid in (*_descendants(step), step):
            _kill(pid, signal.SIGKILL)


def _is_left_over() -> bool:
    """Whether the configuration is that of a test that was killed."""
    first = CONFIGURATION.read_text().splitlines()[:1]
    return bool(first) and first[0].startswith(MARK) and not _alive(int(first[0].split()[-3]))


def _clean_left_over() -> None:
    folder = Path(CONFIGURATION.read_text().splitlines()[0].split()[-1])
    for name in ("slurmd.pid", "slurmctld.pid"):
        _stop(folder / name)
    CONFIGURATION.unlink()


def _stop(pid_file: Path) -> None:
    """End a daemon by its pid file: politely, then not."""
    with suppress(OSError, ValueError):
        pid = int(pid_file.read_text())
        if Path(f"/proc/{pid}/comm").read_text().strip() != pid_file.stem:
            return
        _kill(pid, signal.SIGTERM)
        with suppress(AssertionError):
            _wait(lambda: not _alive(pid), "it ends", seconds=10.0)
            return
        _kill(pid, signal.SIGKILL)


def _pids_of(name: str) -> list[int]:
    """Processes of a program; those of SLURM are ours, as a machine has one configuration of it, and that is ours."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if entry.name.isdigit() and (entry / "comm").read_text().strip() == name:
                found.append(int(entry.name))
    return found


def _descendants(pid: int) -> list[int]:
    with suppress(OSError):
        children = [int(word) for task in Path(f"/proc/{pid}/task").iterdir() for word in _children(task)]
        return [found for child in children for found in (*_descendants(child), child)]
    return []


def _children(task: Path) -> list[str]:
    return (task / "children").read_text().split()


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _kill(pid: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def _free_ports() -> tuple[int, int]:
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _wait(holds: Callable[[], bool], what: str, seconds: float = START_SECONDS) -> None:
    """Wait until something holds; an AssertionError that names it where it does not in time."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.1)


def _path() -> str:
    """The daemons lie where only root looks."""
    return f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


def _say(*command: str) -> str:
    """What a program says; an AssertionError with its last words where it fails."""
    environment = {**os.environ, "PATH": _path()}
    done = subprocess.run(
        command, capture_output=True, stdin=subprocess.DEVNULL, text=True, timeout=60, check=False, env=environment
    )
    assert done.returncode == 0, f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
    return done.stdout
