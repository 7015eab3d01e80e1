"""A pushed policy can be used by its id on the hub wherever a run's folder can."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from samples.command import refused
from samples.hub import Hub, serving
from samples.small_run import recipe as small

from aegis_cli import deploy
from aegis_cli.common.errors import AegisError
from aegis_cli.data import demonstrations
from aegis_cli.evaluation import open_loop
from aegis_cli.models import backbones, download
from aegis_cli.publishing import card, export, push
from aegis_cli.training import checkpoint, train

Aegis = Callable[..., tuple[int, str, str]]
REPO = "somebody/reach-naive"
FORMS = (card.AEGIS, card.LEROBOT)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A hub cache for this test alone, in a folder without one named ORG."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub-cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "hub-cache"


@pytest.fixture(params=FORMS)
def pushed(request: pytest.FixtureRequest, run_folder: Path, hub: Hub) -> Hub:
    """The hub after the run's policy was pushed in either layout."""
    push.run(run_folder, REPO, request.param)
    return hub


def test_load_policy_takes_its_id_and_acts_as_the_run_does(
    pushed: Hub, run_folder: Path, demos_file: Path
) -> None:
    demos = demonstrations.load(demos_file, None, 0)
    frame = demos.images(torch.tensor([3]))[0].numpy()
    given = frame, demos.instructions[0], demos.tensors["proprio"][3].numpy()
    own, found = deploy.load_policy(run_folder), deploy.load_policy(REPO)
    np.testing.assert_array_equal(own.select_action(*given), found.select_action(*given))
    assert (found.task, found.replan) == (own.task, own.replan)


def test_only_what_a_policy_is_made_of_is_downloaded(pushed: Hub) -> None:
    checkpoint.load_policy(REPO)
    names = {*pushed.downloaded}
    assert {"backbone/model.safetensors", "model.safetensors"} & names
    others = {name for name in pushed.committed if name not in names}
    assert card.NAME in others and export.RECIPE not in names
    assert not any(name.endswith(".md") or "processor" in name for name in names)


def test_what_was_downloaded_is_used_without_a_network(
    pushed: Hub, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    checkpoint.load_policy(REPO)
    pushed.committed.clear()
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    found = checkpoint.load_policy(REPO)[0].state_dict()
    own = checkpoint.load_policy(run_folder)[0].state_dict()
    assert all(torch.equal(tensor, found[name]) for name, tensor in own.items())


def test_the_commands_take_its_id(
    pushed: Hub, aegis: Aegis, run_folder: Path, demos_file: Path, tmp_path: Path
) -> None:
    def said(*command: object) -> dict:
        code, out, err = aegis(*command, "--json")
        assert code == 0, err
        return json.loads(out)

    open_loops = [
        said("evaluate", policy, "--demos", demos_file, "--episodes", "0,1")
        for policy in (run_folder, REPO)
    ]
    assert open_loops[0]["relative_error"] == pytest.approx(open_loops[1]["relative_error"])
    played = [said("rollout", policy, "--episodes", 2) for policy in (run_folder, REPO)]
    assert played[0]["outcomes"] == played[1]["outcomes"]
    probes = [said("probe", policy, "--questions", 7) for policy in (run_folder, REPO)]
    assert probes[0]["accuracy"] == probes[1]["accuracy"]
    assert probes[0]["cross_entropy"] == pytest.approx(probes[1]["cross_entropy"])
    assert said("bench", "--latency", REPO, "--repeats", 1)["run"] == REPO
    assert said("export", REPO, "--out", tmp_path / "policy")["task"] == "reach"
    assert not (tmp_path / "somebody").exists()


def test_an_expert_and_a_backbone_begin_with_it(pushed: Hub, run_folder: Path) -> None:
    own = checkpoint.load_expert(run_folder)[0].state_dict()
    found = checkpoint.load_expert(REPO)[0].state_dict()
    assert all(torch.equal(tensor, found[name]) for name, tensor in own.items())
    before = backbones.load(str(run_folder))
    assert backbones.load(REPO).fingerprint() == before.fingerprint()


@pytest.mark.parametrize("form", FORMS)
def test_a_policy_with_a_hugging_face_backbone_comes_back(
    form: str, hf_folder: Callable[[str], Path], demos_file: Path, hub: Hub, tmp_path: Path
) -> None:
    train.run(small(hf_folder("smolvlm"), steps=1), "naive", demos_file, None, tmp_path / "run")
    push.run(tmp_path / "run", REPO, form)
    own = checkpoint.load_policy(tmp_path / "run")[0].state_dict()
    found = checkpoint.load_policy(REPO)[0].state_dict()
    assert all(torch.equal(tensor, found[name]) for name, tensor in own.items())
    assert backbones.load(REPO).depth == backbones.load(str(hf_folder("smolvlm"))).depth


def test_a_folder_of_that_name_comes_first(pushed: Hub, run_folder: Path, tmp_path: Path) -> None:
    export.run(run_folder, tmp_path / REPO)
    checkpoint.load_policy(REPO)
    assert pushed.downloaded == []


@pytest.mark.parametrize("name", ["./somebody/x", "runs/x", "a/b/c", "policies/x", "x"])
def test_what_can_only_be_a_path_is_never_asked_of_the_hub(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "fetch", lambda name: pytest.fail(f"asked for {name}"))
    (tmp_path / "policies").mkdir()
    with pytest.raises(AegisError, match="no checkpoint in") as caught:
        checkpoint.load_policy(name)
    assert ("because a folder 'policies' is here" in caught.value.fix) == (name == "policies/x")


def test_a_policy_of_the_hub_does_not_say_which_episodes_it_was_trained_on(
    run_folder: Path, demos_file: Path, hub: Hub
) -> None:
    push.run(run_folder, REPO)
    with pytest.raises(AegisError, match=f"'{REPO}', a checkpoint outside its run"):
        open_loop.run(Path(REPO), demos_file)


# --- refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"config.json": b'{"type": "smolvla"}'}, "but a policy of the type 'smolvla'"),
        ({"config.json": b'{"model_type": "paligemma"}'}, "a model of the family 'paligemma'"),
        ({"config.json": b"no"}, "a config.json that is not JSON"),
        ({"expert.safetensors": b"x"}, "nor a config.json"),
        ({"notes.txt": b"x"}, "nor a config.json"),
    ],
)
def test_a_repository_of_something_else_says_what_it_is(
    files: dict[str, bytes], said: str, hub: Hub, aegis: Aegis, demos_file: Path
) -> None:
    hub.committed |= {**files, "model.safetensors": b"large"}
    for command in (("rollout", REPO), ("evaluate", REPO, "--demos", demos_file)):
        err = refused(aegis(*command))
        assert f"'{REPO}' of the hub has no policy of Aegis" in err and said in err
        # Of a policy of LeRobot's the error tells how its VLM is had.
        assert (f"aegis extract {REPO} --base VLM" in err) == ("smolvla" in said)
    assert "model.safetensors" not in hub.downloaded


def test_an_id_without_a_network_is_one_error(aegis: Aegis, demos_file: Path) -> None:
    for command in (
        ("rollout", REPO),
        ("evaluate", REPO, "--demos", demos_file),
        ("export", REPO, "--out", "policy"),
        ("bench", "--latency", REPO),
    ):
        err = refused(aegis(*command))
        assert f"no run or folder '{REPO}'" in err
        assert f"hf download {REPO} --local-dir POLICY" in err


def test_the_package_that_asks_the_hub_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download.hub, "is_installed", lambda: False)
    with pytest.raises(AegisError, match=f"no run or policy '{REPO}'") as caught:
        deploy.load_policy(REPO)
    assert "pip install 'aegis-vla[hub]'" in caught.value.fix


def test_a_download_that_breaks_off_is_one_error(
    run_folder: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    push.run(run_folder, REPO)
    with serving() as other:
        gone = other.url
    monkeypatch.setattr(constants, "ENDPOINT", gone)
    with pytest.raises(AegisError, match="no policy of that name from the Hugging Face hub"):
        checkpoint.load_policy(REPO)
