"""A real SLURM on this machine for as long as a test needs it: two nodes, loopback only, no database, no systemd.

Each node has a name and processes of its own (namespaces of the kernel), so that a number of a process says nothing on
the other one, and the disk of this machine. SLURM looks for its configuration in one place, and the workflow engine
takes away the variable that names another. So it lies in /etc/slurm as long as the cluster stands, and goes with it.
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

from tests.cohort.marked_processes import send

#: Set by `make test-cluster`.
WANTED = "CT2LUT_TEST_CLUSTER"
PROGRAMS = (
    *("slurmctld", "slurmd", "sbatch", "squeue", "sinfo", "scancel", "scontrol", "munged", "munge"),
    *("unshare", "nsenter"),
)
NODES = ("node1", "node2")
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
SlurmdSpoolDir={folder}/%n/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n/slurmd.log
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
PartitionName=knees Nodes=ALL Default=NO MaxTime=INFINITE State=UP
"""
NODE = "NodeName={name} NodeAddr=127.0.0.1 Port={port} CPUs={processors} RealMemory={memory_mb} State=UNKNOWN"


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

    def start_node(self, node: str) -> None:
        """Switch a node on where it is off, start its daemon and wait until it can take a job."""
        if not _init(self.folder / node):
            _switch_on(self.folder / node)
        _say(*_on(self.folder / node), "slurmd", "-f", str(CONFIGURATION))
        self.wait_for_node(node, "idle", "mixed", "allocated")

    def lose_node(self, node: str) -> None:
        """Kill a node's daemon and all that runs on it, as a power cut would; wait until SLURM has noticed."""
        _switch_off(self.folder / node)
        self.wait_for_node(node, "down", "down*")

    def kill_node_daemon(self, node: str) -> None:
        """Kill the daemon of a node alone; its jobs know nothing of it."""
        (pid,) = _daemons(self.folder / node)
        send(signal.SIGKILL, pid)
        _wait(lambda: not _alive(pid), "the daemon of the node is gone")

    def wait_for_node(self, node: str, *states: str) -> None:
        """Wait until a node is in one of some states, as ``sinfo`` calls them."""
        asked = ("sinfo", "-h", "-N", "-n", node, "-o", "%T", "-p", "main")
        _wait(lambda: _say(*asked).strip() in states, f"{node} is {' or '.join(states)}", NODE_SECONDS)

    def node(self, job: str) -> str:
        """Where a job runs or ran last."""
        return _say("squeue", "-h", "-t", "all", "-j", job, "-o", "%N").strip()

    def jobs(self) -> dict[str, str]:
        """State of every job, running and past, by its number."""
        rows = _say("squeue", "-h", "-a", "-t", "all", "-o", "%i %T").split("\n")
        return dict(row.split() for row in rows if row)

    def partition(self, job: str) -> str:
        """The partition of a job."""
        return _say("squeue", "-h", "-t", "all", "-j", job, "-o", "%P").strip()

    def mend(self) -> None:
        """Start the daemons again that a test has left dead."""
        for node in NODES:
            if not _daemons(self.folder / node):
                self.start_node(node)

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
    """A cluster with idle nodes; all that was started or made is stopped and removed at the end, whatever happens."""
    if CONFIGURATION.exists():
        _clean_left_over()
    with ExitStack() as stack:
        stack.enter_context(_named(socket.gethostname(), *NODES))
        stack.enter_context(_configured(folder))
        stack.enter_context(_munge())
        for node in NODES:
            stack.callback(_switch_off, folder / node)
        stack.callback(_stop, folder / "slurmctld.pid")
        _say("slurmctld", "-f", str(CONFIGURATION))
        stack.callback(_end_jobs)
        made = Cluster(folder)
        for node in NODES:
            made.start_node(node)
        yield made


@contextmanager
def _configured(folder: Path) -> Iterator[None]:
    for name in ("state", *(f"{node}/spool" for node in NODES)):
        (folder / name).mkdir(parents=True)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    controller, *ports = _free_ports(1 + len(NODES))
    share = {"processors": max(1, (os.cpu_count() or 1) // 2), "memory_mb": memory * 4 // 10}
    text = TEMPLATE.format(
        mark=MARK,
        process=os.getpid(),
        folder=folder,
        host=socket.gethostname(),
        controller_port=controller,
        node_timeout=NODE_TIMEOUT_S,
        nodes="\n".join(NODE.format(name=name, port=port, **share) for name, port in zip(NODES, ports, strict=True)),
    )
    with CONFIGURATION.open("x") as file:
        file.write(text)
    try:
        yield
    finally:
        CONFIGURATION.unlink()


def _switch_on(folder: Path) -> None:
    """The first process of a node; what it adopts it does not wait for, and what it started ends with it."""
    first = f"hostname {folder.name} && exec env --ignore-signal=CHLD sleep infinity"
    own = f"unshare --uts --pid --mount-proc --fork --kill-child sh -c '{first}'"
    pid = _say("sh", "-c", f"setsid {own} </dev/null >{folder}/unshare.log 2>&1 & echo $!")
    (folder / "unshare.pid").write_text(pid)
    _wait(lambda: _name_in(_init(folder)) == "sleep", f"{folder.name} is on")


def _switch_off(folder: Path) -> None:
    """As by its main switch."""
    with suppress(OSError, ValueError):
        pid = int((folder / "unshare.pid").read_text())
        if _name_in(pid) == "unshare":
            inside = _descendants(pid)
            send(signal.SIGKILL, pid)
            _wait(lambda: not any(map(_alive, inside)), f"{folder.name} is off")


def _init(folder: Path) -> int:
    """The first process of a node, by our number; 0 where the node is off."""
    with suppress(OSError, ValueError):
        pid = int((folder / "unshare.pid").read_text())
        if _name_in(pid) == "unshare":
            return next(iter(_children(pid)), 0)
    return 0


def _on(folder: Path) -> tuple[str, ...]:
    """What stands before a command to run it on a node."""
    return ("nsenter", f"--target={_init(folder)}", "--uts", "--pid", "--mount")


def _daemons(folder: Path) -> list[int]:
    """The daemon of a node, by our number; none where it is dead. What it forks for a job is no child of init."""
    return [pid for pid in _children(_init(folder)) if _name_in(pid) == "slurmd" and _alive(pid)]


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
def _named(*hosts: str) -> Iterator[None]:
    """Names of machines lead to an address."""
    before = HOSTS.read_text()
    HOSTS.write_text("\n".join([before.rstrip(), *(f"127.0.0.1 {host}" for host in hosts if not _is_known(host)), ""]))
    try:
        yield
    finally:
        HOSTS.write_text(before)


def _is_known(host: str) -> bool:
    with suppress(OSError):
        return bool(socket.gethostbyname(host))
    return False


def _end_jobs() -> None:
    with suppress(AssertionError, subprocess.TimeoutExpired):
        _say("scancel", "--user=root")
        _wait(lambda: not _say("squeue", "-h").strip(), "no job is left")


def _is_left_over() -> bool:
    """Whether the configuration is that of a test that was killed."""
    first = CONFIGURATION.read_text().splitlines()[:1]
    return bool(first) and first[0].startswith(MARK) and not _alive(int(first[0].split()[-3]))


def _clean_left_over() -> None:
    folder = Path(CONFIGURATION.read_text().splitlines()[0].split()[-1])
    _stop(folder / "slurmctld.pid")
    for node in NODES:
        _switch_off(folder / node)
    CONFIGURATION.unlink()


def _stop(pid_file: Path) -> None:
    """End a daemon by its pid file: politely, then not."""
    with suppress(OSError, ValueError):
        pid = int(pid_file.read_text())
        if _name_in(pid) != pid_file.stem:
            return
        send(signal.SIGTERM, pid)
        with suppress(AssertionError):
            _wait(lambda: not _alive(pid), "it ends", seconds=10.0)
            return
        send(signal.SIGKILL, pid)


def _name_in(pid: int) -> str:
    """The program of a process; nothing where there is none."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/comm").read_text().strip()
    return ""


def _descendants(pid: int) -> list[int]:
    return [found for child in _children(pid) for found in (*_descendants(child), child)]


def _children(pid: int) -> list[int]:
    with suppress(OSError):
        tasks = Path(f"/proc/{pid}/task").iterdir()
        return [int(word) for task in tasks for word in (task / "children").read_text().split()]
    return []


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _free_ports(number: int) -> list[int]:
    with ExitStack() as stack:
        held = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(number)]
        return [one.getsockname()[1] for one in held]


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
