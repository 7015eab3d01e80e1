"""A stream from end to end: what is never forgotten, what the figures mean, what is resumed."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from samples.graphs import outputs_kept
from samples.interrupted import at_each, stop
from samples.streams import STREAMS, TinyDual, recipe, task, write

from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.continual import files, images, learners, loop, probe, train
from aegis_cli.continual.images import ClassificationLoss, ImageEvaluator, ImageStreamRun
from aegis_cli.continual.report import (
    ImageStreamReport,
    SiteRouting,
    TaskRecord,
    history_mass,
    minutes,
)
from aegis_cli.core import gaussians
from aegis_cli.core.accuracy_matrix import scores
from aegis_cli.core.routing import activate
from aegis_cli.models.backbones.dual import class_weights
from aegis_cli.recipes import LEARNERS, Igsp, Inference, MoeAdapters, Sequential, StreamRecipe, load

pytestmark = pytest.mark.usefixtures("tiny_streams")

TASKS = STREAMS["small"]


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of every file except the metrics, which contain times."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file() and p.name != "metrics.jsonl"
    }


def logged(folder: Path) -> list[tuple[int, int]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [(line["task"], line["step"]) for line in lines]


def zero_shot(i: int) -> float:
    """Accuracy of the bare encoder on a task, computed by hand."""
    model, part = TinyDual(), TASKS[i].test
    with torch.no_grad():
        features = model.image_features(model.pixels(part.images(torch.arange(len(part)))))
        answers = (features @ class_weights(model, TASKS[i].classes, TASKS[i].templates).T).argmax(
            1
        )
    return (answers == part.labels).double().mean().item()


Done = Callable[[str], tuple[ImageStreamReport, Path]]
# two tasks, with a checkpoint at each step or every five
_OPTIONS = Igsp(rank=2, identify=0.5, check_every=2, checks=9, orthogonal=True)
STRICT = {
    f"strict-{n}": recipe("igsp", order=("one", "two"), checkpoint_every=n, igsp=_OPTIONS)
    for n in (1, 5)
}


@pytest.fixture(scope="module")
def done(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[str], tuple[ImageStreamReport, Path]]:
    """A finished run of each learner, and of `strict` settings of igsp; read-only."""
    made: dict[str, tuple[ImageStreamReport, Path]] = {}

    def get(name: str) -> tuple[ImageStreamReport, Path]:
        if name not in made:
            out = tmp_path_factory.mktemp("runs") / name
            made[name] = train.run(STRICT[name] if name in STRICT else recipe(name), out), out
        return made[name]

    return get


# --- what comes out -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", LEARNERS)
def test_a_stream_is_learned_and_its_files_say_what_the_report_says(
    done: Done, method: str
) -> None:
    report, out = done(method)
    learner = report.method
    assert learner == method and report.tasks == ("one", "two", "three")
    assert all(len(rows) == 3 == len(rows[0]) for rows in (report.oracle, report.inferred))
    assert report.scores == scores(report.oracle)
    assert report.inferred_scores == scores(report.inferred)
    assert files.read(out) == dataclasses.replace(report, minutes=minutes(out))
    matrix, counts = (
        json.loads((out / name).read_text()) for name in ("accuracy_matrix.json", "parameters.json")
    )
    assert matrix["oracle"] == [list(row) for row in report.oracle]
    assert matrix["scores"]["last"] == report.scores.last
    assert counts["parameters"] == report.parameters == sum(t["added"] for t in counts["tasks"])
    always = {
        "accuracy_matrix.json",
        "parameters.json",
        "stream.json",
        "recipe.yaml",
        "metrics.jsonl",
    }
    written = {p.name for p in out.iterdir()} - always
    own = {
        "nothing": set(),
        "model": {"encoder"},
        "experts": {"experts.safetensors", "routing.safetensors"},
    }
    assert written == own[learners.get(method).trains]


@pytest.mark.parametrize("method", LEARNERS)
def test_tasks_that_have_not_come_are_served_by_what_there_is(done: Done, method: str) -> None:
    report, _ = done(method)
    bare = [zero_shot(i) for i in range(3)]
    shared = learners.get(method).shared
    for t in range(3):
        for i in range(t + 1, 3):
            assert shared or report.oracle[t][i] == bare[i]
    if method == "zero-shot":
        assert report.oracle == (tuple(bare),) * 3 and report.parameters == report.trained == 0
    if shared:
        assert report.inferred == report.oracle and report.inference_parameters == 0


@pytest.mark.parametrize("method", ["isolated-lora", "igsp"])
def test_nothing_is_forgotten_with_the_task_told(done: Done, method: str) -> None:
    report, _ = done(method)
    assert report.scores.forgetting == 0
    assert all(report.oracle[t][i] == report.oracle[i][i] for i in range(3) for t in range(i, 3))


@pytest.mark.parametrize("method", ["isolated-lora", "igsp"])
def test_old_tasks_logits_are_bit_identical_after_later_tasks(
    done: Done, method: str, tmp_path: Path
) -> None:
    """For the first task alone, and as the first of three."""
    alone = recipe(method, order=("one",))
    train.run(alone, tmp_path / "alone")
    found = []
    for made, out in ((alone, tmp_path / "alone"), (recipe(method), done(method)[1])):
        run = train.build(made, out)
        files.attach(run)
        activate(run.sites, 0)
        pictures = TASKS[0].test.images(torch.arange(len(TASKS[0].test)))
        with torch.no_grad():
            features = run.encoder.image_features(run.encoder.pixels(pictures))
            found.append(
                features @ class_weights(run.encoder, TASKS[0].classes, TASKS[0].templates).T
            )
    assert torch.equal(*found)


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_training_teaches(precision: str, tmp_path: Path) -> None:
    """Isolated terms with enough steps beat the bare encoder on each task by a margin."""
    report = train.run(recipe("isolated-lora", steps=40, precision=precision), tmp_path / "run")
    assert all(report.oracle[i][i] > zero_shot(i) + 0.1 for i in range(3))
    assert len({r.trained for r in report.records}) == 1  # what an earlier task trained is frozen


def test_a_task_that_comes_again_adds_little(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Routing leads the same pictures and names to the existing experts.

    With `reuse: 0` it does so less.
    """
    names = tuple(f"thing {c}" for c in "abc")
    twins = tuple(
        dataclasses.replace(task(name, seed=1), classes=names) for name in ("one", "again")
    )
    monkeypatch.setitem(STREAMS, "twins", twins)
    added = {}
    for reuse in (0.0, 0.5):
        options = Igsp(rank=2, reuse=reuse, check_every=5, identify=0.6)
        learned = recipe("igsp", stream="twins", steps=60, checkpoint_every=60, igsp=options)
        report = train.run(learned, tmp_path / f"{reuse}")
        added[reuse] = report.records[1].added / report.records[0].added
    assert added[0.5] < 0.5 and added[0.5] < added[0.0]


@pytest.mark.parametrize("prune", [True, False])
def test_what_phase_1_decided_is_recorded(prune: bool, tmp_path: Path) -> None:
    options = Igsp(rank=2, identify=0.5, check_every=2, checks=2, prune=prune, kappa=0.99, load=0.6)
    report = train.run(recipe("igsp", igsp=options), tmp_path / "run")
    stored = artifacts.load(tmp_path / "run" / "experts.safetensors", "experts").tensors
    gone = 0
    for number, record in enumerate(report.records):
        assert 0 < record.phase1_steps <= 6
        assert record.trained_phase1 == sum(s.trained_phase1 for s in record.sites)
        assert record.trained == sum(s.trained for s in record.sites)
        for site in record.sites:
            gone += len(site.pruned)
            assert sum(site.mass) == pytest.approx(1)
            assert len(site.experts) == len(site.owners) == len(site.load)
            assert not {f"{site.site}.experts.{n}.a" for n in site.pruned} & stored.keys()
            assert {f"{site.site}.experts.{n}.a" for n in site.experts} <= stored.keys()
            assert all(owner <= number for owner in site.owners)
    assert (gone > 0) == prune
    assert (sum(t.numel() for t in stored.values()) < 3 * 2 * 2 * 2 * (32 + 48 + 48)) == prune


def test_phase_1_ends_when_the_routers_stand_still(tmp_path: Path) -> None:
    steps = {}
    for tolerance in (1.0, 0.0):
        options = Igsp(rank=2, identify=0.9, check_every=2, checks=2, tolerance=tolerance)
        report = train.run(
            recipe("igsp", order=("one", "two"), igsp=options), tmp_path / f"{tolerance}"
        )
        steps[tolerance] = [r.phase1_steps for r in report.records]
    assert steps == {
        1.0: [6, 6],
        0.0: [11, 11],
    }  # two quiet checks after the first; never, so its share of the steps ends it


def test_a_step_trains_and_a_measurement_does_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    modes: dict[str, set[bool]] = {"loss": set(), "calibration_loss": set()}
    for name, seen in modes.items():
        work = getattr(ClassificationLoss, name)

        def noted(
            self: ClassificationLoss, *args: object, work: Callable = work, seen: set[bool] = seen
        ) -> torch.Tensor:
            seen.add(self._encoder.training)
            return work(self, *args)

        monkeypatch.setattr(ClassificationLoss, name, noted)
    train.run(recipe("igsp"), tmp_path / "run")
    assert modes == {"loss": {True}, "calibration_loss": {False}}


@pytest.mark.parametrize("method", LEARNERS)
def test_no_graph_outlives_its_step(method: str, tmp_path: Path) -> None:
    made, kept = outputs_kept(lambda: train.run(recipe(method), tmp_path / "run"))
    assert kept == 0 and (made > 0 or learners.get(method).trains == "nothing")


def test_what_goes_on_learning_after_phase_1_keeps_its_moments(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    settle, seen = loop._settle, []

    def noted(run: ImageStreamRun, training: loop.TaskTraining, flows: object) -> None:
        before = {
            id(p): {k: v.clone() for k, v in state.items()}
            for p, state in training.optimizer.state.items()
        }
        settle(run, training, flows)
        learning = list(run.learning().values())
        assert set(training.optimizer.state) == set(learning)  # what is gone or frozen is forgotten
        for p in learning:
            now = training.optimizer.state[p]
            assert all(torch.equal(now[key], old) for key, old in before[id(p)].items())
            assert now["step"] == run.current.phase1_steps and now["exp_avg_sq"].any()
        seen.append(len(before) - len(learning))

    monkeypatch.setattr(loop, "_settle", noted)
    train.run(recipe("igsp", order=("one", "two")), tmp_path / "run")
    assert len(seen) == 2 and min(seen) > 0


def test_mass_on_history_is_of_maps_that_have_one() -> None:
    def site(name: str, owners: tuple[int, ...], mass: tuple[float, ...]) -> SiteRouting:
        return SiteRouting(name, tuple(range(len(owners))), owners, mass, mass, (), (), None, 0, 0)

    def learned(*sites: SiteRouting) -> TaskRecord:
        return TaskRecord("t", None, None, 0, 0.0, 0, None, None, None, sites)

    first, later = learned(site("old", (0,), (1.0,))), site("late", (1,), (1.0,))
    assert history_mass(first.sites, []) == []
    assert history_mass((site("old", (0, 1), (0.3, 0.7)), later), [first]) == [0.3]
    assert history_mass((site("old", (1,), (1.0,)), later), [first]) == [
        0.0
    ]  # it forgot all it had
    assert history_mass((site("old", (), ()), later), [first]) == []  # no loss reads it any more


def test_each_part_has_its_rate_and_linear_routers_one_of_their_own(tmp_path: Path) -> None:
    made = {"lr": 0.1, "router_lr": 0.2, "moe_adapters": MoeAdapters(rank=2, router_lr=0.3)}
    for method, expected in (("igsp", 0.2), ("prototype", 0.2), ("moe-adapters", 0.3)):
        run = train.build(recipe(method, **made), tmp_path)
        assert (run.rate("image.up.experts.0.a"), run.rate("image.up.routers.0.read")) == (
            0.1,
            expected,
        )


# --- which task is it? ----------------------------------------------------------------------------


def loaded(method: str, out: Path) -> tuple[ImageStreamRun, ImageEvaluator]:
    run = train.build(recipe(method), out)
    files.attach(run)
    return run, ImageEvaluator(run.encoder, run.sites, run.tasks, run.learner)


@pytest.mark.parametrize("method", ["isolated-lora", "igsp", "moe-adapters", "prototype"])
def test_inferred_is_told_where_inference_is_right_and_bare_where_it_says_none(
    done: Done, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    report, out = done(method)
    run, evaluator = loaded(method, out)
    asked = iter(range(3))
    with monkeypatch.context() as patch:
        patch.setattr(images, "infer", lambda f, g: torch.full((len(f),), next(asked)))
        told, inferred = evaluator.row(2, run.gaussians)
    assert told == inferred == list(report.oracle[2])
    assert evaluator.row(2, [])[1] == [zero_shot(i) for i in range(3)]
    wrong = torch.tensor([(j * 7) % 4 - 1 for j in range(30)])  # tasks and none, mixed
    with monkeypatch.context() as patch:
        patch.setattr(images, "infer", lambda f, g: wrong)
        _, mixed = evaluator.row(2, run.gaussians)
    for i, got in enumerate(mixed):
        by_hand = [
            evaluator._answers(i, None if k < 0 else run.learner.router(int(k)))[j]
            for j, k in enumerate(wrong)
        ]
        assert got == pytest.approx(
            (torch.stack(by_hand) == TASKS[i].test.labels).double().mean().item()
        )


def test_the_threshold_sends_images_to_the_bare_encoder(tmp_path: Path) -> None:
    strict = recipe("isolated-lora", order=("one",), inference=Inference(quantile=0.999))
    report = train.run(strict, tmp_path / "run")
    run, _ = loaded("isolated-lora", tmp_path / "run")
    chosen = gaussians.infer(
        ImageEvaluator(run.encoder, run.sites, TASKS, run.learner).looks(TASKS[0].test),
        run.gaussians,
    )
    assert (chosen == gaussians.NONE).double().mean() > 0.9
    width, rank = 16, 15  # of 16 requested; at most one less than the number of looks' entries
    assert report.inference_parameters == width + rank * width + rank + 2


@pytest.mark.parametrize(
    ("method", "passes"),
    [("igsp", 1 + 1 + 3), ("isolated-lora", 1 + 1 + 3), ("prototype", 1 + 2 + 3)],
)
def test_what_never_changes_is_computed_once_and_at_the_end(
    method: str, passes: int, done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frozen learner's task is answered once it has been learned, and again in the last row.

    The last row shows whatever has changed.
    """
    report, out = done(method)
    run, evaluator = loaded(method, out)
    monkeypatch.setattr(images, "infer", lambda f, g: torch.full((len(f),), gaussians.NONE))
    served = []
    work = evaluator._features
    monkeypatch.setattr(
        evaluator,
        "_features",
        lambda part, router, rows: (served.append(router), work(part, router, rows))[1],
    )
    rows = [evaluator.row(t, [])[0] for t in range(3)]
    assert rows[2] == list(report.oracle[2])
    assert len([router for router in served if router is not None]) == passes
    if run.learner.frozen:
        assert rows == [list(row) for row in report.oracle]
        for site in run.sites.values():
            site.routers["0"].scale.data.fill_(-50.0)
        assert evaluator.row(1, [])[0] == rows[1] and evaluator.row(2, [])[0] != rows[2]


# --- again from the files -------------------------------------------------------------------------


@pytest.mark.parametrize("method", LEARNERS)
def test_a_probe_of_the_files_gives_the_same_figures(done: Done, method: str) -> None:
    report, out = done(method)
    before = contents(out)
    (out / "accuracy_matrix.json").unlink()
    found = probe.run(out)
    assert found.largest_difference == 0
    assert (found.oracle, found.inferred) == (report.oracle, report.inferred)
    learner = learners.get(method)
    assert found.measured == (3 if learner.frozen or learner.trains == "nothing" else 1)
    assert contents(out) == before


def test_a_probe_sees_weights_that_are_not_the_runs(done: Done, tmp_path: Path) -> None:
    report = train.run(recipe("isolated-lora", steps=40), tmp_path / "run")
    path = tmp_path / "run" / "experts.safetensors"
    saved = artifacts.load(path)
    wrong = {n: torch.zeros_like(t) for n, t in saved.tensors.items()}
    header = saved.header
    same = {
        "fingerprint": header.fingerprint,
        "meta": header.meta,
        "inputs": header.inputs,
        "seed": header.seed,
    }
    artifacts.save(path, "experts", wrong, **same)
    with pytest.raises(AegisError, match="do not belong together"):
        probe.run(tmp_path / "run")
    assert report.oracle[2][2] > zero_shot(2)


@pytest.mark.parametrize("method", ["igsp", "sequential", "zero-shot"])
@pytest.mark.parametrize("other", ["image set", "encoder"])
def test_a_probe_of_other_inputs_is_one_error_and_leaves_the_matrix(
    method: str, other: str, done: Done, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, out = done(method)
    before, own = contents(out), images.backbones.load_dual
    if other == "image set":
        monkeypatch.setattr(images.streams, "edition", lambda name: ["newer"])
    else:
        monkeypatch.setattr(
            images.backbones, "load_dual", lambda n: TinyDual(seed=5) if n == "tiny" else own(n)
        )
    if (method, other) == ("sequential", "encoder"):  # it ends with its own encoder
        assert probe.run(out).largest_difference == 0
    else:
        with pytest.raises(AegisError, match=f"a different {other} than the run") as caught:
            probe.run(out)
        assert caught.value.fix
    assert contents(out) == before


def test_a_probe_of_another_trained_encoder_is_one_error(done: Done, tmp_path: Path) -> None:
    out = tmp_path / "run"
    shutil.copytree(done("sequential")[1], out)
    TinyDual(seed=5).save(out / "encoder")
    before = contents(out)
    with pytest.raises(AegisError, match="a different trained encoder than the run"):
        probe.run(out)
    assert contents(out) == before


# --- interrupted ----------------------------------------------------------------------------------


ONE, TWO = "task 1 one", "task 2 two"
# In phase 1, at its end (step 6), in phase 2, and after a task and the stream.
PLACES = [
    *((ONE, at) for at in (2, 5, 6, 7, 12)),
    ("stream", 1),
    *((TWO, at) for at in (1, 6, 9, 12)),
    ("stream", 2),
]


def test_each_task_tells_its_beginning(tmp_path: Path) -> None:
    events: list[Progress] = []
    train.run(recipe("sequential"), tmp_path / "run", on_event=events.append)
    for stage in (ONE, TWO):
        done = [event.done for event in events if event.stage == stage]
        assert done == list(range(len(done))) and len(done) > 2


@pytest.mark.parametrize("name", STRICT)
def test_igsp_interrupted_anywhere_and_resumed_ends_in_the_same_bytes(
    name: str, tmp_path: Path, done: Done
) -> None:
    """With a checkpoint after each step, and with steps in between that are repeated."""
    begin = partial(train.run, STRICT[name], tmp_path / "run")
    for _ in at_each(PLACES, begin):
        pass
    report = begin(resume=True)
    assert contents(tmp_path / "run") == contents(done(name)[1])
    assert logged(tmp_path / "run") == logged(done(name)[1])
    assert report.records == done(name)[0].records and report.records[1].phase1_steps == 6


@pytest.mark.parametrize(
    "method", ["sequential", "sequential-lora", "moe-adapters", "prototype", "isolated-lora"]
)
def test_every_learner_interrupted_and_resumed_ends_in_the_same_bytes(
    method: str, tmp_path: Path, done: Done
) -> None:
    begin = partial(train.run, recipe(method), tmp_path / "run")
    for _ in at_each([(ONE, 7), ("stream", 1), (TWO, 6)], begin):
        pass
    begin(resume=True)
    assert contents(tmp_path / "run") == contents(done(method)[1])
    assert logged(tmp_path / "run") == logged(done(method)[1])


def test_a_run_is_overwritten_on_request(done: Done, tmp_path: Path) -> None:
    out = tmp_path / "run"
    train.run(recipe("sequential"), out)
    train.run(recipe("igsp"), out, overwrite=True)
    assert contents(out) == contents(done("igsp")[1])


def test_a_finished_run_resumed_is_the_run(done: Done) -> None:
    report, out = done("igsp")
    before = contents(out)
    again = train.run(recipe("igsp"), out, resume=True)
    assert dataclasses.replace(again, minutes=0) == dataclasses.replace(report, minutes=0)
    assert contents(out) == before


# --- on which parts -------------------------------------------------------------------------------


def whole(accuracy: float, images: int) -> bool:
    return accuracy * images == pytest.approx(round(accuracy * images), abs=1e-9)


@pytest.mark.parametrize("method", ["igsp", "sequential", "zero-shot"])
def test_a_run_on_validation_parts_says_so_and_stays_on_them(
    method: str, tmp_path: Path, done: Done
) -> None:
    """No accuracy is from test parts, though the run is interrupted, resumed and probed.

    It is resumed with its own recipe, as `aegis inspect` advises.
    """
    asked = recipe(method, split="validation")
    wanted = train.run(asked, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        train.run(asked, tmp_path / "run", on_event=partial(stop, "stream", 2))
    own = load(tmp_path / "run" / "recipe.yaml", kind=StreamRecipe)
    report = train.run(own, tmp_path / "run", resume=True)
    assert contents(tmp_path / "run") == contents(tmp_path / "whole")
    assert report.split == "validation"
    probed = probe.run(tmp_path / "run")
    assert (probed.split, probed.largest_difference) == ("validation", 0)
    assert (
        json.loads((tmp_path / "run" / "accuracy_matrix.json").read_text())["split"] == "validation"
    )
    figures = [value for row in (*report.oracle, *probed.oracle, *report.inferred) for value in row]
    assert all(whole(value, len(TASKS[0].validation)) for value in figures)
    tested = done(method)[0]
    assert tested.split == "test" and tested.oracle != wanted.oracle


@pytest.mark.parametrize("begun", ["test", "validation"])
def test_a_run_does_not_go_on_with_other_parts(begun: str, tmp_path: Path) -> None:
    """Neither an interrupted run nor a finished one."""
    other = {"test": "validation", "validation": "test"}[begun]
    with pytest.raises(KeyboardInterrupt):
        train.run(
            recipe("igsp", split=begun), tmp_path / "run", on_event=partial(stop, "stream", 1)
        )
    said = f"split: {begun} there, {other} here"
    refused(
        "other settings",
        said,
        recipe=recipe("igsp", split=other),
        out=tmp_path / "run",
        resume=True,
    )
    train.run(recipe("igsp", split=begun), tmp_path / "run", resume=True)
    refused("other settings", recipe=recipe("igsp", split=other), out=tmp_path / "run", resume=True)


# --- refused --------------------------------------------------------------------------------------


def refused(*words: str, **arguments: object) -> None:
    with pytest.raises(AegisError) as caught:
        train.run(**arguments)
    assert caught.value.fix and not [w for w in words if w not in str(caught.value)], str(
        caught.value
    )


def test_runs_that_must_not_begin(done: Done, tmp_path: Path) -> None:
    _, out = done("igsp")
    refused("an existing run", "--resume", recipe=recipe("igsp"), out=out)
    refused("other settings", recipe=recipe("igsp", steps=13), out=out, resume=True)
    refused("other settings", recipe=recipe("isolated-lora"), out=out, resume=True)
    (tmp_path / "x").write_text("no run")
    refused("not empty", recipe=recipe("igsp"), out=tmp_path)
    refused("no stream 'large'", recipe=recipe("igsp", stream="large"), out=tmp_path / "a")
    refused("no dual encoder 'huge'", recipe=recipe("igsp", encoder="huge"), out=tmp_path / "a")
    refused(
        "order: four",
        "one, two, three",
        recipe=recipe("igsp", order=("one", "four")),
        out=tmp_path / "a",
    )
    assert not (tmp_path / "a").exists()


def test_a_state_of_another_encoder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe("igsp"), tmp_path / "run", on_event=partial(stop, ONE, 7))
    monkeypatch.setattr(images.backbones, "load_dual", lambda name: TinyDual(seed=5))
    refused("a different encoder", recipe=recipe("igsp"), out=tmp_path / "run", resume=True)


def test_a_state_of_other_images_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe("igsp"), tmp_path / "run", on_event=partial(stop, ONE, 7))
    monkeypatch.setattr(images.streams, "edition", lambda name: ["newer"])
    refused("a different image set", recipe=recipe("igsp"), out=tmp_path / "run", resume=True)


def test_classes_that_the_text_tower_cannot_read_are_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(model: TinyDual, texts: list[str]) -> torch.Tensor:
        raise AegisError(f"unknown word in '{texts[0]}'", "known words", "rename the class")

    monkeypatch.setattr(TinyDual, "text_features", unreadable)
    refused("unknown word", recipe=recipe("igsp"), out=tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_igsp_learns_in_bf16(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": False}, raising=False)
    said: list[Event] = []
    report = train.run(recipe("igsp", precision="bf16"), tmp_path / "run", on_event=said.append)
    assert any(isinstance(event, Warned) and "train.precision=auto" in event.text for event in said)
    assert report.scores.forgetting == 0 and probe.run(tmp_path / "run").largest_difference == 0


WILD = {
    "sequential": {"sequential": Sequential(lr=1e30)},
    "isolated-lora": {"lr": 1e30},
    "moe-adapters": {"lr": 1e30, "moe_adapters": MoeAdapters(rank=2, router_lr=1e30)},
}


@pytest.mark.parametrize(
    ("method", "keys"),
    [
        ("sequential", ["sequential.lr"]),
        ("isolated-lora", ["train.lr", "train.router_lr"]),
        ("moe-adapters", ["moe_adapters.router_lr", "train.lr"]),
    ],
)
def test_a_training_that_diverges_says_where_and_which_rates_it_read(
    method: str, keys: list[str], tmp_path: Path
) -> None:
    """The advice works: if the rates under these keys are zero, nothing moves."""
    with pytest.raises(Diverged, match="of task 'one'") as caught:
        train.run(recipe(method, **WILD[method]), tmp_path / "run")
    assert caught.value.fix == f"try a lower {' or '.join(keys)}"
    overrides = [f"{key}=0" for key in keys]
    run = train.build(
        load(write(tmp_path, recipe(method)), overrides, StreamRecipe), tmp_path / "still"
    )
    loop.prepare(run, [torch.zeros(16)], None)
    assert run.learning() and {run.rate(name) for name in run.learning()} == {0.0}


def test_an_unfinished_run_is_not_probed(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        train.run(recipe("igsp"), tmp_path / "run", on_event=partial(stop, ONE, 7))
    with pytest.raises(AegisError, match="is not finished"):
        probe.run(tmp_path / "run")
