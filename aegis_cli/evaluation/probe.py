"""`aegis probe`: what the VLM still knows, on questions about images that nothing else has used."""

from __future__ import annotations

import collections
import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from aegis_cli.anchors import anchor_file, moments
from aegis_cli.common import artifacts, devices, files
from aegis_cli.common.errors import AegisError, check_finite
from aegis_cli.common.events import OnEvent, Warned, ignore, loading_told
from aegis_cli.common.ranks import ALONE, Ranks, joined
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.moments import merge
from aegis_cli.core.transport import w2_diag
from aegis_cli.data.vqa import easy, knowledge, sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.gate import MEAN, passes
from aegis_cli.data.vqa.metrics import Graded, by_family, drop_interval, prediction, score
from aegis_cli.evaluation import kept_answers, results, wrong_answers
from aegis_cli.models import backbones
from aegis_cli.models.asking import ask
from aegis_cli.models.backbones import preparation
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.training import checkpoint
from aegis_cli.training.folder import METRICS

PROBE_SEED = 0
W2_QUESTIONS = 1000  # moments over about 75,000 tokens; more change only the third digit


@dataclass(frozen=True)
class FamilyReport:
    """One family of questions; shares in [0, 1]."""

    accuracy: float
    interval: tuple[float, float]
    questions: int
    majority: float
    baseline_accuracy: float | None


@dataclass(frozen=True)
class LayerW2:
    """Squared W2 distance between the anchor and the model's activations at one layer.

    `baseline_w2` is the baseline's own distance on the same questions. It is not 0, since the
    anchor was measured on other questions; what `w2` exceeds it by is drift. None without a
    baseline.
    """

    layer: str
    w2: float
    baseline_w2: float | None = None


@dataclass(frozen=True)
class ProbeReport:
    """What a probe found.

    Accuracy is in [0, 1] with its 95 % interval, cross-entropy in nats per answer, and the drop in
    percentage points.

    The soft accuracy is for questions answered by people, so None for scenes; `skipped` counts bad
    questions that were left out. If the anchor was not measured on the probe's question set,
    `w2_between` names both: part of W2 is then due to that difference. `asked` holds the settings
    of the command.
    """

    accuracy: float
    interval: tuple[float, float]
    cross_entropy: float
    majority: float
    baseline_accuracy: float | None
    baseline_cross_entropy: float | None
    drop_points: float | None
    drop_interval: tuple[float, float] | None
    families: dict[str, FamilyReport]
    layers: list[LayerW2]
    questions: int
    passed: bool | None
    soft_accuracy: float | None = None
    soft_interval: tuple[float, float] | None = None
    baseline_soft_accuracy: float | None = None
    skipped: int = 0
    w2_between: str | None = None
    asked: dict[str, Any] | None = field(default=None, compare=False)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def run(
    target: str,
    vqa: str,
    questions: int,
    baseline: str | None,
    anchor: Path | None,
    max_drop: float | None,
    batch_size: int = 64,
    gate: str = MEAN,
    predictions: Path | None = None,
    skip_bad: bool = False,
    keep: bool = False,
    on_event: OnEvent = ignore,
    ask: str = sets.PLAIN,
    seed: int = PROBE_SEED,
    only_if_own: bool = False,
) -> ProbeReport:
    """Ask `target` probe questions and, to measure the drop, `baseline` too.

    If torchrun has started several processes, each calls this, and they share the questions.

    Args:
        questions: number of questions; files may hold fewer.
        gate: what `max_drop` limits: MEAN, the drop as measured, or UPPER, the upper end of its
            95 % interval.
        predictions: also write every answer of `target` there, one line of JSON per answer.
        skip_bad: leave out bad questions of files and count them.
        keep: write the report into the run's folder, if `target` is a run or one of its
            checkpoints.
        ask: template of the prompt, with {} for the question.
        seed: seed of the choice of questions.
        only_if_own: leave out a baseline that is no longer the model from which `target` started,
            with a warning; otherwise it is asked, also with a warning.

    Raises:
        AegisError: nothing to load, a bad question, or an anchor that does not belong to the
            baseline.
    """
    source = sets.read(vqa, skip_bad, on_event, ask)
    if predictions is not None:
        models = [name for name in (target, baseline) if name is not None]
        _check_predictions(predictions, source.files, models, anchor)
    with loading_told("probe", on_event):
        loaded = kept_answers.load(target)
        reference_model = None if baseline is None else kept_answers.load(baseline)
    model = loaded.model
    if reference_model is not None and _is_another_start(target, reference_model.model):
        _warn_of_another_start(target, baseline, only_if_own, on_event)
        if only_if_own:
            reference_model = baseline = None
    before = None if reference_model is None else reference_model.model
    if before is not None:
        check_preparation(target, baseline, model, before, max_drop, "probe", on_event)
    measured = None if anchor is None else _anchor(anchor, target, model, baseline, before)
    # Both models have to read every question, since the drop compares the same questions.
    checks = [m.check_text for m in (model, before) if m is not None]
    asked = source.choose("probe", questions, seed, checks, on_event)
    with joined() as ranks:
        # The models take turns: each is on the device only while it answers.
        after, now = _answered(loaded, asked, measured, batch_size, ranks, on_event)
        reference, then = None, None
        if reference_model is not None:
            of_baseline = _of_baseline(on_event)
            reference, then = _answered(
                reference_model, asked, measured, batch_size, ranks, of_baseline
            )
    layers = _layers(now, then)
    between = None if anchor is None else two_sets(anchor, source.name, ask)
    if between is not None and anchor is not None and layers:
        _warn_of_another_prompt(anchor, source.name, ask, on_event)
    settings = {"vqa": vqa, "ask": ask, "questions": questions, "seed": seed}
    settings |= {"baseline": baseline, "max_drop": max_drop, "gate": gate}
    report = compare(after, reference, layers, max_drop, asked.skipped, between, gate)
    told = {"target": target, **settings, "anchor": None if anchor is None else str(anchor)}
    report = replace(report, asked=told)
    known = target if baseline is None else baseline
    warn_of_little_knowledge(report, known, ask, "probe", on_event)
    warn_of_few_questions(report.questions, report.drop_interval, max_drop, "probe", on_event)
    if predictions is not None and ranks.first:
        files.save_json_lines(
            predictions, (prediction(graded, i) for i, graded in enumerate(after))
        )
    if keep and ranks.first:
        wrong = {"wrong": wrong_answers.examples(after, asked, model.image_size)}
        name = f"probe-{source.name}"
        figures = report.to_json() | by_image(after, reference, asked.names) | wrong
        del figures["asked"]  # the settings contain it
        settings |= _path_of(vqa)
        results.keep_if_possible(Path(target), name, figures, settings, on_event)
    return report


def _check_predictions(
    predictions: Path, questions: Sequence[Path], models: Sequence[str], anchor: Path | None
) -> None:
    """Raise AegisError unless `predictions` can be written and is not a file that is read."""
    files.check_writable(predictions)
    read = [*questions, *([] if anchor is None else [anchor])]
    for name in models:
        read += backbones.model_files(name)
        run_folder = results.run_of(Path(name))
        if run_folder is not None:
            own = (path for path in run_folder.rglob("*") if path.is_file())
            # Predictions of an earlier probe may be among the run's own files.
            read += [path for path in own if path.suffix != ".jsonl" or path.name == METRICS]
    files.check_apart("--predictions", predictions, read)


def _path_of(vqa: str) -> dict[str, str]:
    """The path of a question set, or its id on the hub; empty for built-in sets."""
    if vqa in (sets.SCENES, easy.NAME):
        return {}
    is_here = Path(vqa).parent.is_dir()
    return {"path": str(Path(vqa).absolute()) if is_here else vqa}


def _of_baseline(on_event: OnEvent) -> OnEvent:
    """A listener that marks progress as the baseline's."""
    return lambda event: on_event(replace(event, stage=f"{event.stage} baseline"))


def _answered(
    loaded: kept_answers.Loaded,
    asked: VQASet,
    anchor: Anchor | None,
    batch_size: int,
    ranks: Ranks,
    on_event: OnEvent,
) -> tuple[list[Graded], list[float]]:
    """A model's graded answers, and its W2^2 per layer from an anchor, if there is one.

    The model is on the device only during this call, since two models may not fit.
    """
    model = loaded.model.to(devices.pick())
    graded = kept_answers.ask(loaded, asked, batch_size, ranks, on_event)
    found = [] if anchor is None else _distances(model, asked, anchor, batch_size, ranks)
    model.to("cpu")
    return graded, found


def warn_of_little_knowledge(
    report: ProbeReport, model: str, ask: str, stage: str, on_event: OnEvent
) -> None:
    """Warn if the model could not answer the questions before either; `ask` is the prompt."""
    before = report.accuracy if report.baseline_accuracy is None else report.baseline_accuracy
    knowledge.warn_if_little(before, report.majority, model, ask, stage, on_event)


def warn_of_few_questions(
    questions: int,
    drop_interval: tuple[float, float] | None,
    max_drop: float | None,
    stage: str,
    on_event: OnEvent,
    fix: str = "Ask more (--questions, probe.questions of a recipe, or a larger set)",
) -> None:
    """Warn if there are too few questions to measure the drop as finely as its gate requires.

    A drop far from the gate needs few questions. For a gate of 0 points no number is enough.

    Args:
        fix: how to ask more questions.
    """
    if not max_drop or drop_interval is None:
        return
    low, high = drop_interval
    apart = (high - low) / 2
    # Fine enough for the gate, or the interval lies entirely on one side of it.
    if apart <= max_drop or not low <= max_drop <= high:
        return
    text = (
        f"{questions:,} questions measure the drop to ±{apart:.2f} points, too coarsely for a "
        f"gate at {max_drop:g}: whether it passes depends on chance, or on how few they are. "
        f"{fix}, or allow a larger drop"
    )
    on_event(Warned(stage, text))


def check_preparation(
    target: str,
    baseline: str | None,
    model: Backbone,
    before: Backbone,
    max_drop: float | None,
    stage: str,
    on_event: OnEvent,
) -> None:
    """Warn if two models make different inputs of the same questions.

    Raises:
        AegisError: they do, and a gate would judge the training by the drop.
    """
    other = preparation.differing(model.preparation(), before.preparation())
    if other is None:
        return
    found = (
        f"'{target}' prepares images or text differently from its baseline '{baseline}': {other}"
    )
    fix = (
        "give both the same files of the processor (e.g. preprocessor_config.json; a run has its "
        "own in checkpoints/last/backbone)"
    )
    if max_drop is not None:
        raise AegisError(
            found,
            f"the same settings for a gate (--max-drop {max_drop:g}), which judges what the "
            "training has cost",
            fix,
        )
    text = f"{found}. So a drop is not that of the weights alone: {fix}"
    on_event(Warned(stage, text))


def _is_another_start(target: str, before: Backbone) -> bool:
    """Whether neither a run nor a run before it started from this model; False for other targets.

    A digest of billions of weights takes as long as many answers.
    """
    folder = Path(target)
    if not folder.is_dir() or not (checkpoint.is_one(folder) or checkpoint.begun(folder)):
        return False
    return before.fingerprint() not in _begun_from(folder)


def _warn_of_another_start(
    target: str, baseline: str | None, is_left_out: bool, on_event: OnEvent
) -> None:
    """Warn that a run is compared, or for that reason not compared, with another model."""
    text = (
        f"--baseline {baseline} is not the model that '{target}' began from: the drop is a "
        "difference between two models, not what this training has cost"
    )
    if is_left_out:
        text = (
            f"only the accuracy is measured, and no drop: '{baseline}' is no longer the model "
            f"that '{target}' began from"
        )
    on_event(Warned("probe", text))


def _begun_from(folder: Path) -> set[str | None]:
    """Digests of the models that a run or checkpoint started from, and the runs before it."""
    header = artifacts.read_header(checkpoint.chosen(folder) / checkpoint.EXPERT)
    run = results.run_of(folder)
    before = [] if run is None else results.origins(run)
    return {header.inputs.get("backbone"), *(origin.digest for origin in before)}


class Answers(NamedTuple):
    """A model's answers, and its drift, which is empty if no anchor was given.

    Attributes:
        image_size: side in pixels of the images that the model was shown; None: their own size.
    """

    graded: list[Graded]
    layers: list[LayerW2]
    image_size: int | None


def answers(
    target: str,
    asked: VQASet,
    batch_size: int,
    anchor: tuple[Path, anchor_file.Wanted] | None = None,
    on_event: OnEvent = ignore,
) -> Answers:
    """Ask a run or backbone, and measure its drift from an anchor.

    If torchrun has started several processes, each calls this, and they share the questions.

    Args:
        anchor: its file, and the backbone that it must belong to.

    Raises:
        AegisError: nothing to load, or an anchor of another backbone.
    """
    with joined() as ranks:
        model = backbones.load(target).to(devices.pick())
        graded = ask(model, asked, batch_size, on_event, ranks)
        layers = []
        if anchor is not None:
            path, wanted = anchor
            known = anchor_file.load(path, replace(wanted, prepares=model.preparation()))
            layers = drift(model, asked, known, batch_size, ranks)
    return Answers(graded, layers, model.image_size)


def _anchor(
    path: Path, target: str, model: Backbone, baseline: str | None, before: Backbone | None
) -> Anchor:
    """The anchor, which must be that of the pre-trained backbone.

    An anchor measured on a trained backbone would hide the drift.
    """
    if baseline is None or before is None:
        # Its own anchor is no help: the drift from that is none.
        wanted = anchor_file.Wanted(
            model.fingerprint(), target, "--baseline ", "", model.preparation()
        )
    else:
        wanted = anchor_file.Wanted(
            before.fingerprint(), baseline, "--baseline ", prepares=before.preparation()
        )
    measured = anchor_file.load(path, wanted)
    if not measured.image:
        fix = "measure it: aegis anchor --parts moments"
        raise AegisError("an anchor without moments", "one to measure the drift from", fix)
    return measured


def two_sets(anchor: Path, asked: str, prompt: str = sets.PLAIN) -> str | None:
    """Names the data of an anchor and the question set of a probe, if they differ.

    None if both are the same set with the same prompt, or if the anchor names no data.

    Args:
        prompt: template of the probe's prompt, with {} for the question.
    """
    meta = artifacts.read_header(anchor).meta
    frames = meta.get("demos")
    measured = meta.get("vqa", asked) if frames is None else f"robot frames of {frames}"
    if measured != asked:
        return f"{measured} and {asked}"
    measured_as = meta.get("ask", sets.PLAIN)
    if frames is not None or "vqa" not in meta or measured_as == prompt:
        return None
    return f"{asked} as '{measured_as}' and as '{prompt}'"


def _warn_of_another_prompt(anchor: Path, asked: str, prompt: str, on_event: OnEvent) -> None:
    """Warn about an anchor measured on the same questions with another prompt."""
    meta = artifacts.read_header(anchor).meta
    measured_as = meta.get("ask", sets.PLAIN)
    if meta.get("vqa") == asked and measured_as != prompt:
        text = (
            f"the questions of '{anchor}' were asked as '{measured_as}', and these as '{prompt}': "
            f"part of W2 is the prompt's own; probe with --ask {shlex.quote(measured_as)}"
        )
        on_event(Warned("probe", text))


def drift(
    model: Backbone, asked: VQASet, anchor: Anchor, batch_size: int, ranks: Ranks = ALONE
) -> list[LayerW2]:
    """W2^2 per layer between the anchor and the model's activations on the first probe questions.

    Image and text tokens are merged; if the anchor saw only text tokens, only those are compared.
    """
    return _layers(_distances(model, asked, anchor, batch_size, ranks), None)


def _layers(now: Sequence[float], then: Sequence[float] | None) -> list[LayerW2]:
    """W2^2 of a model by layer, with the baseline's."""
    baseline = [None] * len(now) if then is None else then
    pairs = zip(now, baseline, strict=True)
    return [LayerW2(f"layers.{i}", *both) for i, both in enumerate(pairs)]


def _distances(
    model: Backbone, asked: VQASet, anchor: Anchor, batch_size: int, ranks: Ranks
) -> list[float]:
    # The first questions, so that all models of one probe are measured on the same ones.
    head = asked.sized(model.image_size).part(slice(W2_QUESTIONS))
    batches, count = head.batches(batch_size), len(head.questions)
    image, text = moments.measure(model, batches, count, ranks=ranks)
    found = []
    for layer in zip(image, text, anchor.image, anchor.text, strict=True):
        image_now, text_now, image_then, text_then = layer
        if not image_then.count:  # the anchor's prompts had no images
            now, then = text_now, text_then
        else:
            now, then = merge(image_now, text_now), merge(image_then, text_then)
        # Both Gaussians are diagonal: W2^2 = |mean - mean'|^2 + |std - std'|^2.
        found.append(float(w2_diag(now.mean, now.var, then.mean, then.var)))
    return found


def compare(
    after: Sequence[Graded],
    before: Sequence[Graded] | None,
    layers: list[LayerW2],
    max_drop: float | None,
    skipped: int = 0,
    w2_between: str | None = None,
    gate: str = MEAN,
) -> ProbeReport:
    """The report on two sets of answers to the same questions.

    Raises:
        AegisError: `max_drop` without the baseline's answers.
    """
    total, families = score(after), by_family(after)
    reference = None if before is None else score(before)
    earlier = {} if before is None else by_family(before)
    drop = None if reference is None else 100 * (reference.accuracy - total.accuracy)
    if max_drop is not None and drop is None:
        raise AegisError(
            "--max-drop without --baseline",
            "a baseline to measure the drop against",
            "add --baseline embedded",
        )
    interval = None if before is None else _in_points(drop_interval(before, after))
    passed = None
    if max_drop is not None and drop is not None and interval is not None:
        passed = passes(drop, interval, max_drop, gate)
    by_name = {}
    for name, s in families.items():
        known_before = earlier[name].accuracy if earlier else None
        by_name[name] = FamilyReport(
            s.accuracy, s.interval, s.questions, s.majority, baseline_accuracy=known_before
        )
    return ProbeReport(
        accuracy=total.accuracy,
        interval=total.interval,
        cross_entropy=total.cross_entropy,
        majority=total.majority,
        baseline_accuracy=None if reference is None else reference.accuracy,
        baseline_cross_entropy=None if reference is None else reference.cross_entropy,
        drop_points=drop,
        drop_interval=interval,
        families=by_name,
        layers=layers,
        questions=total.questions,
        passed=passed,
        soft_accuracy=total.soft_accuracy,
        soft_interval=total.soft_interval,
        baseline_soft_accuracy=None if reference is None else reference.soft_accuracy,
        skipped=skipped,
        w2_between=w2_between,
    )


def by_image(
    after: Sequence[Graded], before: Sequence[Graded] | None, names: Sequence[str] | None
) -> dict[str, Any]:
    """The answers about each image, from which intervals over images are computed.

    `correct_per_image` counts the correct answers and `lost_per_image` those before minus those
    after, out of `questions_per_image`; images are in the order of their numbers in the set.

    Args:
        before: None leaves out what was lost.
        names: names of the set's images, which identify equal images of other sets (`images`);
            None: no other set shares them.
    """
    # By image, since its questions share its difficulty: the crossed bootstrap draws whole images.
    questions = collections.Counter(graded.image for graded in after)
    correct = collections.Counter(graded.image for graded in after if graded.correct)
    numbers = sorted(questions)
    found: dict[str, Any] = {"correct_per_image": [correct[number] for number in numbers]}
    if before is not None:
        known = collections.Counter(graded.image for graded in before if graded.correct)
        found["lost_per_image"] = [known[number] - correct[number] for number in numbers]
    found["questions_per_image"] = [questions[number] for number in numbers]
    found["images"] = None if names is None else [names[number] for number in numbers]
    return found


def check_trained(report: ProbeReport, steps: int) -> None:
    """Raise Diverged for a model that answers, but whose figures are not finite.

    Args:
        steps: number of its training steps.
    """
    figures = {
        "cross-entropy": report.cross_entropy,
        **{f"W2 of {layer.layer}": layer.w2 for layer in report.layers},
    }
    wrong = {name: value for name, value in figures.items() if not math.isfinite(value)}
    fix = "try a lower train.backbone_lr or train.expert_lr, or another method"
    check_finite(wrong, "on probe questions after the training", fix, steps)


def _in_points(interval: tuple[float, float]) -> tuple[float, float]:
    return 100 * interval[0], 100 * interval[1]
