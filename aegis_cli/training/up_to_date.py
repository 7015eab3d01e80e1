"""Records of what a stage read and wrote, which decide whether it runs again."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli import recipes
from aegis_cli.common import commands, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, Progress
from aegis_cli.common.version import __version__
from aegis_cli.data import record
from aegis_cli.recipes import Demos

SHARED = "stages.json"  # the records of stages that the runs of a folder share
BEGUN = "begun"  # the stage of a run that has been started, finished or not


def digest(key: Any) -> str:
    """sha256 of what a stage reads, and of the version that reads it."""
    # Canonical JSON: equal keys give equal text, whatever the order of their entries.
    text = files.canonical({"version": __version__, "key": key})
    return hashlib.sha256(text.encode()).hexdigest()


def _parts(key: Any) -> dict[str, str]:
    """sha256 of each thing that a stage reads, and the version that reads it, by name."""
    if not isinstance(key, Mapping):
        return {}
    parts = {name: hashlib.sha256(files.canonical(value).encode()) for name, value in key.items()}
    return {name: part.hexdigest() for name, part in parts.items()} | {"version": __version__}


def refuse_unfinished(folder: Path, command: str) -> None:
    """Raise AegisError for the folder of a job that has not yet written its table.

    Args:
        command: the command that was given the folder, and which also accepts its runs.
    """
    if not (folder / SHARED).is_file():
        return
    runs = sorted(path.parent for path in folder.glob("*/recipe.yaml"))
    fix = "run the same aegis run again, which resumes the job"
    if runs:
        fix += f"; meanwhile one of its runs: {commands.aegis(command, *runs[:1])}"
    raise AegisError(
        f"the job in '{folder}' is not finished: it has no table of all methods yet",
        "a finished job, or a run",
        fix,
    )


def _load(path: Path) -> dict[str, Any]:
    """The records of a file.

    Raises:
        AegisError: the file holds something else.
    """
    records = files.load_json(path)
    try:
        for noted in records.values():
            key, outputs = noted["key"], noted["outputs"]
            if not all(isinstance(text, str) for text in (key, *outputs, *outputs.values())):
                raise TypeError("a digest that is no text")
    except (AttributeError, TypeError, KeyError) as error:
        raise AegisError(
            f"'{path}' is damaged: {error}",
            "the records of `aegis run`",
            f"rm '{path}', then run the same command again; what it says is made anew",
        ) from error
    return records


class Made(NamedTuple):
    """A file that several runs read."""

    path: Path
    sha256: str


def _recording(task: str, settings: Demos) -> dict[str, Any]:
    """The key of recorded demonstrations: what they depend on."""
    return {"task": task, **recipes.changed(settings)}


def _recorded_as(task: str, key: Mapping[str, Any]) -> str:
    """The name of their file, which differs by task and settings."""
    # A slash, as in `suite/cartpole-swingup`, would make a folder.
    return f"demos-{task.replace('/', '-')}-{digest(key)[:8]}"


class StageRecords:
    """Which stages below a folder are up to date.

    A stage is named by its run's label and its own name, `naive/train`; shared stages have no
    label. Each run has its own file of records below `stages`, and the shared ones are in
    `stages.json`, so processes working on different runs do not write the same file.
    """

    def __init__(self, folder: Path, on_event: OnEvent) -> None:
        self.folder, self.on_event = folder, on_event
        self._records: dict[Path, dict[str, Any]] = {}
        self._shared: dict[str, Made] = {}

    def fresh(
        self, stage: str, key: Any, outputs: list[Path], make: Callable[[OnEvent], object]
    ) -> None:
        """Call `make` unless the stage ran with an equal key and its outputs are unchanged."""
        if self.due(stage, key, outputs) is None:
            self.on_event(Progress(f"{stage} (up to date)", 1, 1, "stage"))
            return
        # Recorded only afterwards: an interrupted stage is not up to date.
        make(self.named(stage))
        self.keep(stage, key, outputs)

    def due(self, stage: str, key: Any, outputs: list[Path]) -> str | None:
        """The reason why a stage has to run; None if it is up to date."""
        before = self.key_of(stage)
        if before is None:
            return "has not run yet"
        if before != digest(key):
            changed = self.changed(stage, key) or ["keys of the recipe, files or the version"]
            return f"what it reads has changed: {', '.join(changed)}"
        # The key first, because the outputs may be gigabytes.
        kept, found = self._record(stage)["outputs"], self._hashes(outputs)
        for name in sorted(kept.keys() | found.keys()):
            if name not in found:
                return f"{name} is missing"
            if found[name] != kept.get(name):
                return f"{name} has changed"
        return None

    def shared(self, name: str, key: Any, make: Callable[[Path, OnEvent], object]) -> Made:
        """A safetensors file that several runs read, made unless it is up to date."""
        if name not in self._shared:
            out = self.folder / f"{name}.safetensors"
            self.fresh(name, key, [out], lambda on_event: make(out, on_event))
            self._shared[name] = Made(out, self._record(name)["outputs"][out.name])
        return self._shared[name]

    def demonstrations(self, task: str, settings: Demos, name: str | None = None) -> Made:
        """Demonstrations of a simulated task, recorded unless they are up to date.

        Args:
            name: of their file; default: one that depends on task and settings.
        """
        key = _recording(task, settings)

        def make(out: Path, on_event: OnEvent) -> object:
            return record.run(
                task,
                settings.episodes,
                settings.seed,
                out,
                settings.noise,
                on_event=on_event,
                drop_below=settings.drop_below,
            )

        return self.shared(name or _recorded_as(task, key), key, make)

    def recorded(self, task: str, settings: Demos) -> Path:
        """The path at which `demonstrations` keeps those of a task, whether or not it exists."""
        return self.folder / f"{_recorded_as(task, _recording(task, settings))}.safetensors"

    def key_of(self, stage: str) -> str | None:
        """Digest of what the stage read when it ran; None if it never did."""
        return self._record(stage).get("key")

    def changed(self, stage: str, key: Any) -> list[str]:
        """The names of the stage's inputs that have changed since it ran, as far as is known."""
        then, now = self._record(stage).get("parts", {}), _parts(key)
        return sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name))

    def keep(self, stage: str, key: Any, outputs: list[Path]) -> None:
        """Record that the stage has run."""
        label, parts = stage.rpartition("/")[0], _parts(key)
        noted = {"key": digest(key), "outputs": self._hashes(outputs)}
        self._of(label)[stage] = noted | ({"parts": parts} if parts else {})
        files.make_folder(self._path(label).parent)
        files.save_json(self._path(label), self._of(label))

    def begin_anew(self) -> None:
        """Let every stage run again, but keep the record that `aegis run` began a run."""
        for path in [self._path(""), *sorted((self.folder / "stages").rglob("*.json"))]:
            if path.is_file():
                begun = [stage for stage in _load(path) if stage.endswith(f"/{BEGUN}")]
                # No digest is an empty string, so no stage's key is equal to it.
                files.save_json(path, {stage: {"key": "", "outputs": {}} for stage in begun})
        self._records.clear()

    def forget(self, stage: str) -> None:
        """Drop the record of a stage; the file changes when its label's next record is written."""
        self._of(stage.rpartition("/")[0]).pop(stage, None)

    def named(self, stage: str) -> OnEvent:
        """Forward a stage's events under its run's label: `aegis/train`, not `train`."""
        label, slash, _ = stage.rpartition("/")
        return lambda event: self.on_event(
            dataclasses.replace(event, stage=label + slash + event.stage)
        )

    def _of(self, label: str) -> dict[str, Any]:
        path = self._path(label)
        if path not in self._records:
            self._records[path] = _load(path) if path.exists() else {}
        return self._records[path]

    def _record(self, stage: str) -> dict[str, Any]:
        return self._of(stage.rpartition("/")[0]).get(stage, {})

    def _path(self, label: str) -> Path:
        return self.folder / "stages" / f"{label}.json" if label else self.folder / SHARED

    def _hashes(self, outputs: list[Path]) -> dict[str, str]:
        """sha256 of each output that exists; a missing one counts as a difference."""
        return {
            str(p.relative_to(self.folder)): files.sha256_file(p) for p in outputs if p.is_file()
        }
