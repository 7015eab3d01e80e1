"""LIBERO's tasks and suites by name, and what is refused; does not need LIBERO."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from samples.command import refused

from aegis_cli import recipes, sim
from aegis_cli.common.errors import AegisError
from aegis_cli.sim import libero_table as table
from aegis_cli.sim.libero_table import CAMERAS

SUITES = ("spatial", "object", "goal", "10", "90")
# The steps that LeRobot allows per suite: `TASK_SUITE_MAX_STEPS` of lerobot.envs.libero.
LEROBOT_STEPS = {"spatial": 280, "object": 280, "goal": 300, "10": 520, "90": 400}


def test_every_suite_has_its_tasks_by_their_numbers() -> None:
    for suite, count in zip(SUITES, (10, 10, 10, 10, 90), strict=True):
        tasks = sim.members(f"libero/{suite}")
        assert tasks == tuple(f"libero/{suite}-{number}" for number in range(count))
        assert [table.place(task) for task in tasks] == [(suite, n) for n in range(count)]
        assert {table.steps(task) for task in tasks} == {LEROBOT_STEPS[suite]}
        assert sim.members(tasks[-1]) == (tasks[-1],)
    assert len(set(table.names())) == len(table.names()) == 1 + 5 + 40 + 90


def test_every_task_has_an_instruction_that_leads_back_to_it() -> None:
    """To it alone, except for a few that libero/90's scenes share with each other or two suites."""
    for suite in SUITES:
        tasks = sim.members(f"libero/{suite}")
        texts = table.instructions(f"libero/{suite}")
        assert len(texts) == len(tasks)
        for task, text in zip(tasks, texts, strict=True):
            assert task in table.told(text) and text == text.strip().lower()
            assert len({*sim.members("libero/all")} & {*table.told(text)}) <= 1
    assert table.told("do what you like") == table.told("") == ()
    assert table.told("Turn on the stove\n") == ("libero/goal-7", "libero/90-20", "libero/90-44")


def test_all_is_the_four_suites_that_papers_report() -> None:
    of_suites = [task for suite in SUITES[:-1] for task in sim.members(f"libero/{suite}")]
    assert list(sim.members("libero/all")) == of_suites and len(of_suites) == 40
    assert [suite.removeprefix("libero/") for suite in sim.suites("libero/all")] == [*SUITES[:-1]]
    assert not any(map(sim.suites, ("libero/goal", "libero/10-3", "metaworld/mt10", "reach")))
    assert table.spec("libero/all").max_steps == 520  # the longest suite's
    assert [sim.member("libero/all", n) for n in (0, 39, 40)] == [
        "libero/spatial-0",
        "libero/10-9",
        "libero/spatial-0",
    ]


def test_a_policy_looks_by_the_names_that_data_sets_use() -> None:
    assert {CAMERAS[name] for name in ("image", "agentview")} == {"agentview"}
    wrist = {CAMERAS[name] for name in ("image2", "wrist_image", "robot0_eye_in_hand")}
    assert wrist == {"robot0_eye_in_hand"}
    for seen_by in (("image", "image2"), ("image", "wrist_image"), ("whatever",)):
        assert sim.playable("libero/goal", seen_by) == "libero/goal"
    assert sim.playable("libero/goal", ("image", "wrist")) is None
    with pytest.raises(AegisError, match="as cameras of 'libero/goal'"):
        sim.check_cameras("libero/goal", ("corner2",))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("libero/spatail", "'libero/spatial'"),
        ("libero_spatial", "'libero/spatial'"),
        ("libero/object-10", "'libero/object-1'"),
        ("libero/", "e.g. libero/spatial"),
        ("libero", "e.g. libero/spatial"),
    ],
)
def test_an_unknown_name_leads_to_a_close_one(name: str, says: str) -> None:
    with pytest.raises(AegisError) as caught:
        sim.check(name)
    assert f"'{name}'" in caught.value.found and says in caught.value.fix


def test_libero_alone_is_learned_from_data_sets() -> None:
    for name in ("reach", "suite/cartpole-swingup", "metaworld/mt4"):
        assert sim.of_datasets(name) is None
    spec = sim.of_datasets("libero/10")
    assert spec is not None and (len(spec.proprio_names), len(spec.action_names)) == (8, 7)
    with pytest.raises(AegisError, match="'libero/11'"):
        sim.of_datasets("libero/11")


def test_it_cannot_be_recorded(aegis, tmp_path: Path) -> None:
    """Wherever demonstrations can be recorded, and whether or not LIBERO is installed."""
    out = tmp_path / "d.safetensors"
    asked = "HuggingFaceVLA/libero"
    assert asked in refused(aegis("demos", "libero/object", "--out", out))
    policy = {"kind": "policy", "name": "x", "methods": ["naive"], "task": "libero/object"}
    stream = {"kind": "robot-stream", "name": "x", "tasks": ["reach", "libero/object"]}
    study = {
        "kind": "study",
        "name": "x",
        "tasks": ["reach", "libero/object"],
        "seeds": [0],
        "variants": {"naive": {"method": "naive"}},
    }
    recipe = tmp_path / "r.yaml"
    for command, keys in (("run", policy), ("run", study), ("train", stream)):
        recipe.write_text(json.dumps(keys))
        assert asked in refused(aegis(command, recipe, "--out", tmp_path / "runs"))
    assert [path.name for path in tmp_path.iterdir()] == ["r.yaml"]


def test_a_missing_package_is_an_error_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "aegis_cli.sim.libero", raising=False)
    for name in ("libero", "libero.libero"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(AegisError) as caught:
        sim.check("libero/all")
    assert caught.value.fix == "pip install 'aegis-vla[libero]'"


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("task=libero/Object", "libero/SUITE"),
        ("rollout.colors=[seen]", "delete rollout.colors"),
        ("demos.drop_below=0.1", "delete demos.drop_below"),
    ],
)
def test_bad_recipes(setting: str, says: str) -> None:
    with pytest.raises(AegisError, match=re.escape(says)):
        recipes.load("recipes/paligemma2-libero.yaml", [setting])
