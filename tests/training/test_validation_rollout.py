"""Episodes played during training: they show success, and training is unchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from samples import lerobot
from samples.graphs import compiled_graphs
from samples.training_runs import (
    SETTINGS,
    STEPS,
    TIMES,
    Start,
    Told,
    assert_resumes,
    metrics,
    stop_at,
    told,
)

from aegis_cli import recipes
from aegis_cli.common import files, gl
from aegis_cli.common.errors import AegisError, Diverged
from aegis_cli.common.events import Event, Progress
from aegis_cli.common.ranks import Ranks
from aegis_cli.data.vqa.metrics import wilson_interval
from aegis_cli.evaluation import kept_figures, rollout
from aegis_cli.inspection import folders
from aegis_cli.models import acting
from aegis_cli.models.acting import RolloutReport
from aegis_cli.recipes import Kfac, Nullspace, Recipe, Rollout
from aegis_cli.reporting import gather
from aegis_cli.sim.contract import DEMOS, EVALUATION, VALIDATION
from aegis_cli.training import checkpoint, dry_run, train, validation_rollout

COUNT, SEED = 2, 5
FIGURES = {"rollout_success", "rollout_low", "rollout_high"}
Reports = list[RolloutReport]


@pytest.fixture(scope="module")
def playing(recipe: Recipe) -> Recipe:
    """Constraints of `nullspace` and `kfac` cover four steps, and a validation falls within them.

    Whole chunks are executed, so an episode takes few predictions.
    """
    return replace(
        recipe,
        rollout=Rollout(replan=SETTINGS.chunk, while_training=COUNT, seed=SEED),
        nullspace=Nullspace(every=4),
        kfac=Kfac(every=4),
    )


def without(recipe: Recipe) -> Recipe:
    return replace(recipe, rollout=replace(recipe.rollout, while_training=None))


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Reports:
    """The whole report of each rollout during training, validation by validation."""
    found: Reports = []
    play = validation_rollout.play

    def noted(*given: Any, **named: Any) -> RolloutReport:
        found.append(play(*given, **named))
        return found[-1]

    monkeypatch.setattr(validation_rollout, "play", noted)
    return found


def again(run: Path, stream: int = VALIDATION) -> RolloutReport:
    """The same episodes played with a run's last checkpoint, or with a checkpoint."""
    return rollout.run(run, None, COUNT, "seen", stream=stream, seed=SEED)


def assert_same_episodes(one: RolloutReport, other: RolloutReport, rel: float = 1e-4) -> None:
    """Each episode's final distance to its target and its motion tell two policies apart."""
    assert one.outcomes == other.outcomes and one.interval == other.interval
    assert one.final_distance_m == pytest.approx(other.final_distance_m, rel=rel)
    assert one.action_change == pytest.approx(other.action_change, rel=rel)


@pytest.fixture(scope="module")
def played_run(playing: Recipe, start: Start, tmp_path_factory: pytest.TempPathFactory) -> Told:
    """A run of `naive` that plays."""
    return told(start, "naive", playing, tmp_path_factory.mktemp("played") / "run")


@pytest.mark.parametrize("method", ["naive", "kfac", "lora"])
def test_training_does_not_notice_the_episodes(
    method: str,
    playing: Recipe,
    played_run: Told,
    start: Start,
    tmp_path: Path,
) -> None:
    with_episodes, plain = tmp_path / "played", tmp_path / "plain"
    if method == "naive":
        with_episodes = played_run.out
    else:
        start(method, with_episodes, recipe=playing)
    start(method, plain, recipe=without(playing))
    assert metrics(with_episodes, TIMES | FIGURES) == metrics(plain, TIMES)
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        one, other = (checkpoint.last(run) / name for run in (with_episodes, plain))
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("changes", [{}, {"ema_decay": 0.6}], ids=str)
@pytest.mark.parametrize("method", ["naive", "lora"])
def test_the_figures_are_those_of_the_checkpoint(
    method: str,
    changes: dict[str, Any],
    playing: Recipe,
    start: Start,
    played: Reports,
    tmp_path: Path,
) -> None:
    settings = replace(SETTINGS, checkpoint_every=3, **changes)
    report = start(method, tmp_path / "run", recipe=replace(playing, train=settings))
    early, late = played
    assert_same_episodes(early, again(tmp_path / "run" / "checkpoints" / "000003"))
    assert_same_episodes(late, again(tmp_path / "run"))
    assert early.action_change != pytest.approx(late.action_change, rel=1e-3)
    last = metrics(tmp_path / "run")[-1]
    low, high = wilson_interval(late.success * COUNT, COUNT)
    assert {name: last[name] for name in FIGURES} == {
        "rollout_success": late.success,
        "rollout_low": low,
        "rollout_high": high,
    }
    assert report.validation_rollout == {"success": late.success, "interval": [low, high]}


def test_no_evaluation_plays_these_episodes_and_tuning_does(
    playing: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[int, int, int]] = []
    draw = acting.episode_rng

    def noted(*place: int) -> Any:
        drawn.append(place)
        return draw(*place)

    monkeypatch.setattr(acting, "episode_rng", noted)
    start("naive", tmp_path / "run", recipe=playing)
    mine = set(drawn)
    assert mine == {(SEED, VALIDATION, number) for number in range(COUNT)}
    drawn.clear()
    again(tmp_path / "run", EVALUATION)
    # A seed's streams share no episode, whatever the seed of demonstrations and evaluations.
    assert len(drawn) == COUNT and not mine & set(drawn)
    assert {stream for _, stream, _ in mine} & {DEMOS, EVALUATION} == set()
    first = {stream: draw(SEED, stream, 0).random() for stream in (DEMOS, EVALUATION, VALIDATION)}
    assert len(set(first.values())) == 3


def test_they_are_played_with_every_validation_loss_and_no_other_time(
    playing: Recipe, start: Start, played: Reports, tmp_path: Path
) -> None:
    events: list[Event] = []
    start("naive", tmp_path / "run", recipe=playing, on_event=events.append)
    lines = metrics(tmp_path / "run")
    for line in lines:
        assert ("validation_loss" in line) == FIGURES.issubset(line)
    assert len(played) == STEPS // SETTINGS.validate_every
    shown = [e for e in events if isinstance(e, Progress) and e.stage == "rollout"]
    # Those of the first time; it was short, so later ones would only add two lines each to a log.
    assert [e.done for e in shown] == sorted(e.done for e in shown) and shown[-1].done > 0
    assert shown[-1].done == shown[-1].total
    told = [e.metrics for e in events if isinstance(e, Progress) and e.stage == "train"][-1]
    names = {"success": "success", "at least": "low", "at most": "high"}
    for label, name in names.items():
        assert told[label] == lines[-1][f"rollout_{name}"]


def test_episodes_that_took_long_are_shown_again(
    playing: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "_LONG_S", 0.0)
    events: list[Event] = []
    start("naive", tmp_path / "run", recipe=playing, on_event=events.append)
    ends = [e for e in events if isinstance(e, Progress) and e.stage == "rollout"]
    assert [e.done == e.total for e in ends].count(True) == STEPS // SETTINGS.validate_every


def test_a_run_goes_on_with_the_same_episodes(
    playing: Recipe, played_run: Told, start: Start, tmp_path: Path
) -> None:
    assert_resumes(start, "naive", playing, tmp_path, played_run.out)
    events: list[Event] = []
    report = start("naive", tmp_path / "cut", recipe=playing, resume=True, on_event=events.append)
    # A finished run reports its figures and plays nothing.
    assert not [e for e in events if "rollout" in getattr(e, "stage", "")]
    last = metrics(played_run.out)[-1]
    assert report.validation_rollout["success"] == last["rollout_success"]


def test_a_run_may_begin_or_cease_to_play_when_it_goes_on(
    playing: Recipe, played_run: Told, start: Start, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(4, KeyboardInterrupt())
        start("naive", tmp_path / "run", recipe=without(playing), on_event=stop)
    start("naive", tmp_path / "run", recipe=playing, resume=True)
    one, other = (metrics(out, TIMES)[-1] for out in (tmp_path / "run", played_run.out))
    assert one == other
    assert recipes.load(tmp_path / "run" / "recipe.yaml", kind=Recipe).rollout.while_training


def test_inspect_and_the_page_tell_them(played_run: Told, tmp_path: Path) -> None:
    run, report = played_run.out, played_run.report
    found = folders.inspect(run)
    assert found.facts["validation_rollout"] == report.validation_rollout
    early = folders.inspect(run / "checkpoints" / "000004")
    line = metrics(run)[SETTINGS.validate_every - 1]
    assert early.facts["validation_rollout"] == {
        "success": line["rollout_success"],
        "interval": [line["rollout_low"], line["rollout_high"]],
    }
    # `aegis run` keeps the report, and reads it later for its page.
    files.save_json(tmp_path / "train.json", report.to_json())
    kept = kept_figures.read(tmp_path / "train.json", kept_figures.TrainFigures)
    assert kept["validation_rollout"] == report.validation_rollout
    drawn = gather.run_document(run).metrics
    assert [at["step"] for at in drawn if "rollout_success" in at] == [3, STEPS]


@pytest.mark.fast
@pytest.mark.parametrize("interval", [(70.0, 90.0), None])
def test_a_task_without_success_has_its_return(interval: tuple[float, float] | None) -> None:
    report = RolloutReport(
        task="suite/cartpole-swingup",
        mean_return=80.0,
        return_interval=interval,
        episodes=2,
        episodes_per_s=1.0,
    )
    line = validation_rollout._line(report)
    ends = {} if interval is None else {"rollout_low": 70.0, "rollout_high": 90.0}
    assert line == {"rollout_mean_return": 80.0} | ends
    wanted = None if interval is None else list(interval)
    assert validation_rollout.of_line(line) == {"mean_return": 80.0, "return_interval": wanted}
    assert validation_rollout.of_line({"step": 3, "loss": 1.0}) == {}


@pytest.mark.parametrize(
    "changes",
    [
        {"weights": "bf16-master"},
        {"weights": "bf16-master", "freeze": "vision"},
        {"gradient_checkpointing": True},
        {"weights": "bf16"},
    ],
    ids=str,
)
def test_models_of_the_hub_act_too(
    changes: dict[str, Any],
    playing: Recipe,
    start: Start,
    played: Reports,
    hf_folder: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    settings = replace(SETTINGS, steps=2, validate_every=2, **changes)
    own = replace(playing, backbone=str(hf_folder("smolvlm")), train=settings)
    start("naive", tmp_path / "run", recipe=own, anchor=None)
    start("naive", tmp_path / "plain", recipe=without(own), anchor=None)
    for name in ("backbone/model.safetensors", "expert.safetensors"):
        one, other = (checkpoint.last(tmp_path / run) / name for run in ("run", "plain"))
        assert one.read_bytes() == other.read_bytes()
    # A checkpoint is read in float32, whatever dtype it is stored in.
    rel = 1e-2 if changes.get("weights") == "bf16" else 1e-4
    assert_same_episodes(played[0], again(tmp_path / "run"), rel)


# While tracing a graph, torch.compile accesses a field for which PyTorch warns.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_nothing_is_compiled_for_episodes(
    playing: Recipe,
    start: Start,
    played: Reports,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor for later steps or validations: everything is compiled before the first of these."""
    graphs, before = compiled_graphs(monkeypatch), []
    figures = validation_rollout.ValidationEpisodes.figures

    def noted(*given: Any) -> dict[str, float]:
        before.append(len(graphs))
        return figures(*given)

    monkeypatch.setattr(validation_rollout.ValidationEpisodes, "figures", noted)
    compiling = replace(playing, train=replace(SETTINGS, steps=2, validate_every=1, compile=True))
    torch._dynamo.reset()  # an earlier test's graphs would also be used
    start("naive", tmp_path / "run", recipe=compiling)
    assert before == [len(graphs)] * 2 and graphs
    assert_same_episodes(played[-1], again(tmp_path / "run"))


def test_one_process_acts_and_the_others_are_told(
    playing: Recipe, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(_: Ranks, box: list[Any]) -> Any:
        assert box == [None]
        return RolloutReport(
            task="reach", success=0.5, interval=(0.1, 0.9), episodes=COUNT, episodes_per_s=1.0
        )

    monkeypatch.setattr(Ranks, "_told", told)
    monkeypatch.setattr(validation_rollout, "play", lambda *_, **__: pytest.fail("acted"))
    monkeypatch.setattr(gl, "check", lambda: pytest.fail("opened"))
    meta: Any = {"task": "reach", "replan": 2}
    nobody: Any = None
    second = validation_rollout.chosen(playing, nobody, meta, Ranks(1, 2))
    assert second is not None
    found = second.figures(Ranks(1, 2), lambda _: None)
    assert found == {"rollout_success": 0.5, "rollout_low": 0.1, "rollout_high": 0.9}


def test_a_dry_run_tells_how_long_they_take(
    playing: Recipe, demos_file: Path, tmp_path: Path, played: Reports
) -> None:
    plan = dry_run.run(playing, "naive", demos_file, None, tmp_path / "run")
    assert not played and not (tmp_path / "run").exists()
    assert plan.validation_s["episodes"] > 0
    plain = dry_run.run(without(playing), "naive", demos_file, None, tmp_path / "run")
    assert plain.validation_s.keys() == plan.validation_s.keys() - {"episodes"}


def test_memory_that_does_not_suffice_to_act_is_told(
    playing: Recipe, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(validation_rollout, "longest_s", full)
    plan = dry_run.run(playing, "naive", demos_file, None, tmp_path / "run")
    assert plan.memory_fits is False and plan.memory_measured_mb is None
    assert plan.step_s is not None and plan.step_s > 0  # the steps before it fit
    assert (plan.validation_s, plan.hours) == (None, None)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.usefixtures("frame_cache")
def test_a_robot_that_is_not_simulated_is_refused_before_the_first_step(
    playing: Recipe, start: Start, tmp_path: Path
) -> None:
    demos = tmp_path / "arm"
    lerobot.save(demos, lerobot.episodes(4, texts=("move the finger to the red target",)))
    said = "rollout.while_training: 2 with demonstrations of no simulated task"
    with pytest.raises(AegisError, match=said) as refused:
        start("naive", tmp_path / "run", recipe=playing, demos=demos)
    assert "--set train.validate_actions=500" in refused.value.fix
    assert not (tmp_path / "run" / "recipe.yaml").exists()
    with pytest.raises(AegisError, match=said):
        dry_run.run(playing, "naive", demos, None, tmp_path / "run")


def test_without_opengl_no_step_is_taken(
    playing: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise AegisError("neither libEGL nor libOSMesa", "one of them", "install it")

    monkeypatch.setattr(gl, "check", missing)
    with pytest.raises(AegisError, match="libEGL"):
        start("naive", tmp_path / "run", recipe=playing)
    assert not (tmp_path / "run" / "recipe.yaml").exists()
    start("naive", tmp_path / "plain", recipe=without(playing))


@pytest.mark.fast
@pytest.mark.parametrize(
    ("recipe_file", "count", "expected"),
    [
        ("quickstart", 10**8, "10,000,000"),
        ("quickstart", 0, "from 1"),
        ("igsp-robot", 7, "delete 'rollout.while_training'"),
    ],
)
def test_numbers_that_cannot_be_played_are_refused(
    recipe_file: str, count: int, expected: str
) -> None:
    with pytest.raises(AegisError) as refused:
        recipes.load_training(f"recipes/{recipe_file}.yaml", [f"rollout.while_training={count}"])
    assert "rollout.while_training" in refused.value.found and expected in str(refused.value)


def test_a_figure_that_is_not_finite_ends_the_run(
    playing: Recipe, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = validation_rollout.ValidationEpisodes.figures

    def broken(*given: Any) -> dict[str, float]:
        return figures(*given) | {"rollout_success": float("nan")}

    monkeypatch.setattr(validation_rollout.ValidationEpisodes, "figures", broken)
    with pytest.raises(Diverged, match="rollout_success"):
        start("naive", tmp_path / "run", recipe=playing)
    assert all("rollout_success" not in line for line in metrics(tmp_path / "run"))


@pytest.mark.fast
def test_no_record_of_earlier_work_knows_the_key(playing: Recipe) -> None:
    assert recipes.training_part(playing) == recipes.training_part(without(playing))
    assert "while_training" not in recipes.recorded(without(playing).rollout)
    assert asdict(playing)["rollout"]["while_training"] == COUNT
