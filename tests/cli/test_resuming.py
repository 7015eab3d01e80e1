"""`aegis train RUN`: a run resumes by what its own folder says, wherever it is called from."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from samples.tiny import make_tiny
from samples.training_runs import assert_same_run, stop_at
from samples.user_folder import TRAIN, training

from aegis_cli import recipes
from aegis_cli.cli import stages
from aegis_cli.common import files
from aegis_cli.evaluation import results
from aegis_cli.training import checkpoint, inputs, train

Aegis = Callable[..., tuple[int, str, str]]
Bad = Callable[..., str]


def cut(
    place: Path,
    method: str = "aegis",
    steps: int = 2,
    sets: tuple[str, ...] = ("demos.safetensors",),
) -> Path:
    """A run of the folder's recipe that ended after this many of its three steps."""
    resolved = recipes.load(place / "small.yaml", ["train.steps=3"])
    anchor = None if method == "naive" else Path("anchor.safetensors")
    with pytest.raises(KeyboardInterrupt):
        train.run(
            resolved,
            method,
            tuple(map(Path, sets)),
            anchor,
            Path("cut"),
            on_event=stop_at(steps, KeyboardInterrupt()),
        )
    return place / "cut"


def steps_of(run: Path) -> int:
    return checkpoint.step_of(checkpoint.last(run))


def test_it_ends_in_the_bytes_of_a_run_that_was_never_interrupted(
    place: Path, aegis: Aegis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert aegis(*training(out="whole"), "--set", "train.steps=3")[0] == 0
    run = cut(place)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    code, out, err = aegis("train", run, "--json")
    assert code == 0, err
    assert (json.loads(out)["steps"], json.loads(out)["out"]) == (3, str(run))
    assert_same_run(run, place / "whole")


def test_what_the_recipe_names_from_another_folder_is_looked_for_there(
    place: Path, bad: Bad, aegis: Aegis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = "train", "small.yaml", "--method", "naive", "--demos", "demos.safetensors"
    code, _, err = aegis(*words, "--out", "run", "--set", "backbone=model.safetensors")
    assert code == 0, err
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    bad("train", place / "run", says=(f"'{place}'", f"cd {place} && aegis train {place}/run"))
    gated = "probe", place / "run", "--max-drop", 3
    bad(*gated, says=(f"cd {place} && aegis probe {place}/run",))
    moved = place.rename(tmp_path / "moved")
    bad("train", moved / "run", says=(f"cd {moved} && aegis train {moved}/run",))
    code, _, err = aegis("train", moved / "run", "--set", f"backbone={moved}/model.safetensors")
    assert code == 0, err
    monkeypatch.chdir(moved)
    assert aegis("train", "run")[0] == 0


def test_a_run_of_several_sets_goes_on_with_all_of_them(
    place: Path, aegis: Aegis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _, err = aegis("demos", "reach", "--episodes", 8, "--seed", 5, "--out", "new.safetensors")
    assert code == 0, err
    run = cut(place, "naive", sets=("demos.safetensors", "new.safetensors"))
    monkeypatch.chdir(tmp_path)
    code, _, err = aegis("train", run)
    assert code == 0 and steps_of(run) == 3, err
    kept = inputs.of(run)
    assert kept is not None
    assert kept.demos == tuple(str(place / f"{name}.safetensors") for name in ("demos", "new"))


def test_a_crash_before_the_first_checkpoint_begins_again(place: Path, aegis: Aegis) -> None:
    run = cut(place, "naive")
    shutil.rmtree(run / "checkpoints")
    (run / "ledger.safetensors").unlink()
    code, _, err = aegis("train", "cut")
    assert code == 0 and steps_of(run) == 3, err


def test_an_interruption_names_the_command(
    place: Path, aegis: Aegis, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, begun = stages.TRAIN[recipes.Recipe].module, train.run

    def interrupted(*args: object, on_event: object, **options: object) -> None:
        begun(*args, **options, on_event=stop_at(2, KeyboardInterrupt()))

    monkeypatch.setattr(stage, "run", interrupted)
    more = ("--set", "train.steps=3", "--device", "cpu")
    code, _, err = aegis(*TRAIN, *more)
    assert code == 130 and err.endswith("resume with: aegis train runs --device cpu\n")
    monkeypatch.setattr(stage, "run", begun)
    code, _, err = aegis("train", "runs", "--device", "cpu")
    assert code == 0 and steps_of(place / "runs") == 3, err


@pytest.mark.parametrize(
    ("method", "more", "named"),
    [
        ("naive", (), "train.accumulate=2"),
        ("naive", ("--set", "train.accumulate=2"), "train.accumulate=4"),
        ("naive", ("--set", "train.accumulate=4"), None),  # a frame per pass
        ("aegis", (), None),
    ],
)
def test_want_of_memory_names_the_command_that_goes_on_with_less(
    method: str,
    more: tuple[str, ...],
    named: str | None,
    place: Path,
    aegis: Aegis,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage, begun = stages.TRAIN[recipes.Recipe].module, train.run

    def too_large(*args: object, on_event: object, **options: object) -> None:
        begun(*args, **options, on_event=stop_at(2, MemoryError()))

    monkeypatch.setattr(stage, "run", too_large)
    code, _, err = aegis(*training(method=method), *more)
    assert code == 2 and "out of memory" in err
    if named is None:
        assert "resume" not in err and "train.batch_size" in err
        return
    words = ["train", "runs", "--set", named]
    assert f"resume in less memory: aegis {' '.join(words)}; a smaller train.batch_size" in err
    monkeypatch.setattr(stage, "run", begun)
    code, _, err = aegis(*words)
    assert code == 0 and steps_of(place / "runs") == 4, err
    assert recipes.load(place / "runs" / "recipe.yaml").train.accumulate == int(named[-1])


def test_where_nothing_has_begun_or_another_run_is_there_still_the_same_command_is_named(
    place: Path, aegis: Aegis, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, other = cut(place), "--set train.steps=5"

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stages.TRAIN[recipes.Recipe].module, "run", interrupted)
    assert f"aegis {' '.join(TRAIN)} --resume\n" in aegis(*TRAIN)[2]
    again = training(out="cut")
    err = aegis(*again, *other.split(), "--overwrite")[2]
    assert f"resume with: aegis {' '.join(again)} {other} --resume\n" in err
    same = aegis(*again, "--set", "train.steps=3", "--resume")[2]
    assert "resume with: aegis train cut\n" in same
    shutil.copy(place / "demos.safetensors", place / "copy.safetensors")
    moved = training(out="cut", demos="copy.safetensors")
    assert "--demos copy.safetensors" in aegis(*moved, "--set", "train.steps=3", "--resume")[2]
    files.write_text(run / "recipe.yaml", "name: [")
    assert "--resume\n" in aegis(*again, "--set", "train.steps=3", "--resume")[2]


def test_what_has_moved_is_named_and_taken_from_where_it_lies_now(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    run = cut(place)
    (place / "data").mkdir()
    for name, option in (("demos", "--demos PATH"), ("anchor", "--anchor FILE")):
        (place / f"{name}.safetensors").rename(place / "data" / f"{name}.safetensors")
        says = f"'{place / name}.safetensors' is gone", f"aegis train cut {option}"
        given = () if name == "demos" else ("--demos", "data/demos.safetensors")
        bad("train", "cut", *given, says=says)
    at = "--demos", "data/demos.safetensors", "--anchor", "data/anchor.safetensors"
    code, _, err = aegis("train", "cut", *at)
    assert code == 0 and steps_of(run) == 3, err
    kept = inputs.of(run)
    assert kept == inputs.Inputs((str(place / at[1]),), str(place / at[3]))
    assert aegis("train", "cut")[0] == 0


def test_what_has_moved_together_with_its_run_is_found(place: Path, aegis: Aegis) -> None:
    """For example if a job of `aegis run` is moved, or a project with its data."""
    cut(place)
    moved = place / "moved"
    moved.mkdir()
    for name in ("cut", "demos.safetensors", "anchor.safetensors"):
        (place / name).rename(moved / name)
    code, out, err = aegis("evaluate", "moved/cut", "--frames", 8, "--json")
    assert code == 0, err
    assert json.loads(out)["data"] == str(moved / "demos.safetensors")
    assert json.loads(out)["split"] == "validation"
    code, _, err = aegis("train", "moved/cut")
    assert code == 0 and steps_of(moved / "cut") == 3, err
    where = inputs.Inputs((str(moved / "demos.safetensors"),), str(moved / "anchor.safetensors"))
    assert inputs.of(moved / "cut") == where


def test_what_has_not_moved_with_its_run_is_asked_for(place: Path, bad: Bad) -> None:
    (place / "moved").mkdir()
    cut(place).rename(place / "moved" / "cut")
    (place / "demos.safetensors").rename(place / "other.safetensors")
    bad("evaluate", "moved/cut", says=(f"'{place / 'demos.safetensors'}' is gone",))


def test_of_several_sets_the_one_that_has_moved_is_asked_for_beside_the_others(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    code, _, err = aegis("demos", "reach", "--episodes", 8, "--seed", 5, "--out", "new.safetensors")
    assert code == 0, err
    run = cut(place, "naive", sets=("demos.safetensors", "new.safetensors"))
    (place / "new.safetensors").rename(place / "moved.safetensors")
    demos, moved = place / "demos.safetensors", place / "moved.safetensors"
    says = "new.safetensors' is gone", f"aegis train cut --demos {demos} --demos PATH"
    bad("train", "cut", says=says)
    says = "1 of --demos for the run in 'cut', which began with 2", "name all of them"
    bad("train", "cut", "--demos", moved, says=says)
    says = "the sets of demonstrations in a different order than the run in 'cut'"
    bad("train", "cut", "--demos", moved, "--demos", demos, says=(says,))
    code, _, err = aegis("train", "cut", "--demos", demos, "--demos", moved)
    assert code == 0 and steps_of(run) == 3, err
    told = results.recipe_of(run).demos.path
    assert told == (str(demos), str(moved)) and aegis("train", "cut")[0] == 0


def test_another_one_of_several_sets_is_refused_by_its_place(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    for seed, name in ((5, "new"), (6, "other")):
        made = "demos", "reach", "--episodes", 8, "--seed", seed, "--out", f"{name}.safetensors"
        assert aegis(*made)[0] == 0
    cut(place, "naive", sets=("demos.safetensors", "new.safetensors"))
    given = "--demos", "demos.safetensors", "--demos", "other.safetensors"
    bad("train", "cut", *given, says=("a different set 2 of the demonstrations than the run",))


def test_a_run_goes_on_with_its_backbone_at_another_place(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    run = cut(place, "naive")
    make_tiny(seed=1).save(place / "other")
    says = "a different backbone than the run in 'cut' began with"
    bad("train", "cut", "--set", "backbone=other", says=(says, "'other' instead of '", "train cut"))
    moved = "--set", "backbone=model.safetensors"
    code, _, err = aegis("train", "cut", *moved)
    assert code == 0 and steps_of(run) == 3, err
    assert results.recipe_of(run).backbone == "model.safetensors"
    (place / "model.safetensors").rename(place / "elsewhere.safetensors")
    moved = "--set", "backbone=elsewhere.safetensors", "--set", "train.steps=4"
    code, _, err = aegis("train", "cut", *moved)
    kept = results.recipe_of(run)
    assert code == 0 and kept.train.extended_from == (3,), err
    assert kept.backbone == "elsewhere.safetensors" and aegis("train", "cut")[0] == 0


def test_a_run_that_has_ended_says_that_nothing_is_to_be_done(place: Path, aegis: Aegis) -> None:
    cut(place, "naive")
    assert "up to date" not in aegis("train", "cut")[2]
    code, _, err = aegis("train", "cut")
    assert code == 0 and "train (up to date): 1/1 stage" in err


def test_a_command_that_a_message_names_is_one_for_a_shell(place: Path, bad: Bad) -> None:
    cut(place).rename(place / "my run")
    again = training(out="my run")
    bad(*again, says=("continue it: aegis train 'my run', or",))
    given = f"--demos {place}/demos.safetensors --anchor {place}/anchor.safetensors"
    anew = f"aegis train 'my run/recipe.yaml' {given} --out new"
    bad("train", "my run", "--out", "new", says=(anew,))
    says = "go on with its own: aegis train 'my run'; compare"
    learned = "--set 'backbone=my run' --set 'expert.start=my run'"
    bad("train", "my run", "--set", "seed=7", says=(says, learned))


def test_other_demonstrations_are_refused(place: Path, bad: Bad, aegis: Aegis) -> None:
    run = cut(place)
    code, _, err = aegis("demos", "reach", "--episodes", 8, "--seed", 5, "--out", "new.safetensors")
    assert code == 0, err
    names = f"'{place}/new.safetensors' instead of '{place}/demos.safetensors'"
    says = "a different demos than the run", names, f"go on with its own: aegis train {run}"
    bad("train", run, "--demos", "new.safetensors", says=says)


def test_a_run_of_an_earlier_version_asks_for_what_it_does_not_know(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    run = cut(place)
    (run / inputs.NAME).unlink()
    bad("train", "cut", says=("does not record its demonstrations", "aegis train cut --demos PATH"))
    at = "--demos", "demos.safetensors"
    bad("train", "cut", *at, says=("does not record its anchor", "aegis train cut --anchor FILE"))
    code, _, err = aegis("train", "cut", *at, "--anchor", "anchor.safetensors")
    assert code == 0 and steps_of(run) == 3 and inputs.of(run) is not None, err


def test_of_an_earlier_version_the_recipe_may_name_the_demonstrations(
    place: Path, aegis: Aegis
) -> None:
    run = cut(place, "naive")
    (run / inputs.NAME).unlink()
    kept = (run / "recipe.yaml").read_text()
    resolved = recipes.load(run / "recipe.yaml", ["demos.path=demos.safetensors"])
    files.write_text(run / "recipe.yaml", recipes.to_yaml(resolved))
    assert (run / "recipe.yaml").read_text() != kept
    code, _, err = aegis("train", "cut")
    assert code == 0 and steps_of(run) == 3, err


def test_a_run_that_has_ended_is_made_longer_twice(place: Path, aegis: Aegis) -> None:
    assert aegis(*training(out="run"), "--set", "train.steps=2")[0] == 0
    for steps in (3, 4):
        code, _, err = aegis("train", "run", "--set", f"train.steps={steps}")
        assert code == 0 and steps_of(place / "run") == steps, err
    kept = results.recipe_of(place / "run").train
    assert (kept.steps, kept.extended_from) == (4, (2, 3))


def test_a_run_that_was_made_longer_does_not_become_shorter(
    place: Path, aegis: Aegis, bad: Bad
) -> None:
    assert aegis(*training(out="run"), "--set", "train.steps=2")[0] == 0
    assert aegis("train", "run", "--set", "train.steps=3")[0] == 0
    bad("train", "run", "--set", "train.steps=1", says=("raise train.steps, which cannot fall",))


def test_other_settings_are_refused(place: Path, bad: Bad) -> None:
    cut(place)
    says = "train.batch_size", "go on with its own: aegis train cut"
    bad("train", "cut", "--set", "train.batch_size=7", says=says)
    bad("train", "cut", "--method", "naive", says=("train.method",))


def test_overwrite_begins_it_anew(place: Path, aegis: Aegis) -> None:
    run = cut(place)
    assert aegis("train", "cut")[0] == 0
    (run / "results").mkdir()
    (run / "results" / "rollout-seen.json").write_text("{}")
    code, _, err = aegis("train", "cut", "--overwrite")
    assert code == 0 and steps_of(run) == 3 and not (run / "results").exists(), err


def test_a_dry_run_of_the_rest_writes_nothing(place: Path, aegis: Aegis) -> None:
    run = cut(place)
    before = sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))
    code, out, err = aegis("train", "cut", "--dry-run", "--json")
    assert code == 0 and json.loads(out)["steps"] == 3, err
    assert sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*")) == before


# --- refused --------------------------------------------------------------------------------------


def test_a_recipe_needs_a_folder_and_a_run_has_its_own(place: Path, bad: Bad, aegis: Aegis) -> None:
    cut(place)
    says = "no --out", "aegis train small.yaml --out runs/NAME"
    bad("train", "small.yaml", "--demos", "demos.safetensors", says=says)
    given = f"--demos {place}/demos.safetensors --anchor {place}/anchor.safetensors"
    anew = f"aegis train cut/recipe.yaml {given} --out new"
    bad("train", "cut", "--out", "new", says=("--out new with the run 'cut'", anew))
    code, _, err = aegis(*shlex.split(anew)[1:], "--dry-run")
    assert code == 0, err


def test_a_run_that_is_not_there_is_missed_before_its_out(place: Path, bad: Bad) -> None:
    bad("train", "runs/mistyped", says=("no file runs/mistyped",))


def test_demonstrations_are_asked_for_of_a_policy_alone(place: Path, bad: Bad) -> None:
    """A user who mistypes a run has to look for the run, not for its demonstrations."""
    bad("evaluate", "./mistyped", says=("no checkpoint in 'mistyped'",))
    (place / "stream").mkdir()
    (place / "stream" / "recipe.yaml").write_text("kind: stream\nname: s\nstream: primer-1\n")
    bad("evaluate", "stream", says=("the run of a stream",))


def test_a_folder_that_is_no_run_says_what_may_be_meant(place: Path, bad: Bad) -> None:
    run = cut(place)
    last = checkpoint.last(run).resolve()
    bad("train", last, says=("no recipe.yaml in", f"aegis train {run}"))
    (place / "job").mkdir()
    shutil.copytree(run, place / "job" / "aegis", symlinks=True)
    bad("train", "job", says=("no recipe.yaml in 'job'", "aegis train job/aegis"))
    (place / "empty").mkdir()
    bad("train", "empty", says=("no recipe.yaml in 'empty'", "aegis train RECIPE --out RUN"))


def test_evaluate_takes_the_demonstrations_that_the_run_learned_from(
    place: Path, aegis: Aegis, bad: Bad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = cut(place, "naive")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    code, out, err = aegis("evaluate", run, "--frames", 8, "--json")
    found = json.loads(out)
    assert code == 0 and found["data"] == str(place / "demos.safetensors"), err
    assert found["split"] == "validation"
    (place / "demos.safetensors").rename(place / "moved.safetensors")
    bad("evaluate", run, says=("demos.safetensors' is gone", f"aegis evaluate {run} --demos PATH"))
    (run / inputs.NAME).unlink()
    bad("evaluate", run, says=("no --demos for", f"aegis evaluate {run} --demos PATH"))


def test_evaluate_asks_which_of_several_sets(place: Path, aegis: Aegis, bad: Bad) -> None:
    code, _, err = aegis("demos", "reach", "--episodes", 8, "--seed", 5, "--out", "new.safetensors")
    assert code == 0, err
    run = cut(place, "naive", sets=("demos.safetensors", "new.safetensors"))
    bad("evaluate", run, says=("which learned from 2 sets", f"{place / 'new.safetensors'}"))


def test_merge_finds_the_demonstrations_where_the_run_learned_from_them(
    place: Path, aegis: Aegis
) -> None:
    run = cut(place, "naive")
    (place / "apart").mkdir()
    run = run.rename(place / "apart" / "run")
    asked = "--samples", 8, "--frames", 8, "--vqa", "scenes"
    code, _, err = aegis("merge", run, "--strength", 1, *asked, "--out", "merged")
    assert code == 0 and (place / "merged" / "checkpoints").is_dir(), err


def test_a_merged_run_is_evaluated_on_what_its_training_learned_from(
    place: Path, aegis: Aegis
) -> None:
    linear = "--method", "linear", "--strength", 0.5
    code, _, err = aegis("merge", cut(place, "naive"), *linear, "--out", "merged")
    assert code == 0, err
    code, out, err = aegis("evaluate", "merged", "--frames", 8, "--json")
    assert code == 0 and json.loads(out)["data"] == str(place / "demos.safetensors"), err
    assert json.loads(out)["split"] == "validation"


def test_a_merged_run_is_refused_with_the_commands_that_go_on(
    place: Path, aegis: Aegis, bad: Bad, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are as they have to be typed, also after both runs were moved."""
    run = cut(place, "naive")
    linear = "--method", "linear", "--strength", 0.5
    assert aegis("merge", run, *linear, "--out", "merged")[0] == 0
    moved = place.rename(tmp_path / "moved")
    monkeypatch.chdir(moved)
    origin = moved / "cut"
    said = bad("train", "merged", says=(f"which aegis merge made from '{origin}'",))
    own, anew = re.findall(r"aegis (train [/m].+?)(?:; |$)", " ".join(said.split()))
    assert own == f"train {origin}"
    learned = "--set backbone=merged --set expert.start=merged --out RUN"
    assert anew == f"train merged/recipe.yaml --demos {moved}/demos.safetensors {learned}"
    for words in (own, anew):
        code, _, err = aegis(*shlex.split(words))
        assert code == 0, err
    assert steps_of(moved / "RUN") == 3
    # Where the run is gone, or an earlier version has not named it, the advice is without it.
    shutil.rmtree(origin)
    bad("train", "merged", says=("continue the run that was merged; or begin another",))
    (moved / "merged" / inputs.NAME).unlink()
    bad("train", "merged", "--demos", "demos.safetensors", says=(learned,))


@pytest.mark.parametrize("what", ["backbone", "policy"])
def test_a_model_instead_of_a_recipe_is_named_in_one(
    what: str, place: Path, aegis: Aegis, bad: Bad
) -> None:
    run = cut(place, "naive")
    assert aegis("export", run, "--format", "aegis", "--out", "policy")[0] == 0
    given = "policy" if what == "policy" else "policy/backbone"
    said = bad("train", given, "--out", "new", says=(f"--set backbone={given}",))
    assert ("expert.start" in said) == (what == "policy")
    command = re.findall(r"aegis (train RECIPE .+?)$", " ".join(said.split()))[0]
    named = command.replace("RECIPE", "small.yaml").replace("PATH", "demos.safetensors")
    code, _, err = aegis(*shlex.split(named), "--method", "naive")
    assert code == 0 and (place / "RUN" / "checkpoints").is_dir(), err


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"demos": [3], "anchor": null}', '{"demos": ["x"]']
)
def test_damaged_places_are_one_error(text: str, place: Path, bad: Bad) -> None:
    (cut(place) / inputs.NAME).write_text(text)
    bad("train", "cut", says=(inputs.NAME,))
