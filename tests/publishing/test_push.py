"""A pushed policy is the run's, with a card of its measurements, or nothing is sent."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest
import torch
import yaml
from samples.command import refused
from samples.hub import Hub
from samples.reports import open_loop
from samples.reports import rollout as rollout_figures
from samples.small_run import recipe as small

from aegis_cli import inspection, recipes, sim
from aegis_cli.common import files
from aegis_cli.evaluation import probe, results, rollout
from aegis_cli.evaluation.results import Played, PlayedResult, Result
from aegis_cli.models import lerobot_folder
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.publishing import card, export, push
from aegis_cli.recipes import Probe, Recipe
from aegis_cli.training import checkpoint, train
from aegis_cli.training.card import without_places

Aegis = Callable[..., tuple[int, str, str]]
REPO = "somebody/reach-naive"
# Files that other backbones' processors have, and some that only a user can have added.
PROCESSOR = {
    "backbone/tokenizer.model",
    "backbone/vocab.txt",
    "backbone/video_preprocessor_config.json",
    "backbone/additional_chat_templates/brief.jinja",
}
MINE = (
    "notes.txt",
    "backbone/notes.txt",
    "backbone/notes/config.json",
    "backbone/additional_chat_templates/notes.txt",
    "old/backbone/config.json",
)


@pytest.fixture(scope="module")
def run_folder(run_folder: Path, tiny_folder: Path) -> Path:
    """A run that was probed against its backbone with a gate, and rolled out."""
    probe.run(str(run_folder), "scenes", 14, str(tiny_folder), None, 100.0, keep=True)
    rollout.run(run_folder, None, 2, "seen", None, keep=True)
    return run_folder


def download(hub: Hub, folder: Path) -> Path:
    """The files that a user gets by downloading the repository."""
    for name, content in hub.committed.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


@pytest.mark.parametrize("form", [card.AEGIS, card.LEROBOT])
def test_what_is_downloaded_is_the_runs_policy(
    form: str, run_folder: Path, hub: Hub, tmp_path: Path
) -> None:
    report = push.run(run_folder, REPO, form)
    assert report.url is not None and report.url.startswith(hub.url)
    assert set(report.files) == set(hub.committed)
    own = checkpoint.load_policy(run_folder)
    found = checkpoint.load_policy(download(hub, tmp_path / "x"))
    assert {n: own[1][n] for n in ("task", "replan")} == {
        n: found[1][n] for n in ("task", "replan")
    }
    tensors = found[0].state_dict()
    for name, tensor in own[0].state_dict().items():
        assert torch.equal(tensor, tensors[name]), name


FORMS = (card.AEGIS, card.LEROBOT)


@pytest.mark.parametrize(("first", "second"), [FORMS, FORMS[::-1], (card.AEGIS,) * 2])
def test_a_push_in_another_layout_takes_the_place_of_the_one_before(
    first: str, second: str, run_folder: Path, hub: Hub, tmp_path: Path, own_cache: None
) -> None:
    push.run(run_folder, REPO, first)
    hub.committed["notes.txt"] = hub.committed["backbone/notes.txt"] = b"mine"
    before = set(hub.committed)
    report = push.run(run_folder, REPO, second)
    assert set(hub.committed) == {*report.files, "notes.txt", "backbone/notes.txt"}
    assert set(report.removed) == before - set(hub.committed)
    assert lerobot_folder.is_policy(download(hub, tmp_path / "x")) == (second == card.LEROBOT)
    checkpoint.load_policy(tmp_path / "x")


@pytest.fixture(scope="module")
def smolvlm_run(
    hf_folder: Callable[[str], Path], demos_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run whose backbone has files that the embedded one does not have."""
    out = tmp_path_factory.mktemp("runs") / "smolvlm"
    train.run(small(hf_folder("smolvlm"), steps=1), "naive", demos_file, None, out)
    return out


@pytest.mark.parametrize("form", FORMS)
def test_a_push_with_another_backbone_leaves_no_file_of_the_one_before(
    form: str, run_folder: Path, smolvlm_run: Path, hub: Hub, tmp_path: Path, own_cache: None
) -> None:
    push.run(smolvlm_run, REPO, form)
    hub.committed |= dict.fromkeys(PROCESSOR, b"of an earlier backbone")
    hub.committed |= dict.fromkeys(MINE, b"mine")
    before = set(hub.committed)
    report = push.run(run_folder, REPO, form)
    assert set(hub.committed) == {*report.files, *MINE}
    assert set(report.removed) == before - set(hub.committed) > PROCESSOR
    own = checkpoint.load_policy(run_folder)[0]
    found = checkpoint.load_policy(download(hub, tmp_path / "x"))[0]
    assert found.backbone.fingerprint() == own.backbone.fingerprint()
    push.run(smolvlm_run, REPO, form)
    loaded = checkpoint.load_policy(download(hub, tmp_path / "y"))[0]
    assert type(loaded.backbone).__name__ == "HFBackbone" and set(MINE) <= set(hub.committed)


def test_a_backbone_that_no_policy_of_ours_was_pushed_with_stays(
    run_folder: Path, hub: Hub, own_cache: None
) -> None:
    hub.committed |= dict.fromkeys(PROCESSOR, b"theirs")
    assert push.run(run_folder, REPO).removed == ()


@pytest.mark.parametrize("config", [b'{"type": "smolvla"}', b'{"model_type": "smolvlm"}', b"no"])
def test_the_files_of_another_program_stay(
    config: bytes, run_folder: Path, hub: Hub, own_cache: None
) -> None:
    hub.committed |= {"config.json": config, "model.safetensors": b"theirs"}
    assert push.run(run_folder, REPO).removed == ()
    assert hub.committed["config.json"] == config and "model.safetensors" in hub.committed


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub-cache"))


def test_a_checkpoints_files_are_those_of_its_user_and_the_recipe(
    run_folder: Path, hub: Hub, tmp_path: Path
) -> None:
    push.run(run_folder, REPO)
    assert not any("training_state" in name for name in hub.committed)
    saved = download(hub, tmp_path) / export.RECIPE
    learned, told = recipes.load(run_folder / "recipe.yaml"), recipes.load(saved)
    assert told == dataclasses.replace(learned, backbone=Path(learned.backbone).name)


def test_the_recipe_tells_nobody_where_models_and_data_lie(
    run_folder: Path, hub: Hub, tmp_path: Path
) -> None:
    learned = recipes.load(
        run_folder / "recipe.yaml",
        [
            *("demos.path=[/home/ann/arm, org/arm]", "anchor.vqa=/home/ann/asked.jsonl"),
            *("probe.vqa=[scenes, /home/ann/asked.jsonl]", "probe.ask=/say {}"),
        ],
    )
    own = shutil.copytree(run_folder, tmp_path / "own", symlinks=True)
    files.write_text(own / "recipe.yaml", recipes.to_yaml(learned))
    push.run(own, REPO)
    told = recipes.load(download(hub, tmp_path) / export.RECIPE)
    assert told.demos.path == ("arm", "org/arm") and told.anchor.vqa == "asked.jsonl"
    assert told.probe.vqa == ("scenes", "asked.jsonl") and told.probe.ask == "/say {}"


def test_the_card_has_what_was_measured(run_folder: Path, hub: Hub) -> None:
    push.run(run_folder, REPO)
    text = hub.committed[card.NAME].decode()
    _, front, body = text.split("---\n", 2)
    assert yaml.safe_load(front)["pipeline_tag"] == "robotics"
    figures = files.load_json(run_folder / results.FOLDER / "probe-scenes.json")
    low, high = figures["drop_interval"]
    assert f"{figures['drop_points']:.2f} points ({low:.2f} to {high:.2f})" in body
    assert f"| {100 * figures['baseline_accuracy']:.1f} % |" in body
    assert "Gate (a drop of at most 100 points): **passed**." in body
    success = files.load_json(run_folder / results.FOLDER / "rollout-seen.json")["success"]
    assert f"| reach | seen | 2 | {100 * success:.1f} % (" in body
    assert f"aegis probe {REPO} --baseline" in body and "hf download" not in body
    assert "Options of the method: none." in body
    # The backbone's local path means nothing to others.
    assert "--baseline /" not in body and "model `/" not in body


def test_a_card_tells_nobody_in_what_folders_things_lie() -> None:
    """Neither in the options of a method nor in what was merged."""
    raw = {"method": "cotrain", "vqa": ["/home/me/secret/q.jsonl", "scenes"], "weight": 0.5}
    raw |= {"inner": {"base": "/home/me/secret/vlm", "path": "ORG/NAME", "ask": "/say {}"}}
    told = without_places(raw)
    assert told["vqa"] == ["q.jsonl", "scenes"] and told["weight"] == 0.5
    assert told["inner"] == {"base": "vlm", "path": "ORG/NAME", "ask": "/say {}"}
    merge = {"method": "linear", "base": "/home/me/secret/vlm", "strength": 0.5}
    assert "secret" not in card._merged(merge) and '"base": "vlm"' in card._merged(merge)


def test_a_card_names_the_set_of_each_probe() -> None:
    recipe = Recipe(name="x", probe=Probe(vqa=("scenes", "easy-vqa")))
    figures = {"accuracy": 0.9, "interval": [0.8, 1.0], "questions": 40}
    rows = [
        card._probe_row(results.Result(name, figures, {}), recipe) for name in ("probe", "probe-2")
    ]
    assert [row.split("`")[1] for row in rows] == ["scenes", "easy-vqa"]


def test_a_cards_command_asks_what_its_first_figures_are_of(run_folder: Path) -> None:
    recipe = recipes.load(run_folder / "recipe.yaml")
    asked = {"vqa": "/home/ann/lab.jsonl", "ask": "{} Briefly.", "questions": 50, "seed": 3}
    settings = {**asked, "baseline": "x", "gate": "mean"}
    probed = results.Result("probe-lab", {"skipped": 2}, settings)
    found = card.inspection.InspectReport("run", "x", {}, probes=(probed,))
    known = dataclasses.replace(recipe, probe=card._asked(found, recipe))
    command = card._probe_command(REPO, known)
    assert "--vqa lab.jsonl --ask '{} Briefly.' --skip-bad --questions 50 --seed 3" in command
    by_the_recipe = results.Result("probe", {}, {})
    found = card.inspection.InspectReport("run", "x", {}, probes=(by_the_recipe,))
    assert card._asked(found, recipe) == recipe.probe


@pytest.mark.parametrize("hosted", [True, False])
def test_a_card_names_the_backbone_that_came_from_the_hub_and_no_folder(
    hosted: bool,
    hf_folder: Callable[[str], Path],
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In whatever folder the card is written, and whatever has that name there."""
    name, folder = "someone/SmolVLM", hf_folder("smolvlm")
    training, elsewhere = tmp_path / "training", tmp_path / "elsewhere"
    for place in (training, elsewhere):
        place.mkdir()
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: str(folder))
    monkeypatch.chdir(training)
    if not hosted:
        shutil.copytree(folder, training / name)
    run = tmp_path / "run"
    train.run(small(name, steps=1), "naive", demos_file, None, run)
    (elsewhere / name).mkdir(parents=True)
    for place in (training, elsewhere, tmp_path):
        monkeypatch.chdir(place)
        assert inspection.run(run).facts.get("base_model") == (name if hosted else None)
        for form in FORMS:
            stored = card.Stored("float32", rounded=False)
            said = card.text(run, checkpoint.last(run), form, REPO, stored)
            front = yaml.safe_load(said.split("---\n", 2)[1])
            assert front.get("base_model") == (name if hosted else None)


def test_a_card_names_what_the_run_that_it_goes_on_from_began_with(
    hf_folder: Callable[[str], Path],
    demos_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name, folder = "someone/SmolVLM", hf_folder("smolvlm")
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda *_, **__: str(folder))
    first, exported = tmp_path / "first", tmp_path / "exported"
    train.run(small(name, steps=1), "naive", demos_file, None, first)
    export.run(first, exported)
    for before in (first, exported):
        second = tmp_path / f"after {before.name}"
        train.run(small(before, steps=1), "naive", demos_file, None, second)
        stored = card.Stored("float32", rounded=False)
        said = card.text(second, checkpoint.last(second), card.AEGIS, REPO, stored)
        assert yaml.safe_load(said.split("---\n", 2)[1])["base_model"] == name


def test_a_card_names_no_run_that_others_do_not_have(
    run_folder: Path, demos_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This includes a third run, and earlier runs that are gone."""
    shutil.copytree(run_folder, tmp_path / "runs" / "first", symlinks=True)
    began = Path(recipes.load(run_folder / "recipe.yaml").backbone).name
    monkeypatch.chdir(tmp_path)
    for before, run in (("first", "second"), ("second", "third")):
        started = small(f"runs/{before}", steps=1)
        train.run(started, "naive", demos_file, None, Path("runs", run))
        shutil.rmtree(Path("runs", before))
        at, stored = checkpoint.last(Path("runs", run)), card.Stored("float32", rounded=False)
        for form in FORMS:
            said = card.text(Path("runs", run), at, form, REPO, stored)
            assert f"model `{began}` (which Aegis had fine-tuned before) and" in said
            assert f"--baseline {began} " in said and "runs/" not in said


def test_a_card_of_an_unmeasured_checkpoint_says_so(run_folder: Path) -> None:
    bare = results.probes(run_folder)
    assert bare  # so that the run itself has figures
    recipe_of_run = recipes.load(run_folder / "recipe.yaml")
    unmeasured = card.inspection.InspectReport("run", "x", {})
    found = card._knowledge(unmeasured, recipe_of_run)
    assert next(found).startswith("Not measured")
    assert next(card._acting(unmeasured)).startswith("Not measured")


def test_a_card_has_the_open_loop_error_where_nothing_can_be_rolled_out_and_where_it_can() -> None:
    evaluated = Result("evaluate-validation-arm", open_loop(1, 2, data="/home/somebody/arm"), {})
    played = PlayedResult("rollout-seen", rollout_figures("seen", 0.75), {}, Played(0, 4, None))
    alone = card.inspection.InspectReport("run", "x", {}, open_loops=(evaluated,))
    line = "| 2 held-out episodes of arm | 50 | 0.250 (0.125 to 0.375); hold's 0.500 |"
    lines = [*card._acting(alone)]
    assert line in lines and not any("Not measured" in each for each in lines)
    both = [*card._acting(dataclasses.replace(alone, rollouts=(played,)))]
    assert line in both and any(each.startswith("| reach | seen | 4 | 75.0 %") for each in both)
    # A Markdown table ends with an empty line.
    assert both[both.index(lines[0]) - 1] == "" and lines[lines.index(line) + 1] == ""
    assert any("Hold is" in each for each in lines)


def test_a_card_has_the_success_in_each_suite() -> None:
    """Papers report LIBERO's four suites one by one."""
    parts = {"libero/goal": {"success": 0.5, "interval": [0.25, 0.75], "episodes": 3}}
    figures = rollout_figures("", 0.375) | {"task": "libero/all", "colors": None, "suites": parts}
    played = PlayedResult("rollout-seen-libero", figures, {}, Played(0, 4, None))
    rows = [*card._acting(card.inspection.InspectReport("run", "x", {}, rollouts=(played,)))]
    place = next(i for i, row in enumerate(rows) if row.startswith("| libero/all |  | 4 | 37.5 %"))
    assert rows[place + 1] == "| libero/goal, of these |  | 3 | 50.0 % (25.0 to 75.0) |"


@pytest.mark.parametrize(
    ("interval", "said"), [((200.0, 300.0), "250 (200 to 300)"), (None, "250")]
)
def test_a_card_has_the_return_of_a_suite_task_as_a_share_of_the_highest(
    interval: tuple[float, float] | None, said: str
) -> None:
    """As in `aegis rollout`, and not as a share of what the demonstrations reached."""
    report = rollout.RolloutReport(
        task="suite/cartpole-swingup",
        mean_return=250.0,
        return_interval=interval,
        return_share=0.25,
        episodes=4,
        episodes_per_s=1.0,
    )
    played = PlayedResult("rollout-seen", report.to_json(), {}, Played(0, 4, None))
    rows = [*card._acting(card.inspection.InspectReport("run", "x", {}, rollouts=(played,)))]
    task = "| suite/cartpole-swingup |  | 4 |"
    assert f"{task} mean return {said}, 25.0 % of the highest there is |" in rows


@pytest.mark.parametrize(("method", "reads"), [("naive", False), ("nullspace", True)])
def test_a_card_names_an_anchor_only_where_the_weights_came_about_with_it(
    method: str,
    reads: bool,
    recipe: recipes.Recipe,
    demos_file: Path,
    anchor_file: Path,
    tmp_path: Path,
) -> None:
    train.run(recipe, method, demos_file, anchor_file, tmp_path / "run")
    at, stored = checkpoint.last(tmp_path / "run"), card.Stored("float32", rounded=False)
    said = card.text(tmp_path / "run", at, card.AEGIS, REPO, stored)
    assert ("\n- anchor: " in said) is reads and "\n- demos: " in said


def test_equal_runs_have_equal_cards(run_folder: Path) -> None:
    at, stored = checkpoint.last(run_folder), card.Stored("float32", rounded=False)
    one, other = (card.text(run_folder, at, card.LEROBOT, REPO, stored) for _ in range(2))
    assert one == other and not any(line != line.rstrip() for line in one.splitlines())


@pytest.mark.parametrize(
    ("task", "line"),
    [("reach", "aegis rollout somebody/x\n"), (None, "aegis evaluate somebody/x --demos")],
)
def test_a_card_says_what_a_policy_of_its_kind_can_be_used_for(
    task: str | None, line: str, run_folder: Path
) -> None:
    recipe = recipes.load(run_folder / "recipe.yaml")
    for form in (card.AEGIS, card.LEROBOT):
        said = card._use(form, "somebody/x", recipe, task)
        assert line in said and ("aegis rollout" in said) == (task is not None)
        assert re.search("--vqa scenes( --questions [0-9]+)?\n", said)


def test_a_card_asks_as_the_run_has_asked(run_folder: Path) -> None:
    recipe = recipes.load(run_folder / "recipe.yaml")
    ask = "{} Answer 'yes' or \"no\", in $1 word."
    asked = dataclasses.replace(
        recipe,
        probe=dataclasses.replace(recipe.probe, ask=ask, skip_bad=True, questions=70, seed=3),
    )
    for form in FORMS:
        assert "--ask" not in card._use(form, "somebody/x", recipe, "reach")
        (line,) = re.findall(
            "^aegis probe .*$", card._use(form, "somebody/x", asked, "reach"), re.M
        )
        words = shlex.split(line)
        assert words[words.index("--ask") + 1] == ask
        assert words[words.index("--vqa") + 1] == "scenes"
        assert words[-5:] == ["--skip-bad", "--questions", "70", "--seed", "3"]


@pytest.mark.parametrize(
    ("task", "cameras", "command"),
    [
        ("reach", (), "lerobot-eval {} --env.type=aegis --env.task=reach"),
        ("reach", ("top",), "lerobot-eval {} --env.type=aegis --env.task=reach"),
        (
            "reach",
            ("wrist",),
            "lerobot-eval {} --env.type=aegis --env.task=reach --env.camera=wrist",
        ),
        (
            "metaworld/mt4",
            ("observation.images.corner2",),
            "lerobot-eval {} --env.type=aegis --env.task=metaworld/mt4",
        ),
        ("metaworld/mt4", ("corner", "gripperPOV"), "# lerobot-eval cannot: .* the policy 2"),
        (
            "libero/object",
            ("observation.images.image", "observation.images.image2"),
            "lerobot-eval {} --env.type=libero --env.task=libero_object",
        ),
        (
            "libero/90-12",
            ("observation.images.agentview", "observation.images.wrist_image"),
            "lerobot-eval {} --env.type=libero --env.task=libero_90 --env.task_ids='\\[12\\]' "
            """--rename_map='{{"observation.images.image": "observation.images.agentview", """
            """"observation.images.image2": "observation.images.wrist_image"}}'""",
        ),
        (
            None,
            ("observation.image",),
            "lerobot-rollout --strategy.type=base {} --robot.type=ROBOT --task=INSTRUCTION "
            "--fps=15",
        ),
    ],
)
def test_a_card_for_lerobot_has_a_command_that_can_run(
    task: str | None, cameras: tuple[str, ...], command: str, run_folder: Path
) -> None:
    """`lerobot-eval` requires an environment, and ours have one camera.

    A robot acts at 30 frames per second unless LeRobot is given its rate.
    """
    recipe = recipes.load(run_folder / "recipe.yaml")
    looks_by = () if task is None else card._looks_by(cast(PolicyMeta, {"cameras": cameras}), task)
    said = card._use(card.LEROBOT, "somebody/x", recipe, task, cameras, looks_by, 15.0)
    line = said.split("```sh\n")[1].splitlines()[0]
    assert re.fullmatch(command.format("--policy.path=somebody/x"), line)
    ours = task is not None and sim.of_datasets(task) is None
    assert ("lerobot_env_aegis" in said) == ours


def test_a_dry_run_needs_no_token_and_sends_nothing(
    aegis: Aegis, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(push, "_api", lambda: pytest.fail("asked for the hub"))
    code, out, _ = aegis("push", run_folder, REPO, "--dry-run", "--format", "lerobot", "--json")
    report = json.loads(out)
    assert code == 0 and report["url"] is None
    assert {card.NAME, "config.json", "model.safetensors"} <= set(report["files"])


def test_private_asks_for_a_private_repository(run_folder: Path, hub: Hub) -> None:
    push.run(run_folder, REPO, private=True)
    assert hub.created is not None and "private" in json.dumps(hub.created)
    push.run(run_folder, REPO)
    assert "private" not in json.dumps(hub.created)


def test_private_never_writes_to_a_public_repository(
    aegis: Aegis, run_folder: Path, hub: Hub
) -> None:
    hub.public = True
    assert "there and public" in refused(aegis("push", run_folder, REPO, "--private"))
    assert hub.committed == {}


def test_a_token_is_asked_for_before_any_work(
    aegis: Aegis, run_folder: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import huggingface_hub

    monkeypatch.setattr(huggingface_hub, "get_token", lambda: None)
    assert "hf auth login" in refused(aegis("push", run_folder, REPO))


def test_a_token_that_the_hub_refuses_is_one_error(
    aegis: Aegis, run_folder: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_stale")
    said = refused(aegis("push", run_folder, REPO))
    assert "(401)" in said and "hf auth login" in said


def test_no_network_is_one_error(
    aegis: Aegis, run_folder: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:1")
    assert "cannot be reached" in refused(aegis("push", run_folder, REPO))


def test_an_offline_hub_is_one_error(
    aegis: Aegis, run_folder: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    assert "HF_HUB_OFFLINE" in refused(aegis("push", run_folder, REPO))


@pytest.mark.parametrize("name", ["alone", "a/b/c", "-a/b", "a/b.git", "a/b--c", "a b/c", "/b"])
def test_what_is_no_repository_is_refused(name: str, aegis: Aegis, tmp_path: Path) -> None:
    """It is refused before the run is read."""
    assert "ORG/NAME" in refused(aegis("push", "--dry-run", "--", tmp_path, name))


@pytest.fixture(scope="module", params=FORMS)
def exported(
    request: pytest.FixtureRequest, run_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, str]:
    """The output of `aegis export`, under a name that is no repository's, and its format."""
    out = tmp_path_factory.mktemp("exports") / "the arm.v2"
    export.run(run_folder, out, request.param)
    return out, request.param


def test_an_export_is_sent_as_its_run_would_be(
    exported: tuple[Path, str], run_folder: Path, hub: Hub, own_cache: None
) -> None:
    folder, form = exported
    of_run = push.run(run_folder, REPO, form)
    sent = dict(hub.committed)
    hub.committed.clear()
    of_export = push.run(folder, REPO)
    assert of_export == of_run and hub.committed == sent
    assert b"ORG/" not in sent[card.NAME] and REPO.encode() in sent[card.NAME]


def test_the_card_of_an_export_may_be_edited_and_hidden_files_stay(
    exported: tuple[Path, str], hub: Hub, tmp_path: Path
) -> None:
    folder = shutil.copytree(exported[0], tmp_path / "mine")
    (folder / ".git").mkdir()
    (folder / ".git" / "config").write_text("mine")
    own = "Of our own robot, as in {}. And ORGAN/x, für alle"
    (folder / card.NAME).write_text(own.format("ORG/the-arm.v2"), encoding="utf-8")
    push.run(folder, REPO)
    assert hub.committed[card.NAME].decode() == own.format(REPO)
    assert (folder / card.NAME).read_text(encoding="utf-8") == own.format("ORG/the-arm.v2")
    assert not any(".git" in name for name in hub.committed)


def test_a_card_that_the_hub_does_not_take_is_one_error(
    exported: tuple[Path, str], hub: Hub, aegis: Aegis
) -> None:
    hub.card_error = '"license" must be a string'
    said = refused(aegis("push", exported[0], REPO))
    assert hub.card_error in said and "nothing was committed" in said
    assert hub.committed == {}


def test_an_export_is_sent_in_its_own_layout_and_type(
    exported: tuple[Path, str], aegis: Aegis
) -> None:
    folder, form = exported
    (other,) = set(FORMS) - {form}
    for option in (("--format", other), ("--dtype", "float32")):
        said = refused(aegis("push", folder, REPO, "--dry-run", *option))
        assert " ".join(option) in said and f"exported with --format {form}" in said
    code, out, _ = aegis("push", folder, REPO, "--dry-run", "--format", form, "--json")
    assert code == 0 and json.loads(out)["format"] == form


def test_an_export_without_a_card_or_with_a_damaged_policy_is_refused(
    exported: tuple[Path, str], aegis: Aegis, tmp_path: Path
) -> None:
    folder = shutil.copytree(exported[0], tmp_path / "mine")
    weights = next(path for path in folder.glob("*.safetensors"))
    whole = weights.read_bytes()
    weights.write_bytes(whole[:-100])
    assert weights.name in refused(aegis("push", folder, REPO, "--dry-run"))
    weights.write_bytes(whole)
    (folder / card.NAME).write_bytes(b"\xff")
    assert "UTF-8" in refused(aegis("push", folder, REPO, "--dry-run"))
    (folder / card.NAME).unlink()
    assert "hf upload" in refused(aegis("push", folder, REPO, "--dry-run"))


def test_what_is_no_run_is_refused(aegis: Aegis, run_folder: Path, tmp_path: Path) -> None:
    assert "no checkpoint" in refused(aegis("push", tmp_path, REPO, "--dry-run"))
    alone = tmp_path / "alone"
    at = checkpoint.last(run_folder).resolve()
    (alone / "backbone").mkdir(parents=True)
    (alone / checkpoint.EXPERT).write_bytes((at / checkpoint.EXPERT).read_bytes())
    said = refused(aegis("push", alone, REPO, "--dry-run"))
    assert "outside of its run" in said and f"hf upload {REPO} {alone}" in said
