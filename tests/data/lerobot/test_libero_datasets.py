"""Demonstrations of LIBERO, which do not say that they are: the recipe's task says it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from samples.lerobot import READABLE, episodes, frame_cache, save  # noqa: F401
from samples.training_runs import Start

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.continual import robot_demos
from aegis_cli.data import demonstrations
from aegis_cli.evaluation import rollout
from aegis_cli.models import backbones
from aegis_cli.models.policy import Policy
from aegis_cli.models.policy_meta import PolicyMeta
from aegis_cli.recipes import Demos, Recipe, RobotDemos, RobotStreamRecipe
from aegis_cli.sim import libero_table as table
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.robot_stream_cells import cell_key as robot_cell_key
from aegis_cli.training import checkpoint, loading

pytestmark = pytest.mark.usefixtures("frame_cache")

SPEC = table.spec("libero/object")
ONE = ("image",)


def libero(folder: Path, cameras: tuple[str, ...] = ONE, positions: int = 8) -> Path:
    """A data set with LIBERO's columns, of some robot's type."""
    rng = np.random.default_rng(0)
    made = [
        dataclasses.replace(
            one,
            state=rng.normal(size=(len(one.state), positions)).astype(np.float32),
            actions=rng.uniform(-1, 1, (len(one.actions), 7)).astype(np.float32),
        )
        for one in episodes(6, cameras, (16, 16), texts=READABLE)
    ]
    names = SPEC.proprio_names[:positions]
    return save(folder, made, state_names=names, action_names=SPEC.action_names)


def of(recipe: Recipe, **demos: Any) -> Recipe:
    """The recipe for LIBERO's tasks, with changed keys of its demonstrations."""
    return dataclasses.replace(recipe, task="libero/object", demos=Demos(**demos))


def test_a_recipe_says_that_they_are_liberos(start: Start, recipe: Recipe, tmp_path: Path) -> None:
    start("naive", tmp_path / "run", demos=libero(tmp_path / "d"), recipe=of(recipe))
    assert checkpoint.load_policy(tmp_path / "run")[1]["task"] == "libero/object"


def test_else_they_are_of_no_simulated_task(start: Start, tmp_path: Path) -> None:
    folder = libero(tmp_path / "d")
    start("naive", tmp_path / "run", demos=folder)
    assert checkpoint.load_policy(tmp_path / "run")[1]["task"] is None
    assert demonstrations.playable_task(folder, None, "reach") is None
    assert demonstrations.playable_task(folder, None, "libero/10") == "libero/10"


def test_another_robots_are_refused(start: Start, recipe: Recipe, tmp_path: Path) -> None:
    with pytest.raises(AegisError, match="7 positions and 7 actions for task: libero/object") as e:
        start(
            "naive", tmp_path / "run", demos=libero(tmp_path / "d", positions=7), recipe=of(recipe)
        )
    assert "8 positions (x_m, " in e.value.expected and not (tmp_path / "run").exists()


@pytest.mark.parametrize("task", ["libero/objects", "libero/object-10"])
def test_a_task_that_libero_does_not_have_is_refused(
    task: str, start: Start, recipe: Recipe, tmp_path: Path
) -> None:
    misspelt = dataclasses.replace(recipe, task=task)
    with pytest.raises(AegisError, match=task):
        start("naive", tmp_path / "run", demos=libero(tmp_path / "d"), recipe=misspelt)


def test_cameras_of_other_names_are_refused_until_they_are_renamed(
    recipe: Recipe, tmp_path: Path
) -> None:
    folder = libero(tmp_path / "d", ("front", "hand"))
    both = ("front", "hand")

    def load(**demos: Any) -> demonstrations.Demonstrations:
        selected = of(recipe, **demos).demos.selection
        found = demonstrations.load(folder, 0.3, 0, selected)
        return loading.of_named_task(found, "libero/object", demos.get("rename", {}))

    with pytest.raises(AegisError, match="2 cameras: ") as caught:
        load(camera=both)
    assert "'demos.rename={front: image, hand: image2}'" in caught.value.fix
    renamed = {"front": "image", "hand": "wrist_image"}
    assert load(camera=("image", "wrist_image"), rename=renamed).task == "libero/object"
    assert load(camera="front").task == "libero/object"  # whatever the name of its only camera


def test_a_camera_that_is_renamed_away_is_still_the_tasks(tmp_path: Path) -> None:
    """For example SmolVLA's names, which LIBERO does not know."""
    folder = libero(tmp_path / "d", ("image", "image2"))
    rename = {"image": "camera1", "image2": "camera2"}
    seen_by = ("camera1", "camera2")
    assert demonstrations.playable_task(folder, seen_by, "libero/10", rename) == "libero/10"
    meta = cast(PolicyMeta, {"cameras": seen_by, "rename": rename})
    assert checkpoint.cameras_of(meta, "libero/10") == ("image", "image2")


def test_a_stream_learns_suite_after_suite(tiny_folder: Path, tmp_path: Path) -> None:
    """Each task has a data set; the recipe chooses its camera and features."""
    paths = tuple(str(libero(tmp_path / name, ("image", "image2"))) for name in ("a", "b"))
    recipe = RobotStreamRecipe(
        name="x",
        tasks=("libero/object", "libero/goal"),
        backbone=str(tiny_folder),
        demos=RobotDemos(paths=paths, camera="image"),
    )
    backbone = backbones.load(str(tiny_folder))

    def loaded(number: int, **changes: Any) -> demonstrations.Demonstrations:
        changed = dataclasses.replace(recipe, **changes)
        return robot_demos.load(changed, number, backbone, tmp_path / "run", ignore)

    for number, task in enumerate(recipe.tasks):
        found = loaded(number)
        assert (found.task, found.cameras) == (task, ("observation.images.image",))
    with pytest.raises(AegisError, match="has 2 cameras"):
        loaded(0, demos=RobotDemos(paths=paths))
    with pytest.raises(AegisError, match="demonstrations of no simulated task"):
        loaded(0, tasks=("point", "reach"))
    other = dataclasses.replace(recipe.demos, state="action")
    with pytest.raises(AegisError, match="7 positions and 7 actions for task: libero/object"):
        loaded(0, demos=other)


def test_what_a_stream_reads_of_its_data_tells_its_runs_and_cells_apart() -> None:
    """The digest of the files does not show it. Runs from before the key existed can resume."""
    recipe = RobotStreamRecipe(
        name="x", tasks=("libero/object",), backbone="b", demos=RobotDemos(paths=("a",))
    )
    chosen = dataclasses.replace(recipe, demos=RobotDemos(paths=("a",), action="other"))
    assert "demos" not in recipes.training_part(recipe)
    assert recipes.training_part(chosen)["demos"] == {"action": "other"}
    keys = {robot_cell_key(Cell("x", made), "", ["digest"], {}) for made in (recipe, chosen)}
    assert len(keys) == 2


def test_a_policy_of_one_suite_acts_in_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollout.sim, "check", lambda _: None)  # which would need LIBERO
    policy = cast(Policy, None)
    for asked in ("libero/goal", "libero/object-3", "libero/all"):
        assert rollout._task(policy, "libero/object", asked) == asked
    assert rollout._task(policy, "libero/object", None) == "libero/object"
    for trained, asked in (("libero/object", "reach"), ("metaworld/mt4", "libero/object")):
        with pytest.raises(AegisError, match=f"'{asked}' for a policy trained on '{trained}'"):
            rollout._task(policy, trained, asked)


@pytest.mark.parametrize(("sizes", "task"), [((8, 7), "libero/spatial"), ((6, 2), "reach")])
def test_one_that_knows_no_task_is_told_of_one_that_may_fit(
    sizes: tuple[int, int], task: str
) -> None:
    shape = SimpleNamespace(proprio=sizes[0], actions=sizes[1])
    policy = cast(Policy, SimpleNamespace(expert=SimpleNamespace(shape=shape)))
    with pytest.raises(AegisError, match="dataset that is not of a simulated task") as caught:
        rollout._task(policy, None, None)
    assert caught.value.fix == f"--task {task}"


@pytest.mark.parametrize(("rate", "warned"), [(10.0, False), (20.0, False), (30.0, True)])
def test_ten_steps_a_second_are_liberos_too(
    rate: float, warned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its simulator runs at twenty, and the usual copies of its demonstrations state ten."""
    monkeypatch.setattr(rollout.sim, "make", lambda name: SimpleNamespace(spec=table.spec(name)))
    events: list[Any] = []
    rollout._check_rate(rate, "libero/object", events.append)
    assert bool(events) == warned
