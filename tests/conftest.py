"""Small but real inputs, made once per session, and the rule of the fast tests.

They are an untrained two-layer VLM, demonstrations and an anchor.
"""

from __future__ import annotations

import copy
import gc
import itertools
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # tests run in one process per core
# Tests make their inputs on the CPU and expect equal bytes, which a GPU's atomics do not give.
# Tests of another device select it themselves.
os.environ.setdefault("AEGIS_DEVICE", "cpu")
os.environ["HF_HUB_OFFLINE"] = "1"  # no test depends on a network
os.environ.pop("COLUMNS", None)  # nor on the width of somebody's terminal
# Otherwise each of hundreds of processes would compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest
from hypothesis import settings
from samples import fast
from samples.command import command
from samples.tiny import make_tiny

from aegis_cli.anchors import measure
from aegis_cli.common import cache as cache_folders
from aegis_cli.common import garbage
from aegis_cli.data import record
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.models.backbones.embedded import EmbeddedVLM
from aegis_cli.recipes import ANCHOR_PARTS, Anchor

TESTS = Path(__file__).parent
# These take longest, half a minute or more each, and run first. If they ran last, one process
# would still be busy when the others have nothing left to do.
LONG = (
    "training/test_parallel.py",
    "training/test_validation_rollout.py",
    "training/test_train_resume.py",
    "campaign/test_campaign.py",
    "training/test_train.py",
    "models/test_hf_training.py",
    "training/test_validation_vqa.py",
    "continual/test_robot_stream.py",
    "studies/test_pipeline.py",
    "sim/test_metaworld.py",
)
# The number of modules at the last garbage collection, and how many more call for another one.
MODULES, MANY_MODULES = pytest.StashKey[int](), 100

_TESTS_BEGUN = itertools.count()
_CACHE, _MEASURED = (
    cache_folders.folder,
    ("anchors", "answers", "digests", "episodes", "merges", "predictions"),
)

# An example may take longer on a busy machine.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")

# Samples whose fixtures tests name as arguments.
pytest_plugins = [
    "samples.small_run",  # first, since others import it
    "samples.hub",
    "samples.lerobot",
    "samples.merges",
    "samples.nullspace",
    "samples.processes",
    "samples.robots",
    "samples.streams",
    "samples.training_runs",
    "samples.own_robots",  # after what it imports
    "samples.user_folder",
    "samples.vqa_truth",
]


def pytest_configure() -> None:
    """Handle Ctrl-C, which a script's background jobs ignore, and so would the tests' processes."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # As for the processes that tests start. Otherwise every worker would compile all tests, with
    # the assertions that pytest rewrites: 25 seconds.
    sys.dont_write_bytecode = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the fast tests, by the rule of `samples.fast`; put the long files first."""
    for item in items:
        path = item.path.relative_to(TESTS).as_posix()
        if fast.test_is_fast(path, getattr(item, "originalname", item.name)):
            item.add_marker("fast")
    items.sort(key=lambda item: item.path.relative_to(TESTS).as_posix() not in LONG)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Under `-m fast`, do not even import files without fast tests; None: others decide."""
    if config.option.markexpr != "fast" or collection_path.suffix != ".py":
        return None
    if collection_path.name == "conftest.py":
        return None
    path = collection_path.relative_to(TESTS).as_posix()
    return None if fast.may_be_fast(path) else True


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect no garbage while the tests are imported."""
    with garbage.left_out():
        return (yield)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep the objects of the modules and tests until the end."""
    keep_what_is_there(session)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Also keep what a file leaves, and the modules that it has imported for the first time."""
    of_another_file = nextitem is None or nextitem.path != item.path
    if of_another_file or len(sys.modules) > item.session.stash[MODULES] + MANY_MODULES:
        keep_what_is_there(item.session)


def keep_what_is_there(session: pytest.Session) -> None:
    """Exclude the objects that are alive now from all later garbage collections.

    There are millions of them. A dry run, which looks at all live objects, took seconds.
    """
    gc.collect()
    gc.freeze()
    session.stash[MODULES] = len(sys.modules)


@pytest.fixture(scope="session", autouse=True)
def nothing_waits_for_the_disk() -> Iterator[None]:
    """Skip fsync, which only a power cut would show; a training waits for its disk 16 times."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def what_is_measured_is_kept_apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Keep what fixtures measure apart from the user's cache and from earlier sessions."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        _keep_in(folder, patch)
        yield folder


@pytest.fixture(autouse=True)
def every_test_measures(
    what_is_measured_is_kept_apart: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other test finds what a test has measured, perhaps of a model that it has changed."""
    _keep_in(what_is_measured_is_kept_apart / str(next(_TESTS_BEGUN)), monkeypatch)


def _keep_in(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Put measurements and digests into the folder; all tests share the large pictures."""

    def chosen(name: str) -> Path:
        asked_for = "AEGIS_CACHE" in os.environ
        return _CACHE(name) if asked_for or name not in _MEASURED else folder / name

    patch.setattr(cache_folders, "folder", chosen)


@pytest.fixture
def tiny() -> EmbeddedVLM:
    return make_tiny()


@pytest.fixture(scope="session")
def tiny_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A backbone folder, as `--backbone` and `--set backbone=` take it."""
    folder = tmp_path_factory.mktemp("backbone")
    make_tiny().save(folder)
    return folder


@pytest.fixture(scope="session")
def hf_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A model folder of a Hugging Face family, by its name; written once."""
    from samples import hf as hf_samples

    @cache
    def folder(family: str) -> Path:
        return hf_samples.write(family, tmp_path_factory.mktemp(family))

    return folder


@pytest.fixture(scope="session")
def hf_backbone(hf_folder: Callable[[str], Path]) -> Callable[[str], Backbone]:
    """A copy of a Hugging Face family's backbone, loaded once."""
    from aegis_cli.models import backbones

    load = cache(lambda family: backbones.load(str(hf_folder(family))))
    return lambda family: copy.deepcopy(load(family))


@pytest.fixture(scope="session")
def hf_anchor(
    tmp_path_factory: pytest.TempPathFactory, hf_folder: Callable[[str], Path]
) -> Callable[[str], Path]:
    """An anchor of a Hugging Face family's backbone, with moments and inputs; measured once."""

    @cache
    def measured(family: str) -> Path:
        path = tmp_path_factory.mktemp("anchor") / f"{family}.safetensors"
        measure.run(
            str(hf_folder(family)),
            Anchor(samples=14, batch_size=14, energy=1.0, parts=("moments", "inputs")),
            path,
        )
        return path

    return measured


@pytest.fixture(scope="session")
def demos_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demos") / "reach.safetensors"
    record.run("reach", 8, 0, path, workers=1)
    return path


@pytest.fixture(scope="session")
def anchor_file(tmp_path_factory: pytest.TempPathFactory, tiny_folder: Path) -> Path:
    path = tmp_path_factory.mktemp("anchor") / "anchor.safetensors"
    measure.run(
        str(tiny_folder),
        Anchor(samples=40, batch_size=16, parts=ANCHOR_PARTS, energy=1.0, fisher_samples=8),
        path,
    )
    return path


@pytest.fixture
def aegis(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command in this process: (exit code, stdout, stderr)."""

    def call(*args: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as caught:
            command()([str(a) for a in args], prog_name="aegis")
        captured = capsys.readouterr()
        return caught.value.code or 0, captured.out, captured.err

    return call
