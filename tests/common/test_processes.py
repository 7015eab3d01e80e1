"""Work shared among processes: in order, not far ahead, and always with an end."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from samples.command import ROOT, finding
from samples.workers import keep_while_at_work

from aegis_cli.common import processes
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.processes import WorkerPool, mapped

TESTS = Path(__file__).parent.parent


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("chunk", [1, 3])
def test_results_come_in_the_order_of_the_items(workers: int, chunk: int) -> None:
    with mapped(abs, range(-10, 0), workers, "a counting process", "", chunk) as results:
        assert list(results) == list(range(10, 0, -1))
    with mapped(abs, [], workers, "a counting process", "", chunk) as results:
        assert list(results) == []


def test_workers_wait_for_whoever_takes_the_results(tmp_path: Path) -> None:
    paths = [tmp_path / str(i) for i in range(60)]
    with mapped(Path.touch, paths, 2, "a touching process", "", chunk=2) as results:
        next(results)
        time.sleep(0.3)  # none of the others takes a hundredth of that
        assert len(list(tmp_path.iterdir())) <= 2 * 2 * 2
        assert len(list(results)) == 59
    assert len(list(tmp_path.iterdir())) == 60


def test_a_process_that_dies_is_one_error() -> None:
    with (
        pytest.raises(
            AegisError,
            match="a counting process died.*\n.*2 running processes.*\nfix: add memory",
        ),
        mapped(os._exit, [1] * 10, 2, "a counting process", "add memory") as results,
    ):
        list(results)


@pytest.mark.parametrize("guarded", [False, True])
def test_a_script_that_every_worker_would_run_again_is_told_so(
    guarded: bool, tmp_path: Path
) -> None:
    call = "with mapped(abs, [1, 2], 2, 'a counting process', '') as found: print(list(found))"
    lead = "if __name__ == '__main__':\n  " if guarded else ""
    script = tmp_path / "script.py"
    script.write_text(f"from aegis_cli.common.processes import mapped\n{lead}{call}\n")
    done = subprocess.run(
        [sys.executable, script],
        cwd=ROOT,
        env=finding(ROOT),
        capture_output=True,
        text=True,
    )
    if guarded:
        assert (done.returncode, done.stdout) == (0, "[1, 2]\n")
    else:
        assert f"a counting process died at its start: it imports '{script}'" in done.stderr
        assert "put what it calls below: if __name__ == '__main__':" in done.stderr


def test_an_error_stops_processes_that_are_still_at_work() -> None:
    started = time.monotonic()
    with pytest.raises(KeyError), WorkerPool(2, "a sleeping process", "") as pool:
        pool.submit(time.sleep, 600)
        raise KeyError
    assert multiprocessing.active_children() == []
    assert time.monotonic() - started < 300


def test_a_worker_that_is_stopped_cleans_up(tmp_path: Path) -> None:
    with pytest.raises(KeyError), WorkerPool(1, "a sleeping process", "") as pool:
        pool.submit(keep_while_at_work, tmp_path / "temporary")
        await_worker(tmp_path / "temporary")
        raise KeyError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent_and_clean_up(tmp_path: Path, number: int) -> None:
    """Whatever ends it: a SIGKILL cannot be noticed by the parent, but by the worker."""
    file = tmp_path / "temporary"
    parent = subprocess.Popen(
        [sys.executable, "-m", "samples.workers", "employ", str(file)], env=finding(ROOT, TESTS)
    )
    worker = await_worker(file)
    assert Path(f"/proc/{worker}").exists()
    parent.send_signal(number)
    parent.wait()
    ended = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists() and time.monotonic() < ended:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()
    assert list(tmp_path.iterdir()) == []


def await_worker(file: Path) -> int:
    """The process id of the working worker, once there is one."""
    given_up = time.monotonic() + 120
    while not (file.exists() and file.read_text(encoding="utf-8")):
        assert time.monotonic() < given_up
        time.sleep(0.05)
    return int(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("cores", "most", "workers", "threads"),
    [(8, 100, 8, 1), (8, 3, 3, 2), (8, 0, 1, 8), (None, 5, 1, 1)],
)
def test_workers_and_their_threads_fill_the_cores_and_no_more(
    cores: int | None, most: int, workers: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes.os, "cpu_count", lambda: cores)
    assert processes.worker_count(most) == workers
    assert processes.threads_per_worker(workers) == threads


def test_a_divergence_travels_between_processes_whole() -> None:
    there = pickle.loads(
        pickle.dumps(Diverged("loss nan", "finite numbers", "try a lower rate", 7))
    )
    assert isinstance(there, Diverged) and vars(there) == vars(
        Diverged("loss nan", "finite numbers", "try a lower rate", 7)
    )
    assert (there.good_steps, there.args) == (7, ("loss nan", "finite numbers", "try a lower rate"))
