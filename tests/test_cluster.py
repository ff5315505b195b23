"""Workers of Dask and of Slurm: the same results, and what is said where they fail."""

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from logged_work import DISK_IS_FULL, Logged
from worker_scene import VIEWS, Scene

import omnilines as ol
from camera_models import InputError
from omnilines import cli
from omnilines.commands.cluster import workers
from omnilines.commands.slurm import SlurmJobs, is_slurm
from omnilines.pipelines import arcs as arcs_module
from omnilines.pipelines import batches


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene(tmp_path_factory.mktemp("workers"), VIEWS)


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """More batches than one."""
    monkeypatch.setattr(batches, "BATCH", 2)


def refused(capsys: pytest.CaptureFixture[str], scene: Scene, *arguments: str) -> str:
    """What `extract` says with these arguments."""
    common = ("extract", str(scene.room), "--calibration", str(scene.room / "calibration.yaml"))
    with pytest.raises(SystemExit) as ended:
        cli.main([*common, *arguments])
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.strip().splitlines()) == 1
    return said.err


def test_no_dask_and_no_address_are_told(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ("--out", str(tmp_path / "out"))
    assert "--cluster was expected as local, slurm or HOST:PORT" in refused(capsys, scene, *out, "--cluster", "my cluster")
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'omnilines[cluster]'" in refused(capsys, scene, *out, "--cluster", "local")
    assert not (tmp_path / "out").exists()


WITH_DASK = """
import logging, pickle, sys
import distributed
import omnilines as ol
from omnilines.commands import cluster

room, nobody, out = sys.argv[1:]
alone = ol.extract(room, ol.load(f"{room}/calibration.yaml"))
cluster.ANSWER_S = 0.2
try:
    with cluster.workers(nobody):
        pass
except ol.InputError as error:
    print(error)
cluster.ANSWER_S = 60
here = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", **here) as local:
    with cluster.workers(local.scheduler_address.removeprefix("tcp://")) as executor:
        found = ol.extract(room, ol.load(f"{room}/calibration.yaml"), executor=executor)
with open(out, "wb") as file:
    pickle.dump((alone, found), file)
"""


@pytest.mark.slow
def test_a_scheduler_of_dask_finds_what_this_process_does_and_one_that_is_not_there_is_told(scene: Scene, tmp_path: Path) -> None:
    """In a process of its own: what Dask leaves open would be found in some later test."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        nobody = f"127.0.0.1:{taken.getsockname()[1]}"
        command = [sys.executable, "-c", WITH_DASK, scene.room, nobody, tmp_path / "arcs"]
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"A Dask scheduler was expected at {nobody}, found none that answers" in done.stdout
    alone, found = pickle.loads((tmp_path / "arcs").read_bytes())
    scene.require_same_arcs(alone)
    mine, scene.arcs = scene.arcs, alone
    scene.require_same_arcs(found)
    scene.arcs = mine


NO_SCHEDULER = """
import socket, sys, threading, time
from omnilines.commands import cluster

first = bytes.fromhex(sys.argv[1])
server = socket.create_server(("127.0.0.1", 0))
taken = []

def serve():
    while True:
        taken.append(server.accept()[0])
        taken[-1].sendall(first)

threading.Thread(target=serve, daemon=True).start()
cluster.ANSWER_S = 0.5
try:
    with cluster.workers(f"127.0.0.1:{server.getsockname()[1]}"):
        pass
except cluster.InputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("first", [b"", bytes(64), b"SSH-2.0-OpenSSH_9.0\r\n"], ids=["silent", "zeros", "ssh"])
def test_a_server_that_is_no_scheduler_is_told_and_not_waited_for(first: bytes) -> None:
    """Dask waits without end for one that says nothing, and reads what another says as lengths of messages."""
    command = [sys.executable, "-c", NO_SCHEDULER, first.hex()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "found none that answers as one within 0.5 seconds" in done.stdout and "Traceback" not in done.stderr


FAKE_SLURM = {
    # Of Slurm: what it says of a job that it would not take, and one process group for each job.
    "sbatch": """#!/bin/sh
if [ "$1" = --test-only ]; then
    grep -q "^#SBATCH -A nobody" "$2" || exit 0
    echo "allocation failure: Invalid account" >&2
    exit 1
fi
number=1
until mkdir "SLURM/$number" 2>/dev/null; do number=$((number + 1)); done
echo "$number" >> SLURM/submitted
cp "$1" "SLURM/$number.sh"
setsid sh "SLURM/$number.sh" > "SLURM/$number.out" 2>&1 &
echo $! > "SLURM/$number.pid"
echo "Submitted batch job $number"
""",
    "scancel": """#!/bin/sh
echo "$1" >> SLURM/cancelled
kill -TERM -- "-$(cat "SLURM/$1.pid")"
""",
}


def fake_slurm(folder: Path) -> str:
    """The PATH with commands of Slurm whose jobs are processes of this machine."""
    folder.mkdir()
    (folder / "submitted").touch()
    for name, script in FAKE_SLURM.items():
        (folder / name).write_text(script.replace("SLURM", str(folder)))
        (folder / name).chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"


def test_what_slurm_lacks_is_told(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(where: str) -> str:
        return refused(capsys, scene, "--cluster", where, "--out", str(tmp_path / "out"))

    for wrong in ("slurm:jobs=0", "slurm:jobs=2,jobs=3", "slurm:memory=16", "slurm:queue=a b", "slurm:colour=red", "slurm:jobs"):
        assert "--cluster was expected as slurm:jobs=10,queue=long" in said(wrong)
    assert SlurmJobs.of("slurm") == SlurmJobs()
    asked = "slurm:jobs=10,queue=long,account=me,walltime=1-12:00:00,cores=8,memory=16GB,wait=2h"
    assert SlurmJobs.of(asked) == SlurmJobs(10, "long", "me", "1-12:00:00", 8, "16GB", 7200.0)
    # A host may be called so.
    assert not is_slurm("slurm:8786")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "found no sbatch on the PATH" in said("slurm")
    monkeypatch.setenv("PATH", fake_slurm(tmp_path / "slurm"))
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    assert "pip install 'omnilines[cluster]'" in said("slurm:jobs=2")
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_jobs_of_slurm_find_what_this_process_does(scene: Scene, tmp_path: Path) -> None:
    """With commands that stand for those of Slurm; in processes of their own, as with Dask."""
    slurm = tmp_path / "slurm"
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    environment = {**os.environ, "PATH": fake_slurm(slurm), "PYTHONPATH": paths}
    command = [
        sys.executable,
        "-m",
        "omnilines",
        "extract",
        scene.room,
        "--calibration",
        scene.room / "calibration.yaml",
        "--out",
    ]

    def extract(out: str, *more: str) -> subprocess.CompletedProcess[str]:
        line = [str(part) for part in (*command, tmp_path / out, *more)]
        return subprocess.run(line, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)

    no = extract("no", "--cluster", "slurm:account=nobody")
    assert no.returncode == 2 and "sbatch refuses it (allocation failure: Invalid account)" in no.stderr
    assert (slurm / "submitted").read_text() == "" and not (tmp_path / "no").exists()
    jobs = "slurm:jobs=2,queue=long,walltime=2:00:00,cores=1,memory=2GB,wait=2m"
    for ended in (extract("there", "--cluster", jobs), extract("here")):
        assert ended.returncode == 0, ended.stderr
    there, here = (ol.read_segments(tmp_path / out / "segments.csv") for out in ("there", "here"))
    assert len(here) > 50
    np.testing.assert_allclose(there.endpoints_px, here.endpoints_px, rtol=0.0, atol=1e-6)
    script = (slurm / "1.sh").read_text()
    assert all(f"#SBATCH {line}" in script for line in ("-p long", "-t 2:00:00", "--cpus-per-task=1", "--mem=2G"))
    assert sorted((slurm / "cancelled").read_text().split()) == sorted((slurm / "submitted").read_text().split()) == ["1", "2"]


def answers(where: str) -> bool:
    """Whether anything listens there."""
    host, _, port = where.rpartition(":")
    with socket.socket() as trial:
        return trial.connect_ex((host, int(port))) == 0


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, Callable[..., subprocess.Popen[bytes]]]]:
    """The address of a scheduler of its own, and what starts a worker for it."""
    started: list[subprocess.Popen[bytes]] = []
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{free.getsockname()[1]}"
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(str(Path(__file__).parents[k]) for k in (1, 0)),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2",
    }

    def start(program: str, *arguments: str, **more: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments]
        process = subprocess.Popen(
            command, cwd=tmp_path, env={**environment, **more}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        started.append(process)
        return process

    start("scheduler", "--host", "127.0.0.1", "--port", where.rpartition(":")[2], "--dashboard-address", "127.0.0.1:0")
    until = time.monotonic() + 120.0
    while not answers(where):
        assert time.monotonic() < until
        time.sleep(0.2)
    yield (
        where,
        lambda *arguments, **more: start("worker", where, "--nthreads", "1", "--no-nanny", "--no-dashboard", *arguments, **more),
    )
    for process in reversed(started):
        process.kill()
        process.wait()


def begun_with_four(
    scene: Scene, executor: Executor, folder: Path, monkeypatch: pytest.MonkeyPatch, slow_s: float = 0.5
) -> list[int]:
    """Arcs found by the workers of a scheduler, which have to be those that are found here; processes that began a photo."""
    folder.mkdir()
    inner = arcs_module.look_at_rest
    monkeypatch.setattr(
        arcs_module, "look_at_rest", lambda work, *args, **named: inner(Logged(work, folder, slow_s), *args, **named)
    )
    scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=executor))
    return [int(path.name.partition("-")[0]) for path in folder.iterdir()]


@pytest.mark.full
def test_a_killed_worker_of_four_costs_one_batch_and_one_with_a_full_disk_nothing_but_tries(
    tmp_path: Path, scheduler: tuple[str, Callable[..., subprocess.Popen[bytes]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers are killed at random while they work: the same arcs, and no more than one batch is begun again for each."""
    where, worker = scheduler
    scene = Scene(tmp_path, 24)
    running = [worker() for _ in range(4)]
    rng = np.random.default_rng(3)
    killed: list[int] = []

    def kill_now_and_then() -> None:
        while len(killed) < 3 and not stop.wait(rng.uniform(0.2, 0.8)):
            victim = running.pop(int(rng.integers(len(running))))
            victim.kill()
            killed.append(victim.pid)
            running.append(worker())

    with workers(where, wait_s=120.0) as executor:
        assert executor is not None
        stop = threading.Event()
        murderer = threading.Thread(target=kill_now_and_then)
        murderer.start()
        try:
            begun = begun_with_four(scene, executor, tmp_path / "begun", monkeypatch)
        finally:
            stop.set()
            murderer.join()
        assert killed and 24 <= len(begun) <= 24 + len(killed) * batches.BATCH
    monkeypatch.undo()
    monkeypatch.setattr(batches, "BATCH", 2)
    full = worker(**{DISK_IS_FULL: "1"})
    with workers(where, wait_s=120.0) as executor:
        assert executor is not None
        until = time.monotonic() + 120.0
        while full.pid not in {executor.submit(os.getpid).result(60) for _ in range(20)}:
            assert time.monotonic() < until
        begun = begun_with_four(scene, executor, tmp_path / "begun again", monkeypatch)
    # Of a batch that failed the first photo was begun.
    assert begun.count(full.pid) >= 1 and len(begun) == 24 + begun.count(full.pid)


@pytest.mark.full
def test_a_worker_that_never_comes_is_told(scheduler: tuple[str, Callable[..., subprocess.Popen[bytes]]]) -> None:
    where, worker = scheduler
    with pytest.raises(InputError, match=rf"A worker was expected at the scheduler {where}, none came within 3 seconds"):
        with workers(where, wait_s=3.0):
            pass
    # One that hangs before it is there is not waited for where another comes.
    worker().send_signal(signal.SIGSTOP)
    worker()
    with workers(where, wait_s=120.0) as executor:
        assert executor is not None and executor.submit(os.getpid).result(60) != os.getpid()


@pytest.mark.full
def test_a_local_cluster_and_a_pool_of_processes_find_what_this_process_does(scene: Scene, tmp_path: Path) -> None:
    with workers("local") as executor:
        scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=executor))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        scene.require_same_arcs(ol.extract(scene.room, scene.cameras, executor=pool))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        with pytest.raises(InputError, match="could not be worked on: BrokenProcessPool"):
            threading.Timer(0.0, lambda: pool.submit(os._exit, 1)).start()
            time.sleep(1.0)
            ol.extract(scene.room, scene.cameras, executor=pool)
