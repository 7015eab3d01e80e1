"""The cells of a study of policies: trainings that share demonstrations and anchors.

A stage runs again only if its inputs have changed.
"""

from __future__ import annotations

import dataclasses
import shutil
import statistics
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

from aegis_cli import methods, recipes, sim
from aegis_cli.anchors import anchor_file, measure
from aegis_cli.common import artifacts, files, gl, leading, machine, version
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import OnEvent, Progress, Warned
from aegis_cli.data import demonstrations, mixture
from aegis_cli.data.selection import Selection
from aegis_cli.data.vqa import sets
from aegis_cli.data.vqa.dataset import VQASet
from aegis_cli.data.vqa.gate import MEAN
from aegis_cli.data.vqa.metrics import Graded
from aegis_cli.evaluation import (
    bench,
    bench_runs,
    open_loop,
    probe,
    results,
    rollout,
    wrong_answers,
)
from aegis_cli.evaluation.probe import ProbeReport
from aegis_cli.merging import merge
from aegis_cli.merging.settings import MergeSettings
from aegis_cli.models import acting, backbones
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import (
    Anchor,
    Cotrain,
    Insulate,
    Probe,
    Recipe,
    StudyRecipe,
    Tuning,
    study_cells,
)
from aegis_cli.recipes.study_cells import NAIVE
from aegis_cli.sim.contract import EVALUATION, VALIDATION
from aegis_cli.studies.cells import Cell, CellStore, MakeRunner
from aegis_cli.studies.comparison import Cost, Findings, StudyReport, task_results
from aegis_cli.studies.figures import Divergence, Figures, Outcome, PolicyFigures, VqaFigures
from aegis_cli.studies.tuning import POLICY_RULE, PolicyPoint
from aegis_cli.training import checkpoint, loading, track, train
from aegis_cli.training import folder as run_folder
from aegis_cli.training.up_to_date import BEGUN, Made, StageRecords, digest

_OTHER_SEEDS = 100  # how many seeds are tried to suggest one that leaves episodes for tuning

# The files of a checkpoint that a probe or rollout reads.
POLICY = ("backbone/model.safetensors", "expert.safetensors")


class PolicyStudy:
    """The kind of study whose cells are policies trained on a task."""

    figures: type[Figures] = PolicyFigures
    rule = POLICY_RULE
    tunes_fixed = True  # the frontier shows all variants, measured on the same validation split

    def __init__(self, recipe: StudyRecipe) -> None:
        self.recipe = recipe
        self.make_runner: MakeRunner[Recipe] = PolicyRunner
        self.places: Sequence[str] = study_cells.places(recipe)
        self._has_warned = False

    def cell(self, variant: str, place: str, seed: int, value: Any) -> Recipe:
        """The recipe of one policy on one task."""
        return study_cells.cell(self.recipe, variant, place, seed, value)

    def trial(self, variant: str, value: Any) -> Recipe:
        """The recipe that evaluates a knob's value."""
        tuning = self.recipe.tuning or Tuning(task=self.places[0])
        recipe = self.cell(variant, tuning.task, tuning.seed, value)
        asked = dataclasses.replace(recipe.probe, questions=tuning.questions)
        played = dataclasses.replace(recipe.rollout, episodes=tuning.episodes)
        if sim.has_colors(recipe.task):
            played = dataclasses.replace(played, colors=("seen",))
        return dataclasses.replace(recipe, probe=asked, rollout=played)

    def check(self, trials: Sequence[Recipe]) -> None:
        """Check the study before any work.

        Raises:
            AegisError: a task does not exist, or a knob is to be tuned although nothing measures
                how well all of its values act.
        """
        for recipe in trials:
            track.check(recipe)
        tuning = self.recipe.tuning
        recorded = any(recipe.demos.path is None for recipe in trials)
        named = [*self.places, *([tuning.task] if tuning else [])] if self.recipe.tasks else []
        for task in named:
            if recorded:
                sim.check_recordable(task)
            sim.check(task)
        if tuning is not None:
            _check_tunable(trials, self.recipe.seeds)

    def prepare(self, runner: PolicyRunner, cells: Sequence[Cell[Recipe]], together: bool) -> None:
        """Check questions and demonstrations; make demonstrations and anchors for all processes.

        Raises:
            AegisError: files that cannot be used.
        """
        gl.check()
        # For cells of the tuning, the questions of the later comparison are checked too.
        for cell in cells:
            for split in ("validation", "probe") if cell.validation else ("probe",):
                runner.check_questions(cell.recipe, split)
        self._warn_of_tasks(cells, runner.on_event)
        # Loading a backbone and demonstrations takes long, so each combination is checked once.
        distinct = {}
        for cell in cells:
            recipe = cell.recipe
            distinct[recipe.backbone, recipe.demos, recipe.task] = recipe
        for recipe in distinct.values():
            loading.check_named(recipe, runner.on_event)
        # A single process makes these when needed, but several would each make their own.
        for cell in cells if together else ():
            runner.demos(cell.recipe)
            runner.anchor(cell.recipe)

    def _warn_of_tasks(self, cells: Sequence[Cell[Recipe]], on_event: OnEvent) -> None:
        """Warn once of task names in tables whose policies cannot be rolled out on the task."""
        tasks = self.recipe.tasks
        if tasks is None or self._has_warned:
            return
        others = [cell.recipe for cell in cells if not playable_colors(cell.recipe)]
        if others:
            self._has_warned = True
            text = (
                f"policies of {mixture.said(mixture.at(_path(others[0])))} cannot be rolled out "
                f"here, so tasks: [{', '.join(tasks)}] is only a name: without 'tasks' and "
                "tuning.task, tables and folders are named after the demonstrations"
            )
            if set(tasks) == {Recipe.task}:  # the default, so cells without a task have equal keys
                text += ", and what is finished stays finished"
            on_event(Warned("study", text))

    def point(self, variant: str, value: Any, found: PolicyFigures | Divergence) -> PolicyPoint:
        """The result of a knob's value."""
        own = self.recipe.variants[variant]
        # The margin refers to plain naive, not to the best of its merges.
        method = own.method if own.is_plain(own.method) else f"{own.method}, merged"
        if isinstance(found, Divergence):
            return PolicyPoint(variant, method, value, None, None, None)
        success = found.success_seen if found.return_share is None else found.return_share
        return PolicyPoint(
            variant,
            method,
            value,
            found.accuracy,
            found.baseline_accuracy,
            success,
            open_loop_error=found.open_loop_error,
        )

    def _sets(self) -> tuple[str | None, ...]:
        """The question sets, each with its own table; None for a single one."""
        vqa = self.recipe.shared.get("probe", {}).get("vqa", Probe().vqa)
        return (None,) if isinstance(vqa, str) else tuple(vqa)

    def costs(self, store: CellStore[Recipe], chosen: Mapping[str, Any]) -> dict[str, Cost]:
        """Step time and memory relative to naive's, by variant; empty if there is no naive.

        Costs not yet known for this machine are measured, unless only finished cells are delivered.
        """
        if NAIVE not in self.recipe.variants:
            return {}
        made = {name: self._first(name, chosen) for name in self.recipe.variants}
        runner = _runner(store)
        keys = {
            name: _cost_key(recipe, made[NAIVE], runner.backbone_sha256(recipe))
            for name, recipe in made.items()
        }
        if not store.known_only:
            here = machine.name()
            old = {name: store.known(key, Cost) for name, key in keys.items() if key in store.cells}
            # Ratios of times hold only on the machine where they were measured.
            missing = [name for name in made if name not in old or old[name].machine != here]
            # Variants with equal steps are measured once. These differ only in learning rates or
            # in how they are merged.
            first = dict[str, str]()
            for name in missing:
                first.setdefault(keys[name], name)
            for name, cost in self._measure_costs(store, made, first.values()):
                store.keep(keys[name], Cost(*cost, here, version.code()))
        return {name: store.known(key, Cost) for name, key in keys.items() if key in store.cells}

    def _first(self, variant: str, chosen: Mapping[str, Any]) -> Recipe:
        """The recipe of a variant's first cell, which represents the costs of all its cells."""
        study = self.recipe
        return self.cell(variant, self.places[0], study.seeds[0], chosen[variant])

    def _measure_costs(
        self, store: CellStore[Recipe], made: Mapping[str, Recipe], names: Collection[str]
    ) -> Iterator[tuple[str, tuple[float, float]]]:
        """Ratios of step time and of peak memory for some variants.

        Variants with different anchors are timed separately, each with its own anchor.
        """
        runner = _runner(store)
        # Each distinct anchor setting once, in the order of the variants.
        for settings in dict.fromkeys(made[name].anchor for name in names):
            group = {name: made[name] for name in names if made[name].anchor == settings}
            anchor_path = runner.anchor(next(iter(group.values()))).path
            recipes_of = {NAIVE: made[NAIVE], **group}
            found = bench.compare(recipes_of, anchor_path, on_event=store.on_event)
            for name in group:
                yield name, (found[name].step_time, found[name].peak_memory)

    def report(self, findings: Findings, store: CellStore[Recipe]) -> StudyReport:
        """The table of the results so far."""
        study = self.recipe
        ceilings = {name for name in study.variants if self._is_ceiling(name, findings.chosen)}
        tables = []
        for task in self.places:
            found = findings.at(task)
            for vqa in self._sets() if found else ():
                asked = {name: _asked(own, vqa) for name, own in found.items()}
                chosen, costs = findings.chosen, findings.costs
                most = study.max_error_rise
                table = task_results(task, asked, study.variants, chosen, costs, ceilings, most)
                tables.append(dataclasses.replace(table, vqa=vqa))
        return StudyReport(
            name=study.name,
            finished=store.done,
            cells=store.total,
            seeds=list(study.seeds),
            tasks=tables,
            tuning_task=self._tuned_on(),
            within=None if study.tuning is None else study.tuning.within,
            tuning=findings.points,
            out=str(store.folder),
            costs_on=sorted({cost.machine for cost in findings.costs.values() if cost.machine}),
        )

    def _tuned_on(self) -> str | None:
        """The task that the knobs are chosen on, or the name of the demonstrations."""
        if self.recipe.tuning is None:
            return None
        return self.recipe.tuning.task if self.recipe.tasks else self.places[0]

    def _is_ceiling(self, variant: str, chosen: Mapping[str, Any]) -> bool:
        """Whether a variant trains on VQA data at the chosen value of its knob."""
        study = self.recipe
        value = chosen.get(variant, study.variants[variant].values[0])
        return bool(_trained_on(self.cell(variant, self.places[0], study.seeds[0], value)))


def _runner(store: CellStore[Recipe]) -> PolicyRunner:
    """The runner of a study of policies."""
    assert isinstance(store.runner, PolicyRunner)
    return store.runner


def _trained_on(recipe: Recipe) -> list[Cotrain | Insulate]:
    """The section of the questions that the recipe's method trains on; empty if there is none."""
    method = recipe.train.method
    asks = methods.get(method).trains_on_questions(recipes.options(recipe))
    return [getattr(recipe, method)] if asks else []


def _asked(cells: Mapping[int, Outcome], vqa: str | None) -> dict[int, Outcome]:
    """A variant's cells by seed, with the figures of one of several question sets."""
    found = dict(cells)
    for seed, cell in cells.items():
        if vqa is not None and isinstance(cell, PolicyFigures):
            found[seed] = cell.asked(vqa)
    return found


def _check_tunable(trials: Sequence[Recipe], judging: Sequence[int]) -> None:
    """Raise AegisError if values cannot be chosen by how well their policies act."""
    played = [recipe for recipe in trials if playable_colors(recipe)]
    others = [recipe for recipe in trials if recipe not in played]
    if played and others:
        given = mixture.said(mixture.at(_path(others[0])))
        raise AegisError(
            f"'tuning' with demonstrations in {given}, whose policies cannot be rolled out here, "
            "and with others, whose policies can",
            "values that are all chosen by success, or all by the open-loop error",
            "give all variants demonstrations of one robot, or delete 'tuning' and put the values "
            "under 'set'; if these are LIBERO's, name its suite as tuning.task",
        )
    for recipe in others:
        for data in mixture.each(mixture.at(_path(recipe))):
            if not tuning_episodes(recipe, data, judging):
                raise _no_episode_to_tune_on(recipe, data, judging)


def _no_episode_to_tune_on(recipe: Recipe, data: Path, judging: Sequence[int]) -> AegisError:
    fix = "record more, hold out fewer by train.validation_share, or compare fewer seeds"
    for seed in range(recipe.seed + 1, recipe.seed + _OTHER_SEEDS):
        if tuning_episodes(dataclasses.replace(recipe, seed=seed), data, judging):
            fix = f"set tuning.seed to {seed}, which has some, or record more demonstrations"
            break
    return AegisError(
        f"no episode of '{data}' that tuning.seed {recipe.seed} holds out and none of the seeds "
        f"{', '.join(map(str, judging))} does",
        "held-out episodes to choose values by, on which no policy is judged",
        fix,
    )


def _path(recipe: Recipe) -> str | tuple[str, ...]:
    """The path of demonstrations without rollouts, which are always given and never recorded."""
    assert recipe.demos.path is not None
    return recipe.demos.path


def tuning_episodes(recipe: Recipe, data: Path, judging: Sequence[int]) -> list[int]:
    """The episodes that a trial holds out and that none of the compared trainings holds out.

    Args:
        judging: the seeds of the compared trainings.
    """
    only, share = recipe.demos.only, recipe.train.validation_share
    held = {s: demonstrations.held_out_of(data, only, share, s) for s in (recipe.seed, *judging)}
    judged = {episode for seed in judging for episode in held[seed]}
    return [episode for episode in held[recipe.seed] if episode not in judged]


def cell_key(
    cell: Cell[Recipe],
    backbone_sha256: str,
    demos_sha256: str | None = None,
    vqa_state: Sequence[Mapping[str, Any]] = (),
    judging: Sequence[int] = (),
) -> str:
    """Digest of everything that affects a cell's figures.

    Its label, its folder and the location of the backbone are not part of it.

    Options at their original defaults are left out. A later option or a changed default therefore
    does not make finished cells stale, and does not give different cells the same key.

    Args:
        demos_sha256: digest of the demonstrations that the recipe names; None if they are recorded.
        vqa_state: state of the question files that it reads, if any.
        judging: seeds whose held-out episodes it must not be evaluated on.
    """
    key = _shaping(cell.recipe) | {"backbone": backbone_sha256, "validation": cell.validation}
    for name in ("demos", "anchor", "probe", "rollout"):
        key[name] = recipes.changed(getattr(cell.recipe, name))
    # Unused parts add no key, so that cells stored before these parts existed are still found.
    if cell.recipe.merge.method is not None:
        key["merge"] = recipes.changed(cell.recipe.merge)
    if judging:
        key["judging"] = sorted(judging)
    if demos_sha256 is not None:
        key["demos"] = {"sha256": demos_sha256, **recipes.drawn(cell.recipe)}
    return digest(key | ({"vqa": vqa_state} if any(vqa_state) else {}))


def _cost_key(recipe: Recipe, naive: Recipe, backbone_sha256: str) -> str:
    """Digest of everything that affects a cost; seed and learning rates do not."""
    # Naive's settings count as well, because the cost is a ratio to its step.
    timed = [bench_runs.unmoved(one) for one in (recipe, naive)]
    parts = [{**_shaping(one), "seed": 0, "backbone": backbone_sha256} for one in timed]
    return digest({"cost": parts, "anchor": recipes.changed(recipe.anchor)})


def _shaping(recipe: Recipe) -> dict[str, Any]:
    """The settings that affect a training, except those at their original defaults."""
    changed = {}
    # Of the methods' sections only that of the recipe's method, if it has options.
    for name in ("train", "expert", recipe.train.method):
        if (section := getattr(recipe, name, None)) is not None:
            changed[name] = recipes.changed(section)
    if recipe.expert.start is not None:  # the expert's digest instead of its path
        changed["expert"]["start"] = checkpoint.expert_sha256(recipe.expert.start)
    return {"task": recipe.task, "seed": recipe.seed, "method": recipe.train.method, **changed}


class Given(NamedTuple):
    """Demonstrations that a recipe names (one set or several), and their combined digest."""

    path: mixture.Paths
    sha256: str


class PolicyRunner:
    """Trains and measures cells in one folder, and knows which of their files are up to date.

    A label is a cell's path relative to the folder, such as `naive` or `nullspace/3`.
    """

    def __init__(
        self,
        folder: Path,
        on_event: OnEvent,
        plain: Recipe | None = None,
        records: StageRecords | None = None,
    ) -> None:
        """Create a runner for one folder.

        Args:
            plain: the recipe whose demonstrations and anchor get plain file names; the names of
                others contain a digest of their settings.
            records: tell which stages are up to date; by default the folder's own records.
        """
        self.folder, self.on_event, self.plain = folder, on_event, plain
        self.records = StageRecords(folder, on_event) if records is None else records
        self._given: dict[tuple[str | tuple[str, ...], Selection], Given] = {}
        self._sha256: dict[str, str] = {}
        self._sources: dict[tuple[str, bool, str], sets.Scenes | sets.Listed] = {}
        self._questions: dict[tuple[object, ...], VQASet] = {}
        self._before: dict[tuple[object, ...], list[Graded]] = {}
        self._checked: set[tuple[object, ...]] = set()

    def begin_anew(self) -> None:
        """Let every stage of every cell run again."""
        self.records.begin_anew()

    # --- shared by the cells ------------------------------------------------------------------

    def demos(self, recipe: Recipe) -> Given | Made:
        """The demonstrations that the recipe names, or those of its task and settings."""
        settings = recipe.demos
        if settings.path is not None:
            return self._given_demos(settings.path, settings.selection)
        # A job's file is `demos.safetensors`; the files of a study have a digest in their names.
        plain = self.plain is not None and (recipe.task, settings) == (
            self.plain.task,
            self.plain.demos,
        )
        return self.records.demonstrations(recipe.task, settings, "demos" if plain else None)

    def _given_demos(self, path: str | tuple[str, ...], selection: Selection) -> Given:
        name = (path, selection)
        if name not in self._given:
            at = mixture.at(path)
            self._given[name] = Given(at, mixture.digest(at, selection))
        return self._given[name]

    def anchor(self, recipe: Recipe) -> Made:
        """The anchor of the recipe's backbone and settings, on questions or on its robot frames."""
        plain = self.plain is not None and (recipe.backbone, recipe.anchor) == (
            self.plain.backbone,
            self.plain.anchor,
        )
        key = {"backbone": self.backbone_sha256(recipe), **recipes.recorded(recipe.anchor)}
        shown = self.demos(recipe) if recipe.anchor.source == "demos" else None
        key |= self.source(recipe.anchor).state if shown is None else {"demos": shown.sha256}
        if shown is not None:
            # Only episodes and cameras count, since positions and actions are not read.
            chosen = recipes.selected(recipe)
            key |= {name: chosen[name] for name in ("only", "rename") if name in chosen}

        def make(out: Path, on_event: OnEvent) -> object:
            frames = None if shown is None else shown.path
            return leading.together(
                measure.run,
                recipe.backbone,
                recipe.anchor,
                out,
                on_event=on_event,
                demos=frames,
                selection=recipe.demos.selection,
            )

        return self.records.shared("anchor" if plain else f"anchor-{digest(key)[:8]}", key, make)

    def backbone_sha256(self, recipe: Recipe) -> str:
        """Digest of the recipe's backbone model."""
        if recipe.backbone not in self._sha256:
            self._sha256[recipe.backbone] = backbones.sha256(recipe.backbone)
        return self._sha256[recipe.backbone]

    def source(self, settings: Anchor | Cotrain | Insulate | Probe) -> sets.Scenes | sets.Listed:
        """The question set of a recipe's section, read once."""
        vqa = settings.only_set if isinstance(settings, Probe) else settings.vqa
        key = (vqa, settings.skip_bad, settings.ask)
        if key not in self._sources:
            self._sources[key] = sets.read(vqa, settings.skip_bad, self.on_event, settings.ask)
        return self._sources[key]

    def vqa_state(self, recipe: Recipe) -> list[dict[str, Any]]:
        """The state of the recipe's question sets, which changes when their files do."""
        sections = [
            recipe.anchor,
            *recipe.probe.of_each_set(),
            *_trained_on(recipe),
        ]
        return [self.source(section).state for section in sections]

    def questions(self, recipe: Recipe, settings: Probe, split: str) -> VQASet:
        """As many questions of one set as `settings` says, from one split of the set.

        The backbone can read all of them.
        """
        key = (self.backbone_sha256(recipe), split, *dataclasses.astuple(settings))
        if key not in self._questions:
            checks = [backbones.load(recipe.backbone).check_text]
            choose = self.source(settings).choose
            self._questions[key] = choose(
                split, settings.questions, settings.seed, checks, self.on_event
            )
        return self._questions[key]

    def check_questions(self, recipe: Recipe, split: str) -> None:
        """Raise AegisError if files have no question for this split, or an unreadable one."""
        for settings in recipe.probe.of_each_set():
            key = (recipe.backbone, split, *dataclasses.astuple(settings))
            if self.source(settings).files and key not in self._checked:
                self.questions(recipe, settings, split)
            self._checked.add(key)

    def before(self, recipe: Recipe, settings: Probe, split: str) -> list[Graded]:
        """The backbone's answers to the same questions before training."""
        key = (self.backbone_sha256(recipe), split, *dataclasses.astuple(settings))
        if key not in self._before:
            self._before[key] = leading.together(
                probe.answers,
                recipe.backbone,
                self.questions(recipe, settings, split),
                settings.batch_size,
                on_event=self.records.named("baseline/probe"),
            ).graded
        return self._before[key]

    # --- a cell -------------------------------------------------------------------------------

    def key(self, cell: Cell[Recipe]) -> str:
        """Digest of everything that affects the cell's result."""
        recipe = cell.recipe
        given = None if recipe.demos.path is None else self.demos(recipe).sha256
        evaluated = cell.validation and not playable_colors(recipe)
        return cell_key(
            cell,
            self.backbone_sha256(recipe),
            given,
            self.vqa_state(recipe),
            cell.judging if evaluated else (),
        )

    def measure(self, cell: Cell[Recipe]) -> PolicyFigures | Divergence:
        """The cell's figures; a training that diverges is a result too."""
        try:
            found = self.figures(cell.label, cell.recipe, cell.validation)
        except Diverged as end:
            return Divergence(end.good_steps)
        if not cell.validation or playable_colors(cell.recipe):
            return found
        # A knob's value is chosen on separate episodes.
        evaluated = self.open_loop_errors(cell.label, cell.recipe, cell.judging)
        return dataclasses.replace(found, **evaluated.figures())

    def clear(self, label: str) -> None:
        """Remove the checkpoints, which are large and not needed as results."""
        for run in (self.folder / label, self.folder / label / run_folder.MERGED):
            shutil.rmtree(run / "checkpoints", ignore_errors=True)

    def tidy(self, labels: Iterable[str]) -> None:
        """Do nothing, because the runs' records stay."""

    def figures(self, label: str, recipe: Recipe, validation: bool = False) -> PolicyFigures:
        """Train `recipe.train.method`, merge it if the recipe says so, probe it and roll it out.

        With `validation` it uses the scenes and episodes for tuning.

        A policy trained on demonstrations without a simulated task, or on several cameras, cannot
        be rolled out. Its figures have no success or return, but its open-loop error on the
        episodes that training held out. With `validation`, `measure` adds this error.
        """
        trained = self._trained(label, recipe)
        asked = self._asked(label, recipe, validation)
        first, *further = asked  # the table's main columns are for the first set
        last = self._policy(label, recipe) / "checkpoints" / "last"
        header = artifacts.read_header(last / checkpoint.EXPERT)
        playable = _playable(cast(PolicyMeta, header.meta), recipe)
        played = {colors: self.rollout(label, recipe, colors, validation) for colors in playable}
        # A task without colours has its figures under `seen`; a policy that cannot be rolled out
        # has none at all.
        seen, held_out = played.get("seen"), played.get("held-out")
        evaluated = OpenLoop()
        if not playable and not validation:
            evaluated = self.open_loop_errors(label, recipe)
        return PolicyFigures(
            method=recipe.train.method,
            **vars(asked[first]),
            success_seen=None if seen is None else seen["success"],
            success_held_out=None if held_out is None else held_out["success"],
            wrong_target=None if seen is None else seen["wrong_target"],
            return_share=None if seen is None else seen["return_share"],
            **evaluated.figures(),
            energy_shed=trained["energy_shed_mean"],
            step_s=trained["step_s"],
            step_time_ratio=None,
            validation_loss=trained["validation_loss"],
            probe_seed=recipe.probe.seed,
            outcomes_seen=None if seen is None else seen.get("outcomes"),
            outcomes_held_out=None if held_out is None else held_out.get("outcomes"),
            rollout_seed=recipe.rollout.seed,
            code=version.code(),
            others={name: asked[name] for name in further},
        )

    def _trained(self, label: str, recipe: Recipe) -> dict[str, Any]:
        """Train and merge; return the training report with the final policy's validation loss."""
        self.train(label, recipe)
        run_folder.renew_recipe(self.folder / label, recipe)
        report = files.load_json(self.folder / label / run_folder.JOBS_REPORT)
        _remove_misplaced(self.folder / label)
        if recipe.merge.method is not None:
            self.merge(label, recipe)
            out = self._policy(label, recipe)
            run_folder.renew_recipe(out, recipe)
            merged = files.load_json(out / run_folder.MERGE_REPORT)
            report["validation_loss"] = merged["validation_loss"]
        return report

    def _asked(self, label: str, recipe: Recipe, validation: bool) -> dict[str, VqaFigures]:
        """The figures on each question set, by its name."""
        asked = {}
        for number, settings in enumerate(recipe.probe.of_each_set(), start=1):
            probed = self.probe(label, recipe, settings, number, validation)
            asked[settings.only_set] = _vqa_figures(probed)
        if recipe.anchor.source == "demos":
            # The distance between questions and robot frames is not a drift.
            asked = {name: dataclasses.replace(found, w2=None) for name, found in asked.items()}
        return asked

    def train(self, label: str, recipe: Recipe) -> None:
        """Train the cell; the report is written into the run."""
        out, method = self.folder / label, recipe.train.method
        recorded, measured = self.demos(recipe), self.anchor(recipe)
        key = self.training_key(recipe, recorded.sha256, measured.sha256)
        outputs = [
            out / run_folder.JOBS_REPORT,
            *(out / "checkpoints" / "last" / name for name in POLICY),
        ]

        def make(on_event: OnEvent) -> None:
            self._clear_other_run(label, key, on_event)
            # `resume` starts a new run if there is none, and continues one that was interrupted.
            report = leading.together(
                train.run,
                recipe,
                method,
                recorded.path,
                measured.path,
                out,
                resume=True,
                on_event=on_event,
            )
            files.save_json(out / run_folder.JOBS_REPORT, report.to_json())

        self.records.fresh(f"{label}/train", key, outputs, make)

    def training_key(self, recipe: Recipe, demos: str, anchor: str) -> dict[str, Any]:
        """Everything that affects a training, given digests of its demonstrations and anchor."""
        key = {
            "recipe": recipes.training_part(recipe),
            "backbone": self.backbone_sha256(recipe),
            "demos": demos,
            "anchor": anchor,
        }
        if recipe.expert.start is not None:
            key["expert"] = checkpoint.expert_sha256(recipe.expert.start)
        for section in _trained_on(recipe):
            key |= self.source(section).state
        return key

    def _clear_other_run(self, label: str, key: Mapping[str, Any], on_event: OnEvent) -> None:
        """Clear the cell's folder for a new start, unless it holds a run that can be continued.

        A run cannot be continued if its settings differ, if it was finished and then damaged, or
        if its process was stopped while writing the recipe.

        Args:
            key: everything that affects the training.
        """
        # An interrupted run with exactly these inputs is continued.
        if self.goes_on(label, key):
            return
        out, begun_record = self.folder / label, f"{label}/{BEGUN}"
        begun = self.records.key_of(begun_record)
        # After `--overwrite` there is no record any more, and no warning is needed.
        if begun and begun != digest(key) and (out / "recipe.yaml").exists():
            changed = ", ".join(self.records.changed(begun_record, key))
            other = f"a different {changed}" if changed else "other settings or inputs"
            on_event(Warned("train", f"'{out}' was trained with {other}: training it again"))
        moved = run_folder.clear(out, ours=begun is not None)
        if moved is not None:
            on_event(Progress(f"train (moved {moved.name} aside)", 1, 1, "stage"))
        # Recorded before the training starts, so that the run of a killed process counts as ours.
        self.records.forget(f"{label}/train")
        self.records.keep(begun_record, key, [])

    def has_begun(self, label: str) -> bool:
        """Whether the records say that the cell's run was started here."""
        return self.records.key_of(f"{label}/{BEGUN}") is not None

    def goes_on(self, label: str, key: Mapping[str, Any]) -> bool:
        """Whether the cell's folder holds an unfinished training with this key."""
        begun, finished = (self.records.key_of(f"{label}/{name}") for name in (BEGUN, "train"))
        there = (self.folder / label / "recipe.yaml").exists()
        return begun == digest(key) != finished and there

    def merge(self, label: str, recipe: Recipe) -> None:
        """Merge the cell's trained policy; the report is written into the merged run."""
        trained, out = self.folder / label, self.folder / label / run_folder.MERGED
        recorded, measured = self.demos(recipe), self.anchor(recipe)
        settings = MergeSettings(
            method=str(recipe.merge.method),
            damping=recipe.merge.damping,
            demos=recorded.path,
            anchor=measured.path,
            frames=recipe.merge.frames,
        )
        report = out / run_folder.MERGE_REPORT
        key = {
            "policy": _sha256(trained),
            "settings": dataclasses.asdict(recipe.merge),
            "demos": recorded.sha256,
            "anchor": measured.sha256,
        }

        def make(on_event: OnEvent) -> None:
            moved = run_folder.clear(out, ours=True)  # it is inside a run that is ours
            if moved is not None:
                on_event(Progress(f"merge (moved {moved.name} aside)", 1, 1, "stage"))
            strength = recipe.merge.strength
            done = merge.run(str(trained), settings, out, strength, on_event=on_event, judged=True)
            files.save_json(report, done.to_json())

        outputs = [report, *(out / "checkpoints" / "last" / name for name in POLICY)]
        self.records.fresh(f"{label}/merge", key, outputs, make)

    def _policy(self, label: str, recipe: Recipe) -> Path:
        """The run whose policy is measured."""
        merged, trained = recipe.merge.method is not None, self.folder / label
        return trained / run_folder.MERGED if merged else trained

    def probe(
        self, label: str, recipe: Recipe, settings: Probe, number: int, validation: bool = False
    ) -> dict[str, Any]:
        """The cell's drift report on one question set.

        Args:
            number: position of the set in the recipe's probe, from 1; the first set's files have
                no number in their names.
        """
        split, name = ("validation", "probe-validation") if validation else ("probe", "probe")
        name = name if number == 1 else f"{name}-{number}"
        path, measured = self._policy(label, recipe) / f"{name}.json", self.anchor(recipe)
        # All inputs of the report: the weights, the anchor that W2 is measured from, the backbone
        # before training, and the questions.
        key = {
            "policy": _sha256(self._policy(label, recipe)),
            "anchor": measured.sha256,
            "backbone": self.backbone_sha256(recipe),
            "settings": _probe_settings(settings),
            "split": split,
            **self.source(settings).state,
        }

        def make(on_event: OnEvent) -> None:
            report, examples = self._probed(label, recipe, settings, split, on_event)
            files.save_json(path, report.to_json() | examples)
            track.tell(recipe, path.parent, name, report.to_json(), recipe.train.steps)

        self.records.fresh(f"{label}/{name}", key, [path], make)
        return files.load_json(path)

    def _probed(
        self, label: str, recipe: Recipe, settings: Probe, split: str, on_event: OnEvent
    ) -> tuple[ProbeReport, dict[str, Any]]:
        """The cell's answers compared with those before training, and results per image."""
        measured = self.anchor(recipe)
        asked = self.questions(recipe, settings, split)
        before = self.before(recipe, settings, split)
        anchor = None
        if "moments" in recipe.anchor.parts:
            fingerprint = backbones.load(recipe.backbone).fingerprint()
            wanted = anchor_file.Wanted(fingerprint, recipe.backbone, "--baseline ")
            anchor = measured.path, wanted
        after, layers, image_size = leading.together(
            probe.answers,
            str(self._policy(label, recipe)),
            asked,
            settings.batch_size,
            anchor,
            on_event=on_event,
        )
        between = (
            probe.two_sets(measured.path, self.source(settings).name, settings.ask)
            if layers
            else None
        )
        report = probe.compare(
            after, before, layers, settings.max_drop, asked.skipped, between, settings.gate
        )
        probe.check_trained(report, recipe.train.steps)
        if settings.max_drop is not None:
            probe.warn_of_little_knowledge(report, recipe.backbone, settings.ask, "probe", on_event)
        probe.warn_of_few_questions(
            report.questions, report.drop_interval, settings.max_drop, "probe", on_event
        )
        wrong = {"wrong": wrong_answers.examples(after, asked, image_size)}
        return report, probe.by_image(after, before, asked.names) | wrong

    def rollout(
        self, label: str, recipe: Recipe, colors: str, validation: bool = False
    ) -> dict[str, Any]:
        """The cell's rollout report on seen or held-out colours, or on a task without colours."""
        stream, name = (VALIDATION, "rollout-validation") if validation else (EVALUATION, "rollout")
        path, settings = self._policy(label, recipe) / f"{name}-{colors}.json", recipe.rollout
        key: dict[str, Any] = {
            "policy": _sha256(self._policy(label, recipe)),
            "episodes": settings.episodes,
            "replan": settings.replan,
            "stream": stream,
        }
        if settings.ensemble is not None:
            key["ensemble"] = settings.ensemble
        if settings.seed != acting.EVALUATION_SEED:  # older records have no seed
            key["seed"] = settings.seed

        def make(on_event: OnEvent) -> None:
            report = rollout.run(
                self._policy(label, recipe),
                None,
                settings.episodes,
                colors,
                replan=settings.replan,
                on_event=on_event,
                stream=stream,
                seed=settings.seed,
                ensemble=settings.ensemble,
            )
            files.save_json(path, report.to_json())
            track.tell(recipe, path.parent, path.stem, report.to_json(), recipe.train.steps)

        self.records.fresh(f"{label}/{name} {colors}", key, [path], make)
        return files.load_json(path)

    def open_loop_errors(
        self, label: str, recipe: Recipe, judging: Sequence[int] | None = None
    ) -> OpenLoop:
        """The open-loop errors of the cell and of holding the position, on held-out episodes.

        With several sets of demonstrations, each error is the mean over the sets in which actions
        vary, and None if there is no such set. Holding has an error only if it has one in all these
        sets.

        Args:
            judging: seeds whose held-out episodes are left out when a knob's value is chosen.
        """
        given = self.demos(recipe)
        paths = mixture.each(given.path)
        reports = {}
        for number, data in enumerate(paths, start=1):
            episodes = None if judging is None else tuning_episodes(recipe, data, judging)
            report = self.evaluated(label, recipe, data, given.sha256, number, episodes)
            # None if no action varied in training, so there is no variance to divide by.
            if report["relative_error"] is not None:
                reports[number] = report
        return OpenLoop.of(reports)

    def evaluated(
        self,
        label: str,
        recipe: Recipe,
        data: Path,
        demos_sha256: str,
        number: int,
        episodes: Sequence[int] | None = None,
    ) -> dict[str, Any]:
        """The open-loop report on one set of demonstrations, numbered from 1.

        Args:
            episodes: by default all episodes that the training held out.
        """
        run = self._policy(label, recipe)
        name = results.OPEN_LOOP if episodes is None else f"{results.OPEN_LOOP}-validation"
        name = name if number == 1 else f"{name}-{number}"
        path = run / f"{name}.json"
        key = {"policy": _sha256(run), "demos": demos_sha256, "number": number}
        key |= recipes.selected(recipe) | ({} if episodes is None else {"episodes": episodes})

        def make(on_event: OnEvent) -> None:
            report = open_loop.run(run, data, episodes, on_event=on_event).kept()
            files.save_json(path, report)
            track.tell(recipe, run, name, report, recipe.train.steps)

        self.records.fresh(f"{label}/{name}", key, [path], make)
        return files.load_json(path)


@dataclass(frozen=True)
class OpenLoop:
    """Open-loop errors as in `PolicyFigures`; None if nothing was measured."""

    error: float | None = None
    hold: float | None = None
    episodes: tuple[str, ...] | None = None
    weights: tuple[float, ...] | None = None
    errors: tuple[float, ...] | None = None
    holds: tuple[float, ...] | None = None

    def figures(self) -> dict[str, Any]:
        """The same values by the field names of `PolicyFigures`."""
        return {
            "open_loop_error": self.error,
            "hold_error": self.hold,
            "evaluated_episodes": self.episodes,
            "weight_per_episode": self.weights,
            "error_per_episode": self.errors,
            "hold_per_episode": self.holds,
        }

    @classmethod
    def of(cls, reports: Mapping[int, Mapping[str, Any]]) -> OpenLoop:
        """The combined errors from the reports on data sets, which are given by set number."""
        if not reports:
            return cls()
        each = list(reports.values())
        held = [report["hold_error"] for report in each]
        made = cls(
            statistics.fmean(report["relative_error"] for report in each),
            None if None in held else statistics.fmean(held),
        )
        # Reports of earlier versions have no errors of single episodes.
        if not all(report.get("episode_errors") for report in each):
            return made
        episodes, weights = list[str](), list[float]()
        for number, report in reports.items():
            steps = sum(one["steps"] for one in report["episode_errors"])
            for one in report["episode_errors"]:
                episodes.append(f"{number}/{one['episode']}")
                weights.append(one["steps"] / (steps * len(reports)))  # equal weight for each set
        every = [one for report in each for one in report["episode_errors"]]
        holds = None if made.hold is None else tuple(one["hold_error"] for one in every)
        return dataclasses.replace(
            made,
            episodes=tuple(episodes),
            weights=tuple(weights),
            errors=tuple(one["relative_error"] for one in every),
            holds=holds,
        )


def _vqa_figures(probed: dict[str, Any]) -> VqaFigures:
    """The VQA figures in a drift report."""
    layers = [layer["w2"] for layer in probed["layers"]]
    return VqaFigures(
        accuracy=probed["accuracy"],
        drop_points=probed["drop_points"],
        drop_interval=tuple(probed["drop_interval"]),
        cross_entropy=probed["cross_entropy"],
        w2=sum(layers) / len(layers) if layers else None,  # unweighted mean over layers
        baseline_accuracy=probed["baseline_accuracy"],
        baseline_cross_entropy=probed["baseline_cross_entropy"],
        majority_accuracy=probed["majority"],
        lost_per_image=_tuple(probed.get("lost_per_image")),
        questions_per_image=_tuple(probed.get("questions_per_image")),
        images=_tuple(probed.get("images")),
    )


def _tuple(values: list[Any] | None) -> tuple[Any, ...] | None:
    """A list from a JSON file as a tuple; None if an older version wrote the file."""
    return None if values is None else tuple(values)


def _probe_settings(settings: Probe) -> dict[str, Any]:
    """The settings in a probe's record; keys that older records lack are left out at defaults."""
    keys = dataclasses.asdict(settings)
    del keys["while_training"]  # it affects only the training
    if settings.seed == probe.PROBE_SEED:
        del keys["seed"]
    if settings.gate == MEAN:
        del keys["gate"]
    return keys


def _remove_misplaced(trained: Path) -> None:
    """Remove a merged run's figures that an earlier version wrote into the enclosing run."""
    if (trained / run_folder.MERGE_REPORT).is_file():
        for name in ("probe*.json", "rollout*.json", run_folder.MERGE_REPORT):
            for path in trained.glob(name):
                path.unlink()


def _sha256(run: Path) -> list[str]:
    """Digests of the files of a run that a probe or rollout reads."""
    last = run / "checkpoints" / "last"
    return [files.sha256_file(last / name) for name in POLICY]


def _playable(meta: PolicyMeta, recipe: Recipe) -> tuple[str, ...]:
    """The colours that a policy is rolled out on, or one default for a task without colours."""
    task = sim.playable(meta["task"], checkpoint.seen_by(meta, meta["task"]))
    return () if task is None else _colors(task, recipe)


def playable_colors(recipe: Recipe) -> tuple[str, ...]:
    """Like `_playable`, for a policy that the recipe has yet to train."""
    task: str | None = recipe.task
    if recipe.demos.path is not None:
        given, chosen = mixture.at(recipe.demos.path), recipe.demos.selection
        task = mixture.playable_task(given, chosen.camera, recipe.task, chosen.rename)
    return () if task is None else _colors(task, recipe)


def _colors(task: str, recipe: Recipe) -> tuple[str, ...]:
    return recipe.rollout.colors if sim.has_colors(task) else (acting.DEFAULT,)
