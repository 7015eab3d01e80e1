"""Studies as files: what is refused, all at once, and the recipes of their cells."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from samples.studies import TUNING, VARIANTS, fake_bench, raw, study, write

from aegis_cli import recipes
from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.recipes import Recipe, StudyRecipe, study_cells
from aegis_cli.studies import metrics, policy_cells
from aegis_cli.studies import study as stage
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.policy_cells import PolicyRunner
from aegis_cli.studies.stream_runs import StreamRuns

RECIPES = Path(__file__).parent.parent.parent / "recipes"
CELL = ("naive", "reach", 1, 1e-3)  # variant, task, seed and the knob's value


def refusal(folder: Path, keys: dict[str, Any], *overrides: str) -> AegisError:
    with pytest.raises(AegisError) as caught:
        study_cells.load(write(folder, keys), overrides)
    return caught.value


def with_variant(**keys: Any) -> dict[str, Any]:
    return {"variants": {"naive": VARIANTS["naive"], "x": keys}}


def test_every_value_of_a_knob_has_a_folder_of_its_own(tmp_path: Path) -> None:
    """This includes values of only dots, without valid characters, or longer than a name may be."""
    values = ("a/b", "a_b", ".", "..", "/", "?", "ä" * 200, "ä" * 300, 1e-3, "_._", None)
    variants = {"x": SimpleNamespace(values=values)}
    kind: Any = SimpleNamespace(
        recipe=SimpleNamespace(variants=variants, seeds=()), trial=lambda name, value: value
    )
    above = tmp_path / "tuning" / "x"
    above.mkdir(parents=True)
    folders = [tmp_path / cell.label for _, cell in stage.trials(kind)["x"]]
    for folder in folders:
        folder.mkdir()
        assert folder.resolve().parent == above.resolve()
    assert [folder.name for folder in folders][:2] == ["a_b", "a_b-" + folders[1].name[-8:]]
    assert {"0.001", "fixed"} < {folder.name for folder in folders}


@pytest.mark.parametrize(
    ("changes", "found", "fix"),
    [
        (
            with_variant(methd="lora", method="lora"),
            "unknown key 'variants.x.methd'",
            "did you mean 'variants.x.method'?",
        ),
        (with_variant(method="lroa"), "variants.x.method: 'lroa'", "did you mean 'lora'?"),
        (with_variant(set={"lora.rank": 4}), "no key 'variants.x.method'", "add the line"),
        (
            with_variant(method="lora", tune={"lora.rnak": [4]}),
            "variants.x: unknown key 'lora.rnak'",
            "did you mean 'lora.rank'?",
        ),
        (
            with_variant(method="lora", set={"lroa.rank": 4}),
            "variants.x: unknown key 'lroa'",
            "did you mean 'lora'?",
        ),
        (
            with_variant(method="naive", set={"kfac.weight": 1.0}),
            "variants.x.set: kfac.weight",
            "set method: kfac",
        ),
        (
            with_variant(method="kfac", tune={"lora.rank": [4, 16]}),
            "variants.x.tune: lora.rank",
            "set method: lora",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": [4, 0]}),
            "variants.x: lora.rank: 0",
            "its default is 16",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": 4}),
            "variants.x.tune.lora.rank: 4",
            "[0.1, 1, 10]",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": [4, 4]}),
            "variants.x.tune.lora.rank",
            "[0.1, 1, 10]",
        ),
        (
            with_variant(method="aegis", tune={"aegis.restoration": [float("nan"), 1]}),
            "restoration: [nan, 1]",
            "[0.1, 1, 10]",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": [{1: 2, "a": 3}]}),
            "variants.x.tune.lora.rank",
            "[0.1, 1, 10]",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": []}),
            "variants.x.tune.lora.rank",
            "[0.1, 1, 10]",
        ),
        (
            with_variant(method="lora", tune={"lora.rank": [4]}, set={"lora.rank": 8}),
            "in set and in tune",
            "delete",
        ),
        (
            with_variant(method="lora", set={"lora": {"rank": 8}}),
            "variants.x.set: lora",
            "train.backbone_lr: 1e-4",
        ),
        (with_variant(method="lora", set={"seed": 8}), "variants.x.set: seed", "use 'seeds'"),
        (
            with_variant(method="lora", set={"train.method": "aegis"}),
            "variants.x.set: train.method",
            "use 'variants'",
        ),
        (
            with_variant(method="lora", set={"probe.questions": 7}),
            "variants.x.set: probe.questions",
            "move it to 'shared'",
        ),
        (
            with_variant(method="lora", set={"rollout.replan": 21}),
            "variants.x: rollout.replan: 21 with train.chunk: 20",
            "at most 20",
        ),
        (
            with_variant(method="ewc"),
            "anchor.parts: moments, inputs with method ewc",
            "[moments, inputs, fisher]",
        ),
        (
            with_variant(method="nullspace", set={"nullspace.energy": 1.0}),
            "nullspace.energy: 1 with anchor.energy",
            "anchor.energy to 1",
        ),
        (
            with_variant(method="aegis", set={"anchor.source": "demos"}),
            "variants.x: anchor.parts: moments, inputs with anchor.source: demos",
            "set anchor.parts to [moments]",
        ),
        (
            with_variant(method="aegis", against="niave"),
            "variants.x.against: 'niave'",
            "did you mean 'naive'?",
        ),
        (
            with_variant(method="aegis", against="x"),
            "variants.x.against: 'x'",
            "delete variants.x.against",
        ),
        (
            with_variant(method="naive", set={"train.momentum": 0.5}),
            "variants.x: train.momentum: 0.5 with train.optimizer: adamw",
            "set it, or delete",
        ),
        ({"variants": {"naive": {"method": "lora"}}}, "variants.naive.method: lora", "rename"),
        ({"variants": {"a/b": {"method": "lora"}}}, "the variant 'a/b'", "rename"),
        ({"variants": {"x": "lora"}}, "variants.x: lora", "indent"),
        ({"variants": {}}, "variants: {}", "change 'variants'"),
        ({"variants": None}, "no key 'variants'", "add the line"),
        ({"seeds": [0, 0]}, "seeds: [0, 0]", "change 'seeds'"),
        ({"seeds": [0, 1000]}, "tuning.seed: 1000 is also one of seeds", "set tuning.seed to 2000"),
        (
            {"shared": {"probe": {"max_drop": 0.5}}},
            "shared: probe.max_drop: 0.5",
            "delete probe.max_drop",
        ),
        ({"seeds": [0.5]}, "seeds: [0.5]", "change 'seeds'"),
        ({"seeds": [4294967296]}, "seeds: [4294967296]", "change 'seeds'"),
        (
            {"tuning": {**TUNING, "seed": 4294967296}},
            "tuning.seed: 4294967296",
            "its default is 1000",
        ),
        ({"tasks": ["raech"]}, "tasks: ['raech']", "did you mean 'reach'?"),
        ({"tuning": None}, "naive with 'tune'", "add it"),
        (
            {"tuning": {**TUNING, "withn": 3}},
            "unknown key 'tuning.withn'",
            "did you mean 'tuning.within'?",
        ),
        (
            {"shared": {"train": {"stesp": 4}}},
            "shared: unknown key 'train.stesp'",
            "did you mean 'train.steps'?",
        ),
        ({"shared": {"train": {"method": "lora"}}}, "shared: train.method", "use 'variants'"),
        ({"shared": {"task": "point"}}, "shared: task", "use 'tasks'"),
        (
            {"shared": {"rollout": {"colors": ["held-out"]}}},
            "rollout.colors without seen",
            "add seen",
        ),
        ({"keep_runs": 1}, "keep_runs: 1", "its default is false"),
        ({"shraed": {}}, "unknown key 'shraed'", "did you mean 'shared'?"),
        ({"train": {"steps": 3}}, "unknown key 'train'", "did you mean 'shared.train'?"),
        ({"steps": 3}, "unknown key 'steps'", "did you mean 'shared.train.steps'?"),
        ({"seed": 3}, "unknown key 'seed'", "did you mean 'seeds'?"),
        ({"within": 3}, "unknown key 'within'", "did you mean 'tuning.within'?"),
    ],
)
def test_a_mistake_is_refused_by_name(
    changes: dict[str, Any], found: str, fix: str, tmp_path: Path
) -> None:
    error = refusal(tmp_path, raw("embedded", **changes))
    lines = error.found.splitlines()
    number = next(i for i, line in enumerate(lines) if found in line)
    assert fix in error.fix.splitlines()[number]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("    set: {train.stesp: 3}  # wrong", "unknown key 'train.stesp'"),
        ("    set:\n      train.steps: 0  # wrong", "train.steps: 0"),
        ("    set:\n      expert.width: 64\n      seed: 3  # wrong", "set: seed"),
        ("    tune:\n      lora.rank: [4, 0]  # wrong", "lora.rank: 0"),
        ("    tune:\n      lora.rank: [4, 4]  # wrong", "tune.lora.rank: [4, 4]"),
        ("    set:\n      lroa.rank: 4\n    tune:\n      lora.rnak: [2]  # wrong", "'lora.rnak'"),
    ],
)
def test_a_mistake_in_a_key_of_a_variant_names_its_line(
    line: str, found: str, tmp_path: Path
) -> None:
    file = write(tmp_path, raw("embedded", variants={"x": {"method": "lora"}}))
    text = file.read_text().replace("    method: lora\n", f"    method: lora\n{line}\n")
    file.write_text(text)
    number = 1 + next(i for i, each in enumerate(text.splitlines()) if "# wrong" in each)
    with pytest.raises(AegisError) as caught:
        study_cells.load(file)
    assert any(
        found in each and f"line {number})" in each for each in caught.value.found.splitlines()
    )


def test_all_mistakes_are_named_in_one_error_and_shared_ones_once(tmp_path: Path) -> None:
    wrong = with_variant(method="ewc", set={"train.lr": 1}, tune={"ewc.weight": [1, -1]})
    keys = raw("embedded", seeds=[1000], keep_run=True, **wrong)
    keys["shared"]["train"]["steps"] = 0
    keys["variants"]["y"] = {"mehtod": "lora"}
    error = refusal(tmp_path, keys)
    wanted = (
        "keep_run'",
        "tuning.seed",
        "'train.lr'",
        "ewc.weight: -1",
        "shared: train.steps: 0",
        "'variants.y.mehtod'",
        "'variants.y.method'",
    )
    assert error.found.startswith(f"{len(wanted)} problems") and all(
        error.found.count(part) == 1 for part in wanted
    )
    assert (
        error.found.count("\n")
        == error.expected.count("\n")
        == error.fix.count("\n")
        == len(wanted)
    )


def test_a_cell_is_the_shared_recipe_with_the_variants_keys(tmp_path: Path) -> None:
    keys = {"aegis.projects": "both", "train.steps": 9}
    variants = {"x": {"method": "aegis", "set": keys, "tune": {"aegis.restoration": [0, 2]}}}
    loaded = study(tmp_path, "embedded", variants=variants)
    cell = study_cells.cell(loaded, "x", "point", 7, 2)
    assert (cell.task, cell.seed, cell.train.method, cell.methods) == (
        "point",
        7,
        "aegis",
        ("aegis",),
    )
    assert (cell.aegis.projects, cell.aegis.restoration, cell.train.steps) == ("both", 2.0, 9)
    assert (
        cell.train.batch_size == loaded.shared["train"]["batch_size"]
        and loaded.shared["train"]["steps"] == 4
    )
    with pytest.raises(AegisError, match="variant x"):
        study_cells.cell(loaded, "x", "point", 7, -1)


def test_a_study_survives_the_way_to_yaml_and_takes_overrides(tmp_path: Path) -> None:
    loaded = study(tmp_path, "embedded")
    path = tmp_path / "again.yaml"
    path.write_text(recipes.to_yaml(loaded))
    assert study_cells.load(path) == loaded and recipes.digest(
        study_cells.load(path)
    ) == recipes.digest(loaded)
    changed = study_cells.load(
        path,
        ["seeds=[3]", "shared.train.steps=5", "variants.aegis-update.set={aegis.projects: both}"],
    )
    assert (changed.seeds, changed.shared["train"]["steps"]) == ((3,), 5)
    assert changed.variants["aegis-update"].set == {"aegis.projects": "both"}


def test_recipe_and_study_are_told_apart_by_their_keys(tmp_path: Path) -> None:
    assert isinstance(study_cells.load(RECIPES / "quickstart.yaml"), Recipe)
    assert isinstance(study_cells.load(RECIPES / "compare.yaml"), StudyRecipe)
    path = tmp_path / "recipe.yaml"
    path.write_text("name: x\nseeds: [1]\ntrain: {steps: 5}\ntask: reach\n")
    with pytest.raises(AegisError) as caught:
        study_cells.load(path)
    assert caught.value.fix == "did you mean 'seed'?"


def test_a_study_given_to_another_command_is_named() -> None:
    for kind in (Recipe, recipes.PretrainRecipe):
        with pytest.raises(AegisError) as caught:
            recipes.load(RECIPES / "compare.yaml", kind=kind)
        assert "a study of several runs, a recipe for `aegis run`" in caught.value.found
        assert caught.value.fix.startswith("aegis run ")


@pytest.mark.parametrize(
    ("command", "name", "expected"),
    [
        ("train", "compare", "a recipe for `aegis train`, of one run or of a stream"),
        ("train", "igsp-compare", "a recipe for `aegis train`, of one run or of a stream"),
        ("train", "pretrain-dual", "a recipe for `aegis train`, of one run or of a stream"),
        ("run", "igsp-stream", "a recipe for `aegis run`, of one run or of a study"),
        ("run", "igsp-robot", "a recipe for `aegis run`, of one run or of a study"),
        ("pretrain", "quickstart", "a recipe for `aegis pretrain`"),
    ],
)
def test_a_command_says_which_recipes_it_reads(command: str, name: str, expected: str) -> None:
    load = {
        "train": recipes.load_training,
        "run": study_cells.load,
        "pretrain": recipes.load_pretrain,
    }[command]
    with pytest.raises(AegisError) as caught:
        load(RECIPES / f"{name}.yaml")
    assert caught.value.expected == expected and caught.value.fix.endswith(f"{name}.yaml")


def test_the_shipped_studies_compare_what_they_promise() -> None:
    compare, ablations = (
        study_cells.load(RECIPES / f"{name}.yaml") for name in ("compare", "ablations")
    )
    compared = [name for name, v in compare.variants.items() if v.method == name]
    # In the order of tables. A new method may still lack a place in a study.
    assert compared == [name for name in recipes.METHODS if name in compared]
    assert len(compared) >= 11 and "insulate" not in compared  # that is in rivals.yaml
    knobs = {name: len(v.values) for name, v in compare.variants.items() if v.tune}
    assert knobs.pop("naive") == 4 and set(knobs.values()) == {
        3
    }  # one more: the reference for all of them
    assert len(ablations.seeds) == 2 and ablations.tuning is None
    cells = [study_cells.cell(ablations, name, "reach", 0) for name in ablations.variants]
    assert len({str(cell) for cell in cells}) == len(cells) and "naive" in ablations.variants


def test_the_trial_sets_every_variant_beside_naive_of_its_rate_and_optimizer() -> None:
    trial = study_cells.load(RECIPES / "aegis-trial.yaml")
    cells = {name: study_cells.cell(trial, name, "reach", 0) for name in trial.variants}
    assert len({str(cell) for cell in cells.values()}) == len(cells) == 50
    tried: dict[tuple[str, float], set[tuple[str, str]]] = {}
    for name, variant in trial.variants.items():
        cell = cells[name]
        if variant.method == "naive":
            continue
        reference = cells[variant.against or "naive"].train
        assert replace(cell.train, method="naive") == reference, name
        if cell.train.steps == 260 and cell.train.warmup == 15:
            rate = (cell.train.optimizer, cell.train.backbone_lr)
            tried.setdefault(rate, set()).add((cell.anchor.source, cell.aegis.idle))
    product = {(source, idle) for source in ("questions", "demos") for idle in recipes.IDLE}
    assert len(tried) == 8 and all(found == product for found in tried.values())


def test_the_rivals_have_equal_rights_and_seeds_of_their_own() -> None:
    rivals = study_cells.load(RECIPES / "rivals.yaml")
    assert isinstance(rivals, StudyRecipe) and rivals.tuning is not None
    tried = {name: len(v.values) for name, v in rivals.variants.items() if v.tune}
    assert set(tried.values()) == {rivals.tuning.runs} == {6}
    assert rivals.variants.keys() - tried.keys() == {"stop-gradient"}
    others = [study_cells.load(RECIPES / f"{name}.yaml") for name in ("compare", "ablations")]
    assert not set(rivals.seeds) & {seed for study in others for seed in study.seeds}
    assert set(rivals.per_seed or ()) == {"demos", "anchor", "questions", "episodes"}


def test_from_ewc_to_kfac_one_change_at_a_time() -> None:
    rivals = study_cells.load(RECIPES / "rivals.yaml")
    chain = ("ewc", "ewc-samples", "ewc-proximal", "kfac-plain", "kfac-damped", "kfac")
    settings = [{"method": rivals.variants[n].method, **rivals.variants[n].set} for n in chain]
    changes = []
    for one, other in zip(settings, settings[1:]):
        keys = one.keys() | other.keys()
        changes.append({key for key in keys if one.get(key) != other.get(key)})
    product = {"method", "anchor.parts", "anchor.fisher_samples", "ewc.step"}
    undone = {"kfac.damping", "kfac.balance", "kfac.every"}
    assert changes == [
        {"anchor.fisher_samples"},
        {"ewc.step"},
        product | undone,
        {"kfac.damping"},
        {"kfac.balance", "kfac.every"},
    ]


def without_bootstraps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the tables' second interval: for all shipped cells it takes more than a minute."""
    monkeypatch.setattr(metrics, "crossed_interval", lambda *_, **__: None)


@pytest.mark.parametrize(
    ("name", "entries", "cells"),
    [
        ("compare", 160, 162),
        ("ablations", 58, 58),
        ("igsp-compare", 302, 317),
        ("anchors", 15, 15),
        ("aegis-refresh", 15, 15),
        ("intervals", 21, 21),
        ("anchor-transfer", 21, 21),
        ("anchor-temperature", 15, 15),
        ("regime", 24, 24),
        ("aegis-trial", 150, 150),
        ("merges", 34, 34),
        ("plateau", 12, 12),
        ("longer", 9, 9),
        ("longer-rivals", 12, 12),
        ("rivals", 139, 139),
        ("metaworld-study", 24, 24),
        ("metaworld-stream-study", 9, 9),
    ],
)
def test_every_shipped_cell_is_still_found_by_its_key(
    name: str, entries: int, cells: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change that makes finished cells stale, or swaps them, has to move them too.

    The studies are run on the shipped figures alone: a cell that is not found would be trained.
    Equal cells share one entry.
    """
    fake_bench(monkeypatch)
    without_bootstraps(monkeypatch)
    monkeypatch.setattr(PolicyRunner, "anchor", lambda *_: SimpleNamespace(path=tmp_path))
    for runner in (PolicyRunner, StreamRuns):
        monkeypatch.setattr(runner, "measure", lambda _, cell: pytest.fail(f"{cell.label} is new"))
    shipped = RECIPES / "results" / f"{name}.cells.json"
    kept = files.load_json(shipped).values()
    assert len([one for one in kept if "peak_memory" not in one]) == entries
    (tmp_path / name).mkdir()
    shutil.copy(shipped, tmp_path / name / "cells.json")

    report = stage.run(study_cells.load(RECIPES / f"{name}.yaml"), tmp_path)
    assert report.finished == report.cells == cells


@pytest.mark.parametrize(
    "name",
    [
        "compare",
        "ablations",
        "igsp-compare",
        "anchors",
        "aegis-refresh",
        "intervals",
        "anchor-transfer",
        "anchor-temperature",
        "regime",
        "aegis-trial",
        "merges",
        "plateau",
        "longer",
        "longer-rivals",
        "rivals",
        "metaworld-study",
        "metaworld-stream-study",
    ],
)
def test_every_shipped_entry_is_a_cell_of_its_study(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some have values that are no longer chosen since another seed was added."""
    without_bootstraps(monkeypatch)
    study = study_cells.load(RECIPES / f"{name}.yaml")
    kind = stage.kind_of(study)
    cells = [cell for own in stage.trials(kind).values() for _, cell in own]
    for variant, settings in study.variants.items():
        for place in kind.places:
            for seed in study.seeds:
                for value in settings.values:
                    cells.append(Cell("any", kind.cell(variant, place, seed, value)))
    runner = kind.make_runner(tmp_path, ignore)
    known = {runner.key(cell) for cell in cells}
    path = RECIPES / "results" / f"{name}.cells.json"
    shipped = files.load_json(path)
    costs = {key for key, one in shipped.items() if "peak_memory" in one}
    assert shipped and shipped.keys() - costs <= known
    asked, real = set[str](), policy_cells._cost_key

    def cost_key(*given: Any) -> str:
        asked.add(key := real(*given))
        return key

    monkeypatch.setattr(policy_cells, "_cost_key", cost_key)
    stage.told(study, path)
    assert costs <= asked


def without_seeds(**changes: Any) -> dict[str, Any]:
    """The keys of a study whose shared sections contain no seeds."""
    keys = raw("embedded", **changes)
    for section in ("demos", "anchor", "probe", "rollout"):
        del keys["shared"][section]["seed"]
    return keys


def test_what_is_drawn_per_seed_has_the_seed_of_its_cell(tmp_path: Path) -> None:
    per_seed = ["demos", "anchor", "questions", "episodes"]
    loaded = study_cells.load(write(tmp_path, without_seeds(per_seed=per_seed)))
    made = study_cells.cell(loaded, *CELL)
    seeds = (made.demos.seed, made.anchor.seed, made.probe.seed, made.rollout.seed)
    assert seeds == (1, 1, 1, 1)
    plain = study_cells.cell(study_cells.load(write(tmp_path, raw("embedded"))), *CELL)
    assert (plain.demos.seed, plain.anchor.seed, plain.probe.seed, plain.rollout.seed) == (0,) * 4


@pytest.mark.parametrize("where", ["shared", "variant"])
def test_a_seed_that_the_study_draws_cannot_be_set(where: str, tmp_path: Path) -> None:
    keys = without_seeds(per_seed=["demos"])
    if where == "shared":
        keys["shared"]["demos"]["seed"] = 7
    else:
        keys["variants"]["aegis-update"]["set"]["demos.seed"] = 7
    error = refusal(tmp_path, keys)
    assert "demos.seed" in error.found and "per_seed" in error.fix


def test_demonstrations_that_are_given_cannot_be_drawn(tmp_path: Path) -> None:
    keys = without_seeds(per_seed=["demos", "questions"])
    keys["shared"]["demos"]["path"] = "reach.safetensors"
    error = refusal(tmp_path, keys)
    assert "demos.path: reach.safetensors" in error.found and "out of per_seed" in error.fix


def test_several_knobs_are_tried_in_all_combinations(tmp_path: Path) -> None:
    tune = {"train.backbone_lr": [1e-4, 1e-3], "lora.rank": [2, 4]}
    keys = with_variant(method="lora", tune=tune)
    loaded = study_cells.load(write(tmp_path, raw("embedded", **keys)))
    variant = loaded.variants["x"]
    assert variant.knob == "train.backbone_lr, lora.rank"
    made = [study_cells.cell(loaded, "x", "reach", 0, value) for value in variant.values]
    chosen = [(cell.train.backbone_lr, cell.lora.rank) for cell in made]
    assert chosen == [(1e-4, 2), (1e-4, 4), (1e-3, 2), (1e-3, 4)]


def test_every_tuned_variant_gets_as_many_trials_as_the_tuning_says(tmp_path: Path) -> None:
    keys = with_variant(method="lora", tune={"lora.rank": [2, 4, 8]})
    error = refusal(tmp_path, raw("embedded", tuning={**TUNING, "runs": 2}, **keys))
    assert "variants.x.tune: 3 values" in error.found and "tuning.runs" in error.expected
    study_cells.load(write(tmp_path, raw("embedded", tuning={**TUNING, "runs": 2})))
