"""Recipes: strict reading, all errors at once, and a lossless conversion back to YAML."""

from __future__ import annotations

import dataclasses
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from pydantic import TypeAdapter, ValidationError

from aegis_cli import methods, sim
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import learners
from aegis_cli.recipes import (
    KINDS,
    LEARNERS,
    METHODS,
    NEEDS,
    ROBOT_LEARNERS,
    TASKS,
    Aegis,
    AnyStudy,
    DualRecipe,
    PretrainRecipe,
    Recipe,
    RobotStreamRecipe,
    RobotStreamStudyRecipe,
    StreamRecipe,
    StreamTrain,
    StudyRecipe,
    Train,
    changed,
    digest,
    load,
    load_pretrain,
    load_training,
    name_of,
    options,
    recorded,
    strict_yaml,
    study_cells,
    to_yaml,
    training_part,
)
from aegis_cli.recipes.keys import POSITIVE, is_retired, key
from aegis_cli.recipes.streams import UNREAD_RATES

RECIPES = sorted((Path(__file__).parent.parent.parent / "recipes").glob("*.yaml"))


def load_shipped(
    path: Path,
) -> PretrainRecipe | DualRecipe | Recipe | StreamRecipe | RobotStreamRecipe | StudyRecipe:
    if path.stem in ("igsp-stream", "igsp-mtil", "igsp-robot", "metaworld-stream"):
        return load_training(path)
    return load_pretrain(path) if path.stem.startswith("pretrain") else study_cells.load(path)


def write(folder: Path, text: str) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder: Path, text: str, *overrides: str, kind: type = Recipe) -> AegisError:
    with pytest.raises(AegisError) as caught:
        load(write(folder, text), list(overrides), kind)
    return caught.value


def test_the_shipped_recipes_are_found():
    assert {
        "quickstart",
        "reach",
        "point",
        "pretrain-embedded",
        "pretrain-dual",
        "compare",
        "ablations",
        "aegis-trial",
        "anchor-transfer",
    } <= {p.stem for p in RECIPES}


def test_recipes_know_exactly_the_tasks_and_methods_there_are():
    assert set(TASKS) == set(sim.TASKS)
    assert tuple(methods.METHODS) == METHODS
    assert tuple(learners.LEARNERS) == LEARNERS and set(ROBOT_LEARNERS) < set(LEARNERS)
    needs = {name: set(m.needs) for name, m in methods.METHODS.items()}
    assert {name: parts for name, parts in needs.items() if parts} == {
        name: set(parts) for name, parts in NEEDS.items()
    }


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_a_shipped_recipe_loads_and_starts_with_its_command(path):
    loaded = load_shipped(path)
    first, command = (
        path.read_text().splitlines()[0],
        "pretrain" if isinstance(loaded, PretrainRecipe | DualRecipe) else "run",
    )
    assert loaded.name == path.stem
    if isinstance(loaded, StreamRecipe | RobotStreamRecipe):
        assert first == f"# aegis train recipes/{path.name} --out runs/{path.stem}"
    else:
        assert first == f"# aegis {command} recipes/{path.name}"


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_yaml_round_trip_keeps_every_value_and_the_digest(path, tmp_path):
    recipe = load_shipped(path)
    again = load_shipped(write(tmp_path, to_yaml(recipe)).rename(tmp_path / path.name))
    assert again == recipe
    assert digest(again) == digest(recipe)


@pytest.mark.parametrize("value", [1e-4, 1e-5, 3e-10, 1e-22, 1e22, 0.0, 7.0])
def test_round_trip_of_small_and_large_numbers(value, tmp_path):
    recipe = Recipe(name="x")
    recipe = dataclasses.replace(recipe, train=dataclasses.replace(recipe.train, backbone_lr=value))
    assert load(write(tmp_path, to_yaml(recipe))) == recipe


def test_a_name_of_any_language_is_written_as_it_is(tmp_path):
    recipe = Recipe(name="x", backbone="models/für Möbel")
    assert "backbone: models/für Möbel\n" in to_yaml(recipe)
    assert load(write(tmp_path, to_yaml(recipe))) == recipe


@pytest.mark.parametrize("name", ["no", "1e3", "010", "2024-01-01", "null", "true", "12"])
def test_round_trip_of_names_that_look_like_something_else(name, tmp_path):
    assert load(write(tmp_path, to_yaml(Recipe(name=name)))).name == name


def test_digest_follows_values_not_spelling(tmp_path):
    spelled = "name: x\ntrain:\n  backbone_lr: 1e-4\n"
    other = "train: {backbone_lr: 0.0001}   # a comment\nname: 'x'\n"
    assert digest(load(write(tmp_path, spelled))) == digest(load(write(tmp_path, other)))
    assert digest(load(write(tmp_path, spelled))) != digest(
        load(write(tmp_path, spelled), ["seed=1"])
    )


@pytest.mark.parametrize("text", ["1e-4", "1E-4", "1.e-4", ".0001", "0.0001", "+1e-04"])
def test_every_spelling_of_a_number_is_a_number(text, tmp_path):
    assert (
        load(write(tmp_path, f"name: x\ntrain:\n  backbone_lr: {text}")).train.backbone_lr == 1e-4
    )
    assert load(write(tmp_path, "name: x"), [f"train.backbone_lr={text}"]).train.backbone_lr == 1e-4


def test_overrides_win_and_the_last_one_most(tmp_path):
    path = write(tmp_path, "name: x\nseed: 1\n")
    recipe = load(
        path,
        [
            "seed=2",
            "seed=3",
            "train.steps=7",
            "methods=[aegis, lora]",
            "probe.max_drop=0.5",
            "task=point",
        ],
    )
    assert (recipe.seed, recipe.train.steps, recipe.methods) == (3, 7, ("aegis", "lora"))
    assert (recipe.probe.max_drop, recipe.task) == (0.5, "point")


@pytest.mark.parametrize(
    ("text", "value"),
    [("top", "top"), ("[top, wrist]", ("top", "wrist")), ("[top]", ("top",)), ("null", None)],
)
def test_one_camera_or_several(text, value, tmp_path):
    recipe = load(write(tmp_path, "name: x"), [f"demos.camera={text}"])
    assert recipe.demos.camera == value
    assert load(write(tmp_path, to_yaml(recipe))) == recipe


def test_betas_may_be_alike_and_come_back_from_the_file(tmp_path):
    alike = load(write(tmp_path, "name: x"), ["train.betas=[0, 0]"])
    assert alike.train.betas == (0.0, 0.0)
    assert load(write(tmp_path, to_yaml(alike))) == alike


def test_an_optional_key_takes_null(tmp_path):
    assert (
        load(
            write(tmp_path, "name: x\nprobe: {max_drop: 1}"), ["probe.max_drop=null"]
        ).probe.max_drop
        is None
    )


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("train.steps=0", "a whole number, above 0"),
        ("train.steps=1.5", "a whole number"),
        ("expert.width=17", "above 0 and even"),
        ("train.steps=1e3", "a whole number"),
        ("train.steps=1" + "0" * 400, "a whole number, above 0, at most 1,000,000,000,000"),
        ("train.batch_size=1000000000001", "above 0, at most 1,000,000,000,000"),
        ("train.extended_from=[1000000000001]", "at most 1,000,000,000,000"),
        ("ewc.weight=1e300", "a number, 0 or more, at most 1e+30"),
        ("demos.weights=[1.0, 2e30]", "at most 1e+30"),
        ("train.betas=[0.9]", "a list of two numbers such as [0.9, 0.95]"),
        ("train.betas=[0.9, 0.95, 0.99]", "a list of two numbers"),
        ("train.betas=[0.9, 1]", "each 0 or more and below 1"),
        ("train.betas=0.9", "a list of two numbers"),
        ("train.betas=[0.9, many]", "a list of two numbers"),
        ("train.eps=0", "a number, 1e-30 or more"),
        ("train.steps=true", "a whole number"),
        ("train.steps=many", "a whole number"),
        ("train.steps=", "a whole number"),
        ("train.backbone_lr=-1e-4", "a number, 0 or more"),
        ("train.backbone_lr=.nan", "a number"),
        ("train.backbone_lr=.inf", "a number"),
        ("train.validation_share=0", "above 0 and below 1"),
        ("train.validation_share=1", "above 0 and below 1"),
        ("train.compile=1", "true or false"),
        ("train.precision=fp16", "one of auto, bf16, float32"),
        ("demos.episodes=0", "from 1 to 10,000,000"),
        ("rollout.episodes=1000000000000", "from 1 to 10,000,000"),
        ("probe.questions=1000000000000", "at most 10,000,000"),
        ("train.backbone_lr=1" + "0" * 400, "train.backbone_lr: a number"),
        ("seed=-1", "from 0 to 4294967295"),
        ("seed=4294967296", "from 0 to 4294967295"),
        ("demos.seed=4294967296", "from 0 to 4294967295"),
        ("anchor.seed=4294967296", "from 0 to 4294967295"),
        ("seed=010", "a whole number"),
        ("name=a/b", "letters, digits"),
        ("name=..", "letters, digits"),
        ("backbone=' '", "not empty"),
        ("methods=aegis", "a list"),
        ("methods=[]", "a list"),
        ("methods=[aegis, aegis]", "different words"),
        ("demos.camera=3", "text, or a list of different words"),
        ("train.extended_from=[a]", "a list of different whole numbers"),
        ("demos.camera=[]", "text, or a list"),
        ("demos.camera=[top, top]", "different words"),
        ("demos.camera=[top, ' ']", "not empty"),
        ("rollout.colors=[blue]", "one of seen, held-out"),
        ("train=5", "a section"),
        ("train=", "a section"),
    ],
)
def test_a_wrong_value_is_refused_with_what_is_expected(setting, expected, tmp_path):
    error = refusal(tmp_path, "name: x", setting)
    assert setting.split("=")[0] in error.found
    assert expected in error.expected
    assert error.fix


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("name: x\ntrain: {stesp: 5}", "train.steps"),
        ("name: x\ntrian: {steps: 5}", "train"),
        ("name: x\ntrain: {precision: BF16}", "bf16"),
        ("name: x\ntask: raech", "reach"),
        ("name: x\nmethods: [naive, stopgradient]", "stop-gradient"),
    ],
)
def test_a_typo_gets_the_close_match(text, meant, tmp_path):
    assert refusal(tmp_path, text).fix == f"did you mean '{meant}'?"


@pytest.mark.parametrize(
    ("setting", "fix"),
    [
        ("steps=3", "did you mean 'train.steps'?"),
        ("width=32", "did you mean 'expert.width'?"),
        (
            "skip_bad=true",
            "did you mean 'anchor.skip_bad' or 'insulate.skip_bad' or 'cotrain.skip_bad' or "
            "'probe.skip_bad'?",
        ),
        ("methods=naive", "write 'methods: [naive]', or --set 'methods=[naive]'"),
        (
            "methods=naive,aegsi",
            "write 'methods: [naive, aegis]', or --set 'methods=[naive, aegis]'",
        ),
        (
            "rollout.colors=seen held-out",
            "write 'rollout.colors: [seen, held-out]', or --set 'rollout.colors=[seen, held-out]'",
        ),
        ("wholly_unknown=3", "delete 'wholly_unknown'"),
        ("train.lr=1e-4", "did you mean 'train.backbone_lr' or 'train.expert_lr'?"),
    ],
)
def test_a_key_without_its_section_and_a_list_without_its_brackets_say_what_was_meant(
    setting, fix, tmp_path
):
    assert refusal(tmp_path, "name: x", setting).fix == fix


def test_all_problems_are_named_at_once(tmp_path):
    error = refusal(
        tmp_path,
        "seed: 1\nseed: 2\ntrain: {steps: -1, stesp: 4}\ndemos: 3",
        "train.precision=fp8",
        "junk",
    )
    for part in (
        "7 problems",
        "'seed' twice",
        "train.steps: -1",
        "'train.stesp'",
        "demos: 3",
        "no key 'name'",
        "'fp8'",
        "'junk'",
    ):
        assert part in error.found
    assert error.found.count("\n") == error.expected.count("\n") == error.fix.count("\n") == 7


def test_a_key_given_twice_names_both_lines(tmp_path):
    error = refusal(tmp_path, "name: x\ntrain:\n  steps: 5\n  warmup: 1\n  steps: 6\n")
    assert "'steps' twice, in lines 3 and 5" in error.found


@pytest.mark.parametrize("setting", ["train.steps", "=5", ".steps=5", "train..steps=5", "name.x=5"])
def test_a_malformed_override_is_refused(setting, tmp_path):
    assert setting in refusal(tmp_path, "name: x", setting).found


@pytest.mark.parametrize("text", ["", "# only a comment", "- a\n- b", "just words"])
def test_a_file_without_keys_is_refused(text, tmp_path):
    assert "no keys" in refusal(tmp_path, text).found


@pytest.mark.parametrize(
    "text", ["name: [x", "name: x\n\tseed: 1", "a: b: c", "name: !!python/object:os.system x"]
)
def test_broken_yaml_is_refused_with_its_line(text, tmp_path):
    assert "line" in refusal(tmp_path, text).found


def test_an_override_that_is_no_yaml_is_refused(tmp_path):
    assert "--set 'methods=[aegis'" in refusal(tmp_path, "name: x", "methods=[aegis").found


@pytest.mark.parametrize(
    ("setting", "fix"),
    [
        ("demos.only=2", "--set \"demos.only='2'\""),
        ("name=2024", "--set \"name='2024'\""),
        ("probe.ask=Question: {}", "put the text in quotes: probe.ask: '...'"),
        ("probe.ask=Q: it's {} A: x", "--set probe.ask='"),
    ],
)
def test_a_text_that_yaml_takes_for_something_else_is_told_to_be_quoted(setting, fix, tmp_path):
    assert fix in refusal(tmp_path, "name: x", setting).fix


@pytest.mark.parametrize("text", ["Question: {} Answer:", "it's {}: what", "a: {}", "{} 'x'"])
def test_the_quotes_that_are_advised_give_the_text(text, tmp_path):
    (quoted,) = shlex.split(strict_yaml._quoted(text))
    recipe = load(write(tmp_path, "name: x"), (f"probe.ask={quoted}",))
    assert recipe.probe.ask == text


def test_what_an_alias_names_is_its_own(tmp_path):
    text = "kind: study\nname: x\ntasks: [reach]\nseeds: [0]\nvariants:\n  naive: {method: naive}\n"
    text += "  a: &v {method: lora, set: {train.steps: 9}}\n  b: *v\n"
    overrides = ("variants.a.method=l2sp", "variants.b.set={train.steps: 4}")
    loaded = study_cells.load(write(tmp_path, text), overrides).variants
    assert [loaded[name].method for name in "ab"] == ["l2sp", "lora"]
    assert [dict(loaded[name].set) for name in "ab"] == [{"train.steps": 9}, {"train.steps": 4}]


def test_a_missing_file_names_its_neighbour(tmp_path):
    write(tmp_path, "name: x").rename(tmp_path / "quickstart.yaml")
    with pytest.raises(AegisError) as caught:
        load(tmp_path / "quickstrat.yaml")
    assert caught.value.fix == f"did you mean {tmp_path / 'quickstart.yaml'}?"


def test_a_missing_file_of_a_shipped_name_says_that_the_name_will_do(tmp_path):
    with pytest.raises(AegisError) as caught:
        load(tmp_path / "smolvla-style.yaml")
    assert caught.value.fix.endswith("found by its name alone: smolvla-style")
    with pytest.raises(AegisError, match="aegis recipes ls"):
        load(tmp_path / "my-own.yaml")


def test_a_key_without_a_default_may_be_left_out(tmp_path):
    fix = refusal(tmp_path, "name: x", "demos.weights=[0, 1]").fix
    assert fix == "change 'demos.weights', or leave it out"


def test_a_folder_or_binary_file_is_refused(tmp_path):
    with pytest.raises(AegisError):
        load(tmp_path)
    (tmp_path / "x.yaml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(AegisError, match="not text"):
        load(tmp_path / "x.yaml")


def test_a_recipe_of_the_other_command_is_named(tmp_path):
    assert refusal(tmp_path, to_yaml(PretrainRecipe(name="x"))).fix.startswith("aegis pretrain")
    assert refusal(tmp_path, to_yaml(Recipe(name="x")), kind=PretrainRecipe).fix.startswith(
        "aegis run"
    )
    assert refusal(tmp_path, to_yaml(DualRecipe(name="x"))).fix.startswith("aegis pretrain")
    assert refusal(tmp_path, to_yaml(Recipe(name="x")), kind=DualRecipe).fix.startswith("aegis run")
    spaced = tmp_path / "a recipe"
    spaced.mkdir()
    said = refusal(spaced, to_yaml(DualRecipe(name="x"))).fix
    command, verb, path = shlex.split(said)
    assert (command, verb) == ("aegis", "pretrain") and Path(path).parent == spaced


@pytest.mark.parametrize(
    "recipe", [PretrainRecipe(name="x"), DualRecipe(name="x")], ids=lambda r: type(r).__name__
)
def test_a_pretraining_recipe_is_told_by_its_keys(recipe, tmp_path):
    assert load_pretrain(write(tmp_path, to_yaml(recipe))) == recipe
    own = {"PretrainRecipe": "scenes: 8", "DualRecipe": "pictures: 8"}[type(recipe).__name__]
    assert type(load_pretrain(write(tmp_path, f"name: x\n{own}\nbatch_size: 4\n"))) is type(recipe)
    assert isinstance(load_pretrain(write(tmp_path, "name: x")), PretrainRecipe)


def test_a_problem_names_its_line(tmp_path):
    text = "name: x\n\ntrain:\n  steps: 5\n  wramup: 1\n"
    assert refusal(tmp_path, text).found == (
        f"unknown key 'train.wramup' (in {tmp_path / 'recipe.yaml'}, line 5)"
    )
    several = refusal(tmp_path, text + "seed: -1\n", "train.steps=0")
    assert [line[line.index(".") + 2 :] for line in several.found.splitlines()[1:]] == [
        "train.steps: 0",  # from --set, not from the file
        "unknown key 'train.wramup' (line 5)",
        "seed: -1 (line 6)",
    ]


def test_a_problem_of_an_override_is_not_said_to_be_in_the_file(tmp_path):
    assert refusal(tmp_path, "name: x\n", "train.stepz=3").found == (
        f"unknown key 'train.stepz' (in {tmp_path / 'recipe.yaml'} with its --set)"
    )


def test_a_problem_of_a_studys_variant_names_its_line(tmp_path):
    text = "kind: study\nname: x\ntasks: [reach]\nseeds: [0]\nvariants:\n  naive:\n    set: {}\n"
    with pytest.raises(AegisError) as caught:
        study_cells.load(write(tmp_path, text))
    assert caught.value.found.startswith("no key 'variants.naive.method'")
    assert caught.value.found.endswith("recipe.yaml, line 6)")


def test_pydantic_is_loaded_only_where_something_is_decoded():
    program = "import sys, aegis_cli.cli.app; assert 'pydantic' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_pydantic_decodes_a_section_as_it_is_written():
    decode = TypeAdapter(Recipe).validate_python
    assert decode({"name": "x", "train": {"backbone_lr": 1}}) == Recipe(
        name="x", train=Train(backbone_lr=1.0)
    )
    assert type(decode({"name": "x", "train": {"backbone_lr": 1}}).train.backbone_lr) is float
    for wrong in ({"steps": True}, {"steps": 2.0}, {"steps": "2"}, {"steps": 0}, {"stesp": 2}):
        with pytest.raises(ValidationError):
            decode({"name": "x", "train": wrong})


@pytest.mark.parametrize("path", RECIPES, ids=lambda p: p.stem)
def test_a_shipped_recipe_says_its_kind_and_an_older_one_without_it_is_the_same(path, tmp_path):
    text, shipped = path.read_text(), study_cells.load_any(path)
    line = f"kind: {name_of(type(shipped))}\n"
    assert line in text and to_yaml(shipped).startswith(line)
    if isinstance(shipped, RobotStreamStudyRecipe):
        return  # every file of this kind has named it
    older = write(tmp_path, text.replace(line, ""))
    if not isinstance(shipped, PretrainRecipe):  # only `aegis pretrain` reads these by default
        assert study_cells.load_any(older) == shipped
    assert digest(load_shipped(older.rename(tmp_path / path.name))) == digest(shipped)


def test_every_kind_is_written_and_read_again(tmp_path):
    given = {StreamRecipe: {"stream": "primer"}, RobotStreamRecipe: {"tasks": ("reach",)}}
    for name, kind in KINDS.items():
        if kind.recipe not in get_args(AnyStudy):
            made = kind.recipe(name="x", **given.get(kind.recipe, {}))
            path = write(tmp_path, to_yaml(made))
            assert path.read_text().startswith(f"kind: {name}\n")
            assert load(path, kind=kind.recipe) == study_cells.load_any(path) == made


def test_a_kind_that_there_is_not_is_refused_with_the_one_that_was_meant(tmp_path):
    error = refusal(tmp_path, "name: x\nkind: strem\nstream: primer\n")
    assert "kind: strem" in error.found and "line 2" in error.found
    assert error.fix == "did you mean 'stream'?"


def test_the_kind_that_a_recipe_says_decides_whatever_its_keys(tmp_path):
    path = write(tmp_path, "kind: policy\nname: x\nstream: primer\n")
    with pytest.raises(AegisError, match="unknown key 'stream'"):
        load_training(path)
    with pytest.raises(AegisError, match="a stream of robot tasks"):
        load(write(tmp_path, "kind: robot-stream\nname: x\n"))


def test_a_retired_key_is_read_and_recorded_but_written_only_with_a_value_of_its_own(tmp_path):
    text = "kind: policy\nname: x\ntrain:\n  leak_every: {}\n"
    plain, own = (load(write(tmp_path, text.format(every))) for every in (10, 3))
    assert "leak" not in to_yaml(plain) and "leak_every: 3" in to_yaml(own)
    assert load(write(tmp_path, to_yaml(own))) == own
    assert training_part(plain)["train"]["leak_every"] == 10  # as in runs from before


@pytest.mark.parametrize("kind", [k.recipe for k in KINDS.values()], ids=list(KINDS))
def test_every_key_says_what_it_means(kind):
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default):
            inner = dataclasses.fields(field.default)
            said = {f.name for f in inner if f.metadata.get("doc", "").endswith(".")}
            assert said == {f.name for f in inner if not is_retired(f)}
        elif "None" not in str(field.type) or field.metadata:
            assert field.metadata["doc"].endswith(".")


@pytest.mark.parametrize(
    ("kind", "setting"),
    [
        (PretrainRecipe, "model.heads=5"),
        (DualRecipe, "towers.heads=5"),
        (Recipe, "rollout.replan=9"),
        (Recipe, "rollout.ensemble=0.01"),
    ],
)
def test_keys_that_do_not_go_together_are_refused(kind, setting, tmp_path):
    assert setting.replace("=", ": ") in refusal(tmp_path, "name: x", setting, kind=kind).found


@pytest.mark.parametrize(
    ("setting", "found"),
    [
        ("train.final_lr_share=0", "train.final_lr_share: 0 with train.schedule: constant"),
        ("kfac.growth=1", "kfac.growth: 1 with train.schedule: constant"),
        ("kfac.growth=-1", "kfac.growth: -1 with train.schedule: constant"),
    ],
)
def test_a_constant_schedule_takes_nothing_that_belongs_to_a_fall(setting, found, tmp_path):
    told = refusal(tmp_path, "name: x", "train.schedule=constant", setting)
    assert told.found.startswith(found) and "delete " + setting.partition("=")[0] in told.fix
    for falling in ("cosine", "linear"):
        load(write(tmp_path, "name: x"), [f"train.schedule={falling}", setting])


def test_a_constant_schedule_takes_the_share_that_says_the_same(tmp_path):
    settings = ["train.schedule=constant", "train.final_lr_share=1"]
    assert load(write(tmp_path, "name: x"), settings).train.schedule == "constant"


@pytest.mark.parametrize(
    ("without", "settings", "found"),
    [
        (
            ["train.final_lr_share=0.5", "kfac.growth=1"],
            ["train.final_lr_share=1"],
            "kfac.growth: 1 with train.final_lr_share: 1",
        ),
        (["kfac.every=2"], ["kfac.step=gradient"], "kfac.every: 2 with kfac.step: gradient"),
        (["kfac.growth=1"], ["kfac.step=gradient"], "kfac.growth: 1 with kfac.step: gradient"),
    ],
)
def test_an_option_of_a_method_that_another_takes_all_effect_from_is_refused(
    without, settings, found, tmp_path
):
    load(write(tmp_path, "name: x"), without)
    told = refusal(tmp_path, "name: x", *without, *settings)
    assert told.found.startswith(found), told.found
    load(write(tmp_path, "name: x"), settings)  # each of them alone is fine


def test_a_stream_of_robot_tasks_has_no_gate_and_says_so(tmp_path):
    found = refusal(tmp_path, "name: x\ntasks: [reach]", "probe.gate=upper", kind=RobotStreamRecipe)
    assert "probe.gate: upper with a stream" in found.found and found.fix == "delete probe.gate"


def test_an_option_is_left_out_of_keys_at_the_default_that_it_came_with() -> None:
    """A digest does not use today's defaults, but those that an option had when it was added.

    Measurements under the old default do not count for the new one, and need not be repeated.
    """

    @dataclasses.dataclass(frozen=True)
    class Section:
        moved: int = key(POSITIVE, default=5, first=3)
        stayed: int = key(POSITIVE, default=1)
        plain: bool = False

    assert changed(Section()) == {"moved": 5} and changed(Section(moved=3)) == {}
    assert changed(Section(moved=3, stayed=2, plain=True)) == {"stayed": 2, "plain": True}


def test_a_key_that_came_later_is_no_part_of_a_record_until_it_is_used():
    """So results from before the key existed are still up to date."""

    @dataclasses.dataclass(frozen=True)
    class Section:
        old: int = key(POSITIVE, default=1)
        late: int = key(POSITIVE, default=2, later=True)

    assert recorded(Section()) == {"old": 1}
    assert recorded(Section(old=3, late=4)) == {"old": 3, "late": 4}


def test_the_training_part_is_what_it_was_before_optimizers_and_refreshing():
    part = training_part(Recipe(name="x", train=Train(method="aegis")))
    later = {"optimizer", "momentum", "betas", "eps", "schedule"}
    assert not later & part["train"].keys()
    assert not {"idle", "refresh"} & part["aegis"].keys()
    sgd = Recipe(name="x", train=Train(method="aegis", optimizer="sgd"), aegis=Aegis(refresh=4))
    assert training_part(sgd)["train"]["optimizer"] == "sgd"
    assert training_part(sgd)["aegis"]["refresh"] == 4


def test_a_study_knows_which_rates_a_learner_never_reads():
    for name in LEARNERS:
        learner = learners.get(name)
        unread = set(UNREAD_RATES.get(name, {}))
        if learner.trains == "experts":
            own = options(StreamRecipe(name="x", stream="primer", train=StreamTrain(method=name)))
            assert unread == ({"train.router_lr"} if "router_lr" in own else set())
        else:
            assert unread == {"train.lr", "train.router_lr"}
