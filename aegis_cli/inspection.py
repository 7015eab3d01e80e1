"""Say what a file, run or dataset is.

The inspection of a run or ledger tells how much gradient energy each layer shed, and when; that of
a stream's run tells which experts were used and which were pruned, per task and map.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.anchors import anchor_file
from aegis_cli.common import artifacts, files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.continual import files as stream_files
from aegis_cli.continual.report import StreamReport
from aegis_cli.core import ledger
from aegis_cli.core.spectrum import Spectrum, rank
from aegis_cli.data.lerobot import dataset
from aegis_cli.data.lerobot.summary import FeatureInfo, dataset_facts, dataset_features
from aegis_cli.evaluation import results
from aegis_cli.evaluation.results import Result
from aegis_cli.models import backbones
from aegis_cli.models.backbones import model_folder
from aegis_cli.models.backbones.families import FAMILIES
from aegis_cli.training import checkpoint, folder

BINS = 64  # parts of a run's steps in `over_time`
ENERGIES = (0.9, 0.99, 0.999)  # shares of the energy in `SiteSpectrum.kept`


@dataclass(frozen=True)
class TensorInfo:
    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str


@dataclass(frozen=True)
class LayerEnergy:
    """One parameter group over all steps.

    Attributes:
        energy_shed, energy_shed_max: mean and largest share of the gradient's energy that was shed.
        conflict: share of the steps in conflict.
    """

    name: str
    energy_shed: float
    energy_shed_max: float
    conflict: float


@dataclass(frozen=True)
class LayerMoments:
    """One layer of an anchor, in activation units.

    Attributes:
        mean_norm: |mean|.
        variance_trace: trace of the (diagonal) covariance.
    """

    name: str
    mean_norm: float
    variance_trace: float


@dataclass(frozen=True)
class SiteSpectrum:
    """What one map reads on questions, or how much their answers mind what it reads and writes.

    Attributes:
        size: directions of its inputs, or outputs; of a table, rows.
        kept: how many of them hold each share of `ENERGIES` of the energy; of a table, the rows
            that are read.
        stored: eigenvectors in the file; None for a table, whose directions are its rows.
    """

    name: str
    kind: str
    size: int
    kept: tuple[int, ...]
    stored: int | None


@dataclass(frozen=True)
class Bin:
    """The steps from `first_step` to `last_step`, and the energy shed in them.

    Attributes:
        energy_shed: mean over all groups.
        layers: mean per group.
    """

    first_step: int
    last_step: int
    energy_shed: float
    layers: tuple[float, ...]


@dataclass(frozen=True)
class InspectReport:
    """What is known of a path; what does not apply to its kind is empty or None.

    Attributes:
        kind: what the path is.
        facts: what is said of it in one line each.
        energy_shed_mean: None, with `layers` and `over_time` empty, where no anchor gradient was
            taken.
        probes, rollouts: what was measured of a run's last checkpoint.
        gate: whether the drop is within the run's `probe.max_drop` or `--max-drop`.
    """

    kind: str
    path: str
    facts: dict[str, Any]
    tensors: tuple[TensorInfo, ...] = ()
    moments: tuple[LayerMoments, ...] = ()
    inputs: tuple[SiteSpectrum, ...] = ()
    curvature: tuple[SiteSpectrum, ...] = ()
    features: tuple[FeatureInfo, ...] = ()
    layers: tuple[LayerEnergy, ...] = ()
    over_time: tuple[Bin, ...] = ()
    energy_shed_mean: float | None = None
    loss: float | None = None
    validation_loss: float | None = None
    probes: tuple[Result, ...] = ()
    rollouts: tuple[Result, ...] = ()
    gate: bool | None = None

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class StreamInspection:
    """The finished run of a stream, and where it lies."""

    kind: str
    path: str
    report: StreamReport

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def run(path: Path, on_event: OnEvent = ignore) -> InspectReport | StreamInspection:
    """Recognise `path`: an embedded model's name, an artifact file, a run or a dataset.

    Only an artifact's header is read, unless figures need the tensors. It is done at once, so
    `on_event` (there as in every stage) is never called.

    Raises:
        AegisError: nothing there, nothing we know, damaged, a run without a ledger yet, or a stream
            that is not learned to its end.
    """
    path = backbones.locate(str(path)) if str(path) in backbones.SHIPPED else Path(path)
    return _folder(path) if path.is_dir() else _file(path)


def verify(path: Path) -> dict[Path, bool]:
    """Read every artifact at a path or in a folder whole; models of other programs are left out.

    Returns:
        The files, and whether each has a digest, with which it then agrees.

    Raises:
        AegisError: a damaged file, or no artifact at all.
    """
    path = backbones.locate(str(path)) if str(path) in backbones.SHIPPED else Path(path)
    if not path.is_dir():
        return {path: artifacts.load(path).header.digest is not None}
    # Copies and links of one checkpoint are one file.
    listed = {file.resolve(): file for file in sorted(path.rglob("*.safetensors"))}
    found = {}
    for file in listed.values():
        if artifacts.is_artifact(file):
            found[file] = artifacts.load(file).header.digest is not None
    if not found:
        raise AegisError(
            f"no artifact of Aegis in '{path}'", "a file or folder that it wrote", "check the path"
        )
    return found


def _file(path: Path) -> InspectReport:
    if path.is_file() and path.suffix != ".safetensors" and not _is_safetensors(path):
        found = f"'{path}' is " + (
            f"a {path.suffix} file" if path.suffix else "a file that Aegis does not know"
        )
        fix = "give the artifact itself, or the folder that it lies in; a recipe ends in .yaml"
        raise AegisError(
            found, "a .safetensors file, or the folder of a run, study, dataset or model", fix
        )
    header = artifacts.read_header(path)
    figures = {"anchor": _anchor_figures, "ledger": _ledger_figures}.get(header.kind, lambda _: {})
    tensors = tuple(
        TensorInfo(name, spec.shape, spec.dtype, spec.unit) for name, spec in header.tensors.items()
    )
    return InspectReport(header.kind, str(path), _header_facts(header), tensors, **figures(path))


def _is_safetensors(path: Path) -> bool:
    """Whether a file of another name begins as those do: the header's length, then JSON."""
    with files.reading(path, "check the path"), open(path, "rb") as file:
        return file.read(9)[8:] == b"{"


def _header_facts(header: artifacts.Header) -> dict[str, Any]:
    known = {
        "schema": header.schema,
        "version": header.version,
        "seed": header.seed,
        "fingerprint": header.fingerprint,
    }
    return {
        k: v
        for k, v in (known | {"inputs": header.inputs or None} | header.meta).items()
        if v is not None
    }


def _anchor_figures(path: Path) -> dict[str, Any]:
    anchor = anchor_file.from_artifact(artifacts.load(path, "anchor"))
    moments = (
        _moments(f"layers.{i} {kind}", layers[i].mean, layers[i].var)
        for i in range(len(anchor.image))
        for kind, layers in (("image", anchor.image), ("text", anchor.text))
    )
    inputs, curvature = (
        tuple(_site(*item) for item in part.items()) for part in (anchor.inputs, anchor.curvature)
    )
    return {"moments": tuple(moments), "inputs": inputs, "curvature": curvature}


def _site(name: str, spectrum: Spectrum) -> SiteSpectrum:
    values, vectors = spectrum.values, spectrum.vectors
    if vectors is None:
        read = int((values > 0).sum())
        return SiteSpectrum(name, spectrum.kind, len(values), (read,) * len(ENERGIES), None)
    stored = vectors.shape[1] if vectors.ndim == 2 else values.numel()
    return SiteSpectrum(
        name, spectrum.kind, values.numel(), tuple(rank(values, e) for e in ENERGIES), stored
    )


def _moments(name: str, mean: Tensor, var: Tensor) -> LayerMoments:
    return LayerMoments(name, float(mean.double().norm()), float(var.double().sum()))


def _ledger_figures(path: Path, until: int | None = None) -> dict[str, Any]:
    """The energies of a ledger over all steps, or over those up to one."""
    artifact = artifacts.load(path, "ledger")
    tensors, groups = artifact.tensors, artifact.header.meta["groups"]
    if until is not None:
        tensors = {name: rows[tensors["step"] <= until] for name, rows in tensors.items()}
    if not tensors["aa"].any():  # no anchor gradient was ever taken: nothing could be shed
        return {}
    layers = (
        LayerEnergy(g.name, g.energy_shed_mean, g.energy_shed_max, g.conflict)
        for g in ledger.summarize_groups(groups, tensors)
    )
    mean = ledger.energy_shed_mean(tensors)
    return {
        "layers": tuple(layers),
        "over_time": _over_time(groups, tensors),
        "energy_shed_mean": mean,
    }


def _over_time(groups: list[str], tensors: Mapping[str, Tensor]) -> tuple[Bin, ...]:
    """The rows in at most `BINS` parts of (almost) equal length."""
    count = len(tensors["step"])
    edges = sorted({round(i * count / BINS) for i in range(BINS + 1)})
    return tuple(_bin(groups, {k: v[a:b] for k, v in tensors.items()}) for a, b in pairwise(edges))


def _bin(groups: list[str], rows: Mapping[str, Tensor]) -> Bin:
    layers = tuple(g.energy_shed_mean for g in ledger.summarize_groups(groups, rows))
    return Bin(int(rows["step"][0]), int(rows["step"][-1]), ledger.energy_shed_mean(rows), layers)


def _folder(path: Path) -> InspectReport | StreamInspection:
    if recipes.is_stream_run(path):
        report = stream_files.read(path)
        return StreamInspection(report.kind, str(path), report)
    if (path / "recipe.yaml").is_file():
        return _run_folder(path)
    if checkpoint.is_one(path) and (run := checkpoint.run_of(path)) is not None:
        return _run_folder(run, path)
    if (path / "meta").is_dir():
        found = dataset.load(path)
        return InspectReport(
            "dataset", str(path), dataset_facts(found), features=dataset_features(found)
        )
    if model_folder.is_policy(path):
        return _file(path / "model.safetensors")
    for inside in (path, path / "backbone"):
        if model_folder.is_model(inside):
            return _hub_model(inside)
        if (inside / "model.safetensors").is_file():
            return _file(inside / "model.safetensors")
    runs = sorted(p.parent for p in path.glob("*/recipe.yaml")) + sorted(path.glob("*.safetensors"))
    example = next(iter(runs), "runs/<recipe>/<method>")
    expected = "a run, a LeRobot dataset, a model or a .safetensors file"
    raise AegisError(
        f"{path} is neither a run nor an artifact", expected, f"aegis inspect {example}"
    )


def _hub_model(path: Path) -> InspectReport:
    """A folder of the Hugging Face hub's layout, by its configuration and its weights' headers."""
    config = files.load_json(path / "config.json")
    if not isinstance(config, dict) or not isinstance(config.get("model_type"), str):
        found = f"'{path / 'config.json'}' without a model_type"
        raise AegisError(
            found, "the configuration of a Hugging Face model", "download the model again"
        )
    inner = config.get("text_config")
    text = inner if isinstance(inner, dict) else config
    named = {
        "layers": "num_hidden_layers",
        "width": "hidden_size",
        "heads": "num_attention_heads",
        "key_heads": "num_key_value_heads",
        "vocabulary": "vocab_size",
    }
    tensors = tuple(info for file in model_folder.weights(path) for info in _tensor_infos(file))
    facts = {"family": config.get("model_type"), "known": config.get("model_type") in FAMILIES}
    facts |= {"parameters": sum(math.prod(t.shape) for t in tensors)} | {
        name: text.get(key) for name, key in named.items()
    }
    return InspectReport(
        "hugging-face-model", str(path), {k: v for k, v in facts.items() if v is not None}, tensors
    )


def _tensor_infos(file: Path) -> Iterator[TensorInfo]:
    try:
        with safe_open(file, framework="pt") as opened:
            for name in sorted(opened.keys()):
                part = opened.get_slice(name)
                yield TensorInfo(name, tuple(part.get_shape()), part.get_dtype(), "1")
    except (SafetensorError, OSError) as error:
        found = f"'{file}' is truncated or not a safetensors file ({error})"
        raise AegisError(found, "a complete file", "download it again") from error


def _run_folder(path: Path, at: Path | None = None) -> InspectReport:
    """A run, or, as it was then, at one of its checkpoints."""
    settings = recipes.load(path / "recipe.yaml")
    file = path / "ledger.safetensors"
    if not file.is_file():
        fix = f"continue it: aegis train {path / 'recipe.yaml'} --out {path} --resume ..."
        raise AegisError(
            f"{path} has no ledger.safetensors", "a run with at least one checkpoint", fix
        )
    until = None if at is None else checkpoint.step_of(at)
    header, metrics = artifacts.read_header(file), _last_metrics(path, until)
    checkpoints = sorted(p.name for p in (path / "checkpoints").glob("*") if p.name.isdigit())
    which = (
        {"checkpoints": checkpoints}
        if until is None
        else {"run": str(path), "checkpoint": f"{until:06d}"}
    )
    facts = {
        "method": header.meta.get("method"),
        "task": header.meta.get("task", settings.task),
        "recipe": settings.name,
        "seed": settings.seed,
        "steps": metrics.get("step") if until is None else until,
        "fingerprint": header.fingerprint,
        **which,
        "loss": metrics.get("loss"),
        "validation_loss": metrics.get("validation_loss"),
    }
    if merged := _merged(path / "checkpoints" / checkpoint.LAST if at is None else at):
        facts["merge"] = merged
    if cameras := header.meta.get("cameras", settings.demos.camera):
        facts["cameras"] = cameras
    losses = {name: metrics.get(name) for name in ("loss", "validation_loss")}
    energies = _ledger_figures(file, until)
    if at is not None:
        return InspectReport("checkpoint", str(at), facts, **losses, **energies)
    probed = tuple(_without_pictures(found) for found in results.probes(path))
    return InspectReport(
        "run",
        str(path),
        facts,
        **losses,
        **energies,
        probes=probed,
        rollouts=tuple(results.rollouts(path)),
        gate=results.gate(probed, settings.probe.max_drop),
    )


def _without_pictures(found: Result) -> Result:
    """A probe without the images of its wrong answers, which a report shows."""
    return dataclasses.replace(
        found, figures={name: value for name, value in found.figures.items() if name != "wrong"}
    )


def _merged(at: Path) -> dict[str, Any] | None:
    """How `aegis merge` made a checkpoint; None of any other, and where a study has removed it."""
    expert = at / checkpoint.EXPERT
    return artifacts.read_header(expert).meta.get("merge") if expert.is_file() else None


def _last_metrics(path: Path, until: int | None) -> dict[str, Any]:
    """The latest value of each figure of a run, or of its beginning."""
    rows = [row for row in folder.read_metrics(path) if until is None or row["step"] <= until]
    return {name: value for row in rows for name, value in row.items() if value is not None}
