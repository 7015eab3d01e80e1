"""MetaWorld's tasks and sets by name, and what is refused; does not need MetaWorld."""

from __future__ import annotations

import re
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from samples.command import python, refused

from aegis_cli import recipes, sim
from aegis_cli.common.errors import AegisError
from aegis_cli.data import keeping
from aegis_cli.data.vqa import questions
from aegis_cli.data.vqa.words import wide_vocabulary
from aegis_cli.models.backbones.tokenizer import SPECIAL, Tokenizer
from aegis_cli.sim import metaworld_table as table
from aegis_cli.sim.recording import RecordedEpisode


def test_every_task_has_sentences_of_its_own() -> None:
    assert len(table.SENTENCES) == 50
    said: dict[str, str] = {}
    for task, sentences in table.SENTENCES.items():
        assert len(set(sentences)) >= 2
        for sentence in sentences:
            assert re.fullmatch("[a-z]+( [a-z]+)+", sentence), sentence
            assert said.setdefault(sentence, task) == task, sentence


def test_sets_are_of_tasks_that_there_are() -> None:
    assert {name: len(tasks) for name, tasks in table.SETS.items()} == {
        "mt4": 4,
        "mt10": 10,
        "mt50": 50,
    }
    for tasks in table.SETS.values():
        assert len(set(tasks)) == len(tasks) and set(tasks) <= set(table.SENTENCES)
    assert len(table.names()) == 53


def test_every_instruction_can_be_said_to_embedded_easy() -> None:
    tokenizer = Tokenizer((*SPECIAL, *wide_vocabulary()))
    for sentences in table.SENTENCES.values():
        for text in sentences:
            tokenizer.encode(text)


def test_no_instruction_of_mt4_begins_as_a_question_about_scenes_does() -> None:
    asked = [text.replace("{}", "") for text in questions._WHERE]
    for text in table.spec("metaworld/mt4").templates:
        assert not any(text.startswith(question.strip()) for question in asked)


def test_tasks_of_a_set_take_turns() -> None:
    name = "metaworld/mt4"
    tasks = sim.members(name)
    assert [sim.member(name, i) for i in range(9)] == [*tasks, *tasks, tasks[0]]
    assert sim.members("reach") == ("reach",) and sim.member("metaworld/push", 7) == (
        "metaworld/push"
    )


def test_a_set_knows_the_sentences_of_all_its_tasks() -> None:
    found = table.spec("metaworld/mt10")
    assert found.name == "metaworld/mt10"
    for task in sim.members(found.name):
        assert set(table.spec(task).templates) <= set(found.templates)


# --- which episodes are kept ----------------------------------------------------------------------


def kept(tasks: tuple[str, ...], fails: set[int], episodes: int) -> tuple[list, keeping.Seen]:
    """The tasks of the kept episodes if the episodes with the numbers `fails` fail."""

    def recorded(number: int) -> RecordedEpisode:
        blank = [np.zeros((1, 1))] * 3
        task = tasks[number % len(tasks)]
        return RecordedEpisode(*blank, "go", None, number not in fails, task=task)

    seen = keeping.Seen()
    found = keeping.successes(partial(recorded), episodes, 1, seen, lambda _: None, tasks)
    return [episode.task for episode in found], seen


@pytest.mark.parametrize("seed", range(10))
def test_every_task_gets_its_share_whatever_fails(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tasks = ("a", "b", "c", "d")[: rng.integers(1, 5)]
    episodes = int(rng.integers(1, 30))
    fails = set(np.flatnonzero(rng.random(200) < 0.2).tolist())
    found, seen = kept(tasks, fails, episodes)
    assert len(found) == episodes
    assert {task: found.count(task) for task in tasks} == keeping.shares(tasks, episodes)
    assert max(map(found.count, tasks)) - min(map(found.count, tasks)) <= 1
    tried = range(seen.attempts)
    assert seen.failures.total() == len(fails & set(tried))
    assert seen.success == pytest.approx(1 - seen.failures.total() / seen.attempts)


def test_an_expert_that_keeps_failing_is_named() -> None:
    with pytest.raises(AegisError, match="there are too few of b") as caught:
        kept(("a", "b"), set(range(1, 1000, 2)), 6)
    assert "3 of 52 episodes" in caught.value.found


# --- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("metaworld/buton-press", "'metaworld/button-press'"),
        ("metaworld/button-press-v3", "'metaworld/button-press'"),
        ("button-press", "'metaworld/button-press'"),
        ("metaworld/mt3", "'metaworld/mt4'"),
        ("metaworld/", "e.g. metaworld/button-press"),
        ("metaworld", "e.g. metaworld/button-press"),
    ],
)
def test_an_unknown_name_leads_to_a_close_one(name: str, says: str) -> None:
    with pytest.raises(AegisError) as caught:
        sim.check(name)
    assert f"'{name}'" in caught.value.found and says in caught.value.fix


@pytest.fixture
def without_metaworld(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without it, even if it is installed and imported."""
    monkeypatch.delitem(sys.modules, "aegis_cli.sim.metaworld", raising=False)
    monkeypatch.setitem(sys.modules, "metaworld", None)
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)


@pytest.mark.usefixtures("without_metaworld")
def test_without_the_package_the_command_that_installs_it_is_named(aegis, tmp_path: Path) -> None:
    message = refused(aegis("demos", "metaworld/button-press", "--out", tmp_path / "d.safetensors"))
    assert "pip install 'aegis-vla[metaworld]'" in message
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("without_metaworld")
def test_a_missing_package_is_an_error_that_says_so() -> None:
    with pytest.raises(AegisError) as caught:
        sim.check("metaworld/mt4")
    assert caught.value.fix == "pip install 'aegis-vla[metaworld]'"


# --- recipes --------------------------------------------------------------------------------------


def test_recipes_with_metaworld_tasks_need_no_simulator() -> None:
    program = (
        "import sys; from aegis_cli import recipes\n"
        "made = recipes.load('recipes/metaworld.yaml', ['task=metaworld/mt10'])\n"
        "assert made.task == 'metaworld/mt10'\n"
        "heavy = {'torch', 'numpy', 'mujoco', 'metaworld'} & set(sys.modules); assert not "
        "heavy, heavy"
    )
    done = python(program)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("task=metaworld/Button", "metaworld/TASK"),
        ("rollout.colors=[seen]", "delete rollout.colors"),
        ("demos.drop_below=0.1", "delete demos.drop_below"),
    ],
)
def test_bad_recipes(setting: str, says: str) -> None:
    with pytest.raises(AegisError) as caught:
        recipes.load("recipes/metaworld.yaml", [setting])
    assert says in str(caught.value)
