"""Outputs that cannot be written, and Ctrl-C.

There is one clear message, nothing half-written, and runs can resume.
"""

from __future__ import annotations

import io
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from samples import processes
from samples.command import ROOT, finding, refused
from samples.disk import disk
from samples.user_folder import TRAIN, leftovers, snapshot, training

from aegis_cli import recipes
from aegis_cli.cli import render
from aegis_cli.common import artifacts, locks
from aegis_cli.common.events import Progress
from aegis_cli.training import train

NO_TEXT = os.fsdecode(b"caf\xe9")  # a legal name in an encoding other than UTF-8


# --- where nothing can be written ----------------------------------------------------------------


def outputs(place: str) -> dict[str, tuple[str, ...]]:
    """Every option that names an output, by what it writes to."""
    return {
        "demos": ("demos", "point", "--episodes", "2", "--out", f"{place}/d.safetensors"),
        "preview": (
            "demos",
            "point",
            "--episodes",
            "2",
            "--out",
            "d.safetensors",
            "--preview",
            f"{place}/p.png",
        ),
        "anchor": (
            "anchor",
            "--backbone",
            "model.safetensors",
            "--samples",
            "7",
            "--out",
            f"{place}/a.safetensors",
        ),
        "train": training(out=f"{place}/run"),
        "pretrain": ("pretrain", "vlm.yaml", "--out", f"{place}/vlm"),
        "run": ("run", "small.yaml", "--out", place),
        "video": ("rollout", "RUN", "--episodes", "1", "--video", f"{place}/v.gif"),
        "actions": ("evaluate", "RUN", "--demos", "demos.safetensors", "--plot", f"{place}/a.png"),
        "plot": ("inspect", "RUN", "--plot", f"{place}/p.png"),
    }


@pytest.mark.parametrize(
    ("output", "where"),
    [
        (output, where)
        for output in outputs("")
        for where in ("file", "/proc")
        if (output, where) not in (("preview", "/proc"), ("actions", "/proc"))
    ],
)
def test_a_place_that_cannot_be_written(
    output: str, where: str, bad: Callable[..., str], trained: Path
) -> None:
    """Below something that is not a folder, and in a file system without files (for root too)."""
    bad(
        *(str(trained) if word == "RUN" else word for word in outputs(where)[output]), says=(where,)
    )


@pytest.mark.parametrize(
    "command", [training(out="file"), ("pretrain", "vlm.yaml", "--out", "file")]
)
def test_a_file_where_a_folder_is_to_be(command: tuple[str, ...], bad: Callable[..., str]) -> None:
    bad(*command, says=("'file'",))


@pytest.mark.parametrize("command", [outputs(".")["demos"], outputs(".")["anchor"]])
def test_a_folder_where_a_file_is_to_be(
    command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    (place / Path(command[-1]).name).mkdir()
    bad(*command, says=(Path(command[-1]).name,))


@pytest.mark.parametrize(
    "command",
    [
        *(outputs(NO_TEXT)[name] for name in ("demos", "anchor", "train", "pretrain", "run")),
        ("demos", "point", "--episodes", "2", "--format", "lerobot", "--out", f"{NO_TEXT}/d"),
    ],
    ids=itertools.count(),
)
def test_a_path_that_is_no_text_is_refused_before_the_work(
    command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    """The output there could not be read."""
    (place / NO_TEXT).mkdir()
    bad(*command, says=("caf\\udce9", "not UTF-8", "choose another --out"))


def test_a_locale_that_cannot_read_a_name_is_told_from_a_name_that_is_no_text(
    place: Path,
) -> None:
    """The user has to change one or the other."""
    ascii_names = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "aegis_cli", "demos", "point", "--out", "caf\u00e9"],
        cwd=place,
        env=finding(ROOT) | ascii_names,
        capture_output=True,
    )
    assert done.returncode == 2
    assert b"a locale of ascii names" in done.stderr and b"LC_ALL=C.UTF-8" in done.stderr


@pytest.mark.parametrize(("output", "free"), [("demos", 100_000), ("anchor", 1000)])
def test_a_full_disk_leaves_no_artifact(output: str, free: int, bad: Callable[..., str]) -> None:
    with disk(free):
        bad(*outputs(".")[output], says=("cannot write", "free space"))


def test_a_full_disk_leaves_no_half_checkpoint_and_the_run_goes_on(
    aegis, place: Path, trained: Path
) -> None:
    with disk(20_000):
        assert "free" in refused(aegis(*TRAIN))
    assert not leftovers(place) and sorted(p.name for p in (place / "runs").iterdir()) == [
        "checkpoints",
        "inputs.json",
        "ledger.safetensors",
        "machine.json",
        "metrics.jsonl",
        "recipe.yaml",
    ]
    assert not list((place / "runs" / "checkpoints").iterdir())
    assert aegis(*TRAIN, "--resume")[0] == 0
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        path = Path("checkpoints") / "last" / name
        assert (place / "runs" / path).read_bytes() == (trained / path).read_bytes()


def test_a_full_disk_during_pretraining(aegis, place: Path) -> None:
    with disk(20_000):
        assert "free" in refused(aegis("pretrain", "vlm.yaml", "--out", "vlm"))
    assert not (place / "vlm").exists()


def test_pretraining_replaces_no_model_that_it_did_not_begin(bad: Callable[..., str]) -> None:
    """Nor a finished one, whose state was deleted by a user, after an hour's work."""
    for resume in ([], ["--resume"]):
        bad(
            "pretrain",
            "vlm.yaml",
            "--out",
            ".",
            *resume,
            says=("a finished model in '.'", "another --out"),
        )


# --- Ctrl-C, and signals from outside ------------------------------------------------------------


def interrupted(
    place: Path,
    args: tuple[str, ...],
    ready: Callable[[int, str], bool],
    number: signal.Signals = signal.SIGINT,
) -> str:
    """Run `aegis` and press Ctrl-C once `ready`, which is given its process id and its output.

    As with a terminal, the whole group gets the signal; a signal other than Ctrl-C goes only to the
    command, as `kill` sends it.
    """
    said = place.parent / "stderr.txt"
    with processes.aegis(args, place, said) as process:
        assert process.pid is not None
        while not ready(process.pid, said.read_text()):
            assert process.exitcode is None, said.read_text()
            time.sleep(0.02)
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        process.join(timeout=300)  # only a hang takes this long
        assert process.exitcode == 128 + number
    ended = "interrupted" if number == signal.SIGINT else number.name
    assert "Traceback" not in said.read_text() and said.read_text().count(ended) == 1, (
        said.read_text()
    )
    await_end(process.pid)
    return said.read_text()


def await_end(group: int) -> None:
    """Wait for the last process of a group, which may still be cleaning up."""
    given_up = time.monotonic() + 60
    while time.monotonic() < given_up:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("a process has outlived the command")


class Enough(Exception):
    """Ends a training that only had to be resumed."""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_leaves_a_run_that_goes_on(place: Path, number: signal.Signals) -> None:
    args = (*TRAIN, "--set", "train.steps=1000000", "--set", "train.checkpoint_every=3")
    err = interrupted(
        place,
        args,
        lambda *_: (place / "runs/checkpoints/last/expert.safetensors").exists(),
        number,
    )
    assert "resume with: aegis train runs\n" in err
    assert not leftovers(place)
    last = (place / "runs/checkpoints/last").resolve()
    assert all(artifacts.load(path) for path in last.rglob("*.safetensors"))
    seen: list[Progress] = []

    def at_once(event: Progress) -> None:
        if event.stage == "train":
            seen.append(event)
            raise Enough

    changes = ["train.steps=1000000", "train.checkpoint_every=3"]
    settings = recipes.load(place / "small.yaml", changes)
    with pytest.raises(Enough):
        train.run(
            settings,
            "aegis",
            Path("demos.safetensors"),
            Path("anchor.safetensors"),
            Path("runs"),
            resume=True,
            on_event=at_once,
        )
    assert [event.done for event in seen] == [int(last.name)]


def starting(pid: int, _: str) -> bool:
    """The first worker process exists, but has hardly begun its imports."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    children = [child for thread in threads for child in said_by(thread / "children").split()]
    return any("multiprocessing.spawn" in said_by(Path(f"/proc/{pid}/cmdline")) for pid in children)


def said_by(file: Path) -> str:
    """What the system says about a process or a thread; empty if it has just ended."""
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return ""


def working(_: int, said: str) -> bool:
    """Workers have delivered results."""
    return "demos: " in said or "render: " in said


RECORDING = ("demos", "point", "--episodes", "9999", "--out", "d.safetensors")
DRAWING = ("pretrain", "vlm.yaml", "--set", "scenes=9999", "--out", "empty")


@pytest.mark.parametrize(
    ("command", "moment", "number"),
    [
        (RECORDING, starting, signal.SIGINT),
        (DRAWING, working, signal.SIGINT),
        (RECORDING, working, signal.SIGTERM),
    ],
)
def test_a_signal_ends_worker_processes_too(
    command: tuple[str, ...],
    moment: Callable[[int, str], bool],
    number: signal.Signals,
    place: Path,
) -> None:
    """None of them prints a traceback of its own, and no output is started."""
    (place / "empty").mkdir()
    before = snapshot(place)
    interrupted(place, command, moment, number)
    assert snapshot(place) == before


@pytest.mark.parametrize(
    "command", [TRAIN, ("pretrain", "vlm.yaml", "--out", "runs"), ("run", "small.yaml")]
)
def test_a_second_process_is_refused_and_told_who_is_at_work(
    command: tuple[str, ...], bad: Callable[..., str], place: Path
) -> None:
    folder = Path("runs/small") if command[0] == "run" else Path("runs")
    (place / folder).mkdir(parents=True)
    with locks.alone(folder):
        bad(*command, says=(f"by process {os.getpid()} on", "another --out"))


# --- outputs of other kinds ----------------------------------------------------------------------


def output_of(*command: str, **environment: str) -> str:
    """What a successful command writes to a pipe."""
    done = subprocess.run(
        [sys.executable, "-m", "aegis_cli", *command],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        check=True,
    )
    return done.stdout.decode(environment.get("PYTHONIOENCODING", "utf-8"))


@pytest.mark.parametrize(
    ("command", "says", "encoding", "columns"),
    [("inspect RUN", "Energy", "ascii", 60), ("recipes", "quickstart", "latin-1", 100)],
)
def test_a_pipe_gets_the_characters_that_it_knows_in_lines_as_wide_as_columns_says(
    trained: Path, command: str, says: str, encoding: str, columns: int
) -> None:
    """Without blanks at the lines' ends."""
    words = [str(trained) if word == "RUN" else word for word in command.split()]
    shown = output_of(*words, PYTHONIOENCODING=encoding, COLUMNS=str(columns))
    assert says in shown and "─" not in shown
    lines = shown.splitlines()
    assert max(map(len, lines)) <= columns
    assert [line for line in lines if line != line.rstrip()] == []


def test_characters_that_an_encoding_has_not_got_are_written_plainly() -> None:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="ascii")
    render.write_any_character(stream)
    print("W2² 1.5 ±0.2, 木", file=stream, flush=True)
    assert raw.getvalue().decode("ascii") == "W2^2 1.5 +-0.2, ?\n"


def test_h_asks_for_help_as_help_does(aegis: Callable[..., tuple[int, str, str]]) -> None:
    assert aegis("probe", "-h") == aegis("probe", "--help")
