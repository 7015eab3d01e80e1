"""Streams whose tasks take parts of demonstrations: their own instructions, or chosen episodes."""

from __future__ import annotations

import dataclasses
import random
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from samples.dataset_hub import DatasetHub
from samples.interrupted import stop
from samples.lerobot import as_version_2, episodes, frame_cache, save  # noqa: F401
from samples.robots import Make
from samples.training_runs import contents

from aegis_cli import recipes, sim
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import ignore
from aegis_cli.continual import robot_demos, robots, train
from aegis_cli.data import demonstrations
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot.on_demand import FramesOnDemand
from aegis_cli.data.selection import Selection
from aegis_cli.models.backbones.base import Backbone
from aegis_cli.recipes import RobotDemos, RobotStreamRecipe
from aegis_cli.sim import libero_table as table
from aegis_cli.studies.cells import Cell
from aegis_cli.studies.robot_stream_cells import RobotStreamRunner, cell_key

pytestmark = pytest.mark.usefixtures("frame_cache")

SPEC = table.spec("libero/all")
SUITES = ("libero/spatial", "libero/object", "libero/goal", "libero/10")
ANY = cast(
    Backbone,
    SimpleNamespace(
        image_size=None,
        reads_several=True,
        check_prompt=lambda text: None,
        check_prompts=lambda images, texts: None,
    ),
)


def libero(
    folder: Path, texts: Sequence[str], cameras: tuple[str, ...] = ("image",), **spec: Any
) -> Path:
    """A dataset with LIBERO's columns, with one episode per text."""
    rng = np.random.default_rng(0)
    made = [
        dataclasses.replace(
            one,
            state=rng.normal(size=(len(one.state), 8)).astype(np.float32),
            actions=rng.uniform(-1, 1, (len(one.actions), 7)).astype(np.float32),
        )
        for one in episodes(len(texts), cameras, (8, 8), texts=texts)
    ]
    names = {"state_names": SPEC.proprio_names, "action_names": SPEC.action_names}
    return save(folder, made, **names, **spec)


def texts_of(*tasks: str, each: int = 2, seed: int = 0) -> list[str]:
    """Instructions of tasks or suites, each this many times, in any order."""
    found = [text for task in tasks for text in table.instructions(task)] * each
    random.Random(seed).shuffle(found)
    return found


def stream(tasks: Sequence[str], paths: Path | Sequence[Path], **demos: Any) -> RobotStreamRecipe:
    named = str(paths) if isinstance(paths, Path) else tuple(map(str, paths))
    return RobotStreamRecipe(name="x", tasks=tuple(tasks), demos=RobotDemos(paths=named, **demos))


def learned(recipe: RobotStreamRecipe, number: int) -> Demonstrations:
    """The demonstrations of a task as used in its training."""
    return robot_demos.load(recipe, number, ANY, Path("unused"), ignore)


def taken(recipe: RobotStreamRecipe, number: int) -> list[int]:
    """The episodes that a task learns from and validates on."""
    found = learned(recipe, number)
    return found.episode_of[found.read].unique().tolist()


# --- a task's own instructions --------------------------------------------------------------------


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
@pytest.mark.parametrize("seed", range(3))
def test_each_suite_takes_its_own_episodes_of_one_dataset(
    seed: int, version: str, tmp_path: Path
) -> None:
    texts = texts_of(*SUITES, each=1, seed=seed)
    folder = libero(tmp_path / "d", texts)
    recipe = stream(SUITES, folder if version == "v3.0" else as_version_2(folder, version))
    of_each = [taken(recipe, number) for number in range(len(SUITES))]
    for suite, found in zip(SUITES, of_each, strict=True):
        assert {texts[number] for number in found} == {*table.instructions(suite)}
    assert sorted(sum(of_each, [])) == list(range(len(texts)))


@pytest.mark.parametrize("seed", range(3))
def test_so_do_single_tasks_one_after_the_other(seed: int, tmp_path: Path) -> None:
    """This holds if the set is listed for each, and if capitalization differs."""
    texts = [f"{text.capitalize()} " for text in texts_of("libero/all", each=2, seed=seed)]
    tasks = sim.members("libero/goal")
    folder = libero(tmp_path / "d", texts)
    recipe = stream(tasks, [folder] * len(tasks))
    for number, task in enumerate(tasks):
        (own,) = table.instructions(task)
        wanted = [i for i, text in enumerate(texts) if text.strip().lower() == own]
        assert taken(recipe, number) == wanted and len(wanted) == 2


def test_a_task_is_scaled_by_its_own_episodes(tmp_path: Path) -> None:
    together = libero(tmp_path / "d", texts_of("libero/goal", "libero/object"))
    recipe = stream(("libero/goal", "libero/object"), together)
    scales = [learned(recipe, number).scales()[1].mean.tolist() for number in (0, 1)]
    assert scales[0] != scales[1]


@pytest.mark.parametrize(
    ("texts", "task"),
    [
        (texts_of("libero/goal"), "libero/goal"),
        (texts_of("libero/90", each=1), "libero/90"),
        (["do what you like", ""] * 2, "libero/goal"),
    ],
)
def test_a_dataset_of_one_task_is_learned_as_it_was_before(
    texts: list[str], task: str, tmp_path: Path
) -> None:
    """This holds even if the instructions are not LIBERO's: they may have other wordings."""
    folder = libero(tmp_path / "d", texts)
    recipe = stream([task], [folder])
    assert robot_demos.given(recipe, 0) == (folder, Selection())
    before, now = demonstrations.load(folder, 0.05, 0), learned(recipe, 0)
    assert now.sha256 == before.sha256 and now.train.equal(before.train)


@pytest.mark.parametrize(
    ("texts", "tasks", "says"),
    [
        (texts_of("libero/goal"), ("libero/goal", "libero/10"), "no episode of 'libero/10' in"),
        (["a", "b"], ("libero/goal", "libero/10"), "for 'libero/goal' and other tasks"),
        # 90-20 turns on a stove, too, in another scene; so does goal-7.
        (texts_of("libero/goal", "libero/90"), ("libero/goal",), "'libero/90-20' and"),
        (texts_of("libero/90"), ("libero/90-20",), "both 'libero/90-44' and"),
        (texts_of("libero/goal"), ("libero/90-20",), "both 'libero/goal-7' and"),
    ],
)
def test_what_cannot_be_told_apart_is_refused_before_anything_is_decoded(
    texts: list[str],
    tasks: tuple[str, ...],
    says: str,
    make: Make,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("check", "check_recordable"):
        monkeypatch.setattr(robots.sim, name, lambda task: None)  # which would need LIBERO
    monkeypatch.setattr(robot_demos, "load", lambda *_: pytest.fail("a set was read"))
    demos = RobotDemos(paths=str(libero(tmp_path / "d", texts)))
    recipe = dataclasses.replace(make(), tasks=tasks, demos=demos)
    with pytest.raises(AegisError, match=says) as caught:
        robots.build(recipe, tmp_path / "run")
    assert "demos.only" in caught.value.fix


def test_a_set_of_some_suites_is_told_apart_from_scenes_of_others(tmp_path: Path) -> None:
    """`turn on the stove` also occurs in libero/90, of which this set has nothing."""
    texts = texts_of("libero/goal", "libero/10")
    folder = libero(tmp_path / "d", texts)
    for task in ("libero/goal", "libero/goal-7", "libero/10-5"):
        found = taken(stream([task], folder), 0)
        assert {texts[number] for number in found} == {*table.instructions(task)}


def test_of_a_dataset_on_the_hub_only_the_tasks_files_are_downloaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = texts_of("libero/goal", "libero/object", each=1)
    repository = as_version_2(libero(tmp_path / "d", texts), "v2.1")
    hub = DatasetHub("lab/libero", repository, tmp_path / "snapshot")
    monkeypatch.setattr("huggingface_hub.snapshot_download", hub.snapshot)
    monkeypatch.chdir(tmp_path)
    recipe = stream(("libero/goal", "libero/object"), Path("lab/libero"))
    found = learned(recipe, 1)
    own = [i for i, text in enumerate(texts) if text in table.instructions("libero/object")]
    assert found.episode_of[found.read].unique().tolist() == own
    here = {int(path.stem.removeprefix("episode_")) for path in hub.local.glob("data/*/*.parquet")}
    assert here == {*own} and found.datasets == ("lab/libero",)


@pytest.mark.parametrize("cache", [True, False])
def test_words_are_read_before_frames_which_may_stay_in_their_videos(
    cache: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a run of one task; words that only other tasks have are not read."""
    folder = libero(tmp_path / "d", texts_of("libero/goal", "libero/object"), as_video=True)
    recipe = stream(("libero/goal", "libero/object"), folder, cache=cache)
    frames = learned(recipe, 0).frames
    assert isinstance(frames[0], FramesOnDemand) != cache
    monkeypatch.setattr(demonstrations.camera_frames, "load", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(demonstrations.camera_frames, "video_parts", lambda *_: pytest.fail("read"))

    def knows_objects(text: str) -> None:
        if "basket" not in text:
            raise AegisError(f"'{text}'", "known words", "others")

    backbone = cast(Backbone, SimpleNamespace(image_size=None, check_prompt=knows_objects))
    with pytest.raises(AegisError, match="'open|'put|'push|'turn"):
        robot_demos.load(recipe, 0, backbone, Path("unused"), ignore)
    with pytest.raises(pytest.fail.Exception):
        robot_demos.load(recipe, 1, backbone, Path("unused"), ignore)


# --- chosen episodes ------------------------------------------------------------------------------


def test_each_task_takes_the_episodes_that_are_chosen_for_it(make: Make, tmp_path: Path) -> None:
    """As in a run of one task; the others' numbers do not affect any scale."""
    recipe = make()
    chosen = ("0-3", "2,5,4")
    recipe = dataclasses.replace(recipe, demos=dataclasses.replace(recipe.demos, only=chosen))
    built = train.build(recipe, tmp_path / "run")
    assert isinstance(built, robots.RobotStreamRun)
    for number, numbers in enumerate(([0, 1, 2, 3], [2, 4, 5])):
        found = built.demos[number]
        assert found.episode_of[found.read].unique().tolist() == numbers
        path = demonstrations.at(recipe.demos.of_task(number))
        alone = demonstrations.load(path, 0.05, 0, Selection(only=chosen[number]))
        assert alone.train.equal(found.train) and alone.validation.equal(found.validation)


def test_numbers_decide_where_instructions_do_not(tmp_path: Path) -> None:
    texts = texts_of("libero/90", each=1)
    folder = libero(tmp_path / "d", texts)
    said = [number for number, text in enumerate(texts) if text == "turn on the stove"]
    only = (",".join(map(str, said)),)
    assert taken(stream(["libero/90-20"], folder, only=only), 0) == said


def test_episodes_of_another_task_are_refused(tmp_path: Path) -> None:
    """As when `only` has the order of another recipe."""
    folder = libero(tmp_path / "d", [*table.instructions("libero/10"), *["any words"] * 10])
    recipe = stream(("libero/10", "libero/goal"), folder, only=("10-19", "0-9"))
    assert taken(recipe, 0) == list(range(10, 20))
    with pytest.raises(AegisError, match="for 'libero/goal'") as caught:
        learned(recipe, 1)
    assert "'libero/10-" not in caught.value.found and "libero/10-" in caught.value.expected


def test_other_episodes_do_not_continue_a_run(make: Make, tmp_path: Path) -> None:
    recipe = make("isolated-lora")
    part = dataclasses.replace(recipe, demos=dataclasses.replace(recipe.demos, only=("0-3", "0-3")))
    with pytest.raises(KeyboardInterrupt):
        train.run(part, tmp_path / "run", on_event=partial(stop, "task 2 point", 3))
    with pytest.raises(AegisError, match="other settings"):
        train.run(recipe, tmp_path / "run", resume=True)
    train.run(part, tmp_path / "run", resume=True)
    train.run(part, tmp_path / "whole")
    assert contents(tmp_path / "run") == contents(tmp_path / "whole")


# --- other names ----------------------------------------------------------------------------------


def test_cameras_are_known_by_their_new_names(tmp_path: Path) -> None:
    texts = texts_of("libero/goal", "libero/object")
    folder = libero(tmp_path / "d", texts, ("front", "hand"))
    both = ("image", "image2")
    tasks = ("libero/goal", "libero/object")
    with pytest.raises(AegisError, match="no camera 'image'"):
        learned(stream(tasks, folder, camera=both), 0)
    renamed = stream(tasks, folder, camera=both, rename={"front": "image", "hand": "image2"})
    found = learned(renamed, 1)
    assert found.cameras == ("observation.images.image", "observation.images.image2")
    assert set(found.texts) == {*table.instructions("libero/object")}


def test_a_run_acts_by_a_camera_that_was_renamed_away(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During training, and when it is loaded again."""
    monkeypatch.setattr(sim, "cameras", lambda name: ("top", "side"))
    load = demonstrations.load

    def seen_by(*given: Any, **options: Any) -> Demonstrations:
        found = load(*given, **options)
        return dataclasses.replace(found, cameras=("observation.images.camera1",))

    monkeypatch.setattr(demonstrations, "load", seen_by)
    monkeypatch.setattr(robot_demos.mixture, "check_rename", lambda *_: None)
    recipe = make("sequential", steps=1)
    demos = dataclasses.replace(recipe.demos, rename={"side": "camera1"})
    train.run(dataclasses.replace(recipe, demos=demos), tmp_path / "run")
    assert robots.load_policy(tmp_path / "run", "point").cameras == ("side",)


def test_a_name_that_no_set_has_is_refused(make: Make, tmp_path: Path) -> None:
    recipe = make()
    demos = dataclasses.replace(recipe.demos, rename={"elbwo": "elbow"})
    with pytest.raises(AegisError, match="'elbwo' in demos.rename"):
        train.build(dataclasses.replace(recipe, demos=demos), tmp_path / "run")


# --- recipes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "keys",
    [{"only": ("0-3", "0-3")}, {"only": ("4-6", "0-3")}, {"rename": {"a": "b"}}],
)
def test_what_is_chosen_tells_runs_and_cells_apart(keys: Mapping[str, Any], make: Make) -> None:
    """The digest of the files does not show it. Runs from before the key existed can resume."""
    plain = make()
    chosen = dataclasses.replace(plain, demos=dataclasses.replace(plain.demos, **keys))
    assert "demos" not in recipes.training_part(plain)
    assert recipes.training_part(chosen)["demos"] == keys
    of_both = [cell_key(Cell("x", made), "", ["a", "b"], {}) for made in (plain, chosen)]
    assert of_both[0] != of_both[1]


def test_a_cell_is_told_by_the_files_that_its_tasks_read(tmp_path: Path) -> None:
    """A set in which every episode has its own files."""
    texts = texts_of("libero/goal", "libero/object", each=1)
    folder = as_version_2(libero(tmp_path / "d", texts), "v2.1")
    runner = RobotStreamRunner(tmp_path / "study", ignore)
    tasks = ("libero/goal", "libero/object")
    of_each = [runner._digest(*robot_demos.given(stream(tasks, folder), i)) for i in (0, 1)]
    assert of_each == [learned(stream(tasks, folder), i).sha256 for i in (0, 1)]
    assert of_each[0] != of_each[1]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("demos.only=[0-3]",), "demos.only: 1 with 2 tasks"),
        (("demos.only=0-3",), "write 'demos.only: [0-3]'"),
        (("demos.only=[0, 1]",), "a list of words such as [a, b], not empty"),
        (("demos.only=[0-3, 0-9]",), "demos.only: episode 6 of"),
        (("demos.only=[0-3, libero/goal]",), "demos.only: libero/goal of"),
        (("demos.only=[0-3, 0-3]", "demos.paths=null"), "demos.only without demos.paths"),
        (("demos.rename={a: b}", "demos.paths=null"), "demos.rename without demos.paths"),
        (("demos.paths=[a, a, a]",), "demos.paths: 3 with 2 tasks"),
        (("demos.paths=a",), "no file or folder 'a'"),
    ],
)
def test_bad_recipes(
    settings: Sequence[str],
    says: str,
    make: Make,
    bad: Callable[..., None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot.yaml").write_text(recipes.to_yaml(make()), encoding="utf-8")
    changes = [word for setting in settings for word in ("--set", setting)]
    bad("train", "robot.yaml", "--out", "run", *changes, says=(says,))
    assert not Path("run").exists()


def test_one_set_for_all_and_chosen_parts_survive_a_recipes_file(
    make: Make, tmp_path: Path
) -> None:
    demos = RobotDemos(paths="d", only=("0-3", "5"), rename={"a": "b"}, cache=False)
    recipe = make(demos=demos)
    (tmp_path / "r.yaml").write_text(recipes.to_yaml(recipe), encoding="utf-8")
    assert recipes.load_training(tmp_path / "r.yaml") == recipe


def test_one_set_for_all_is_not_removed_with_the_run_that_it_lies_in(
    make: Make, tmp_path: Path
) -> None:
    made = make(tasks=("reach",))
    out = tmp_path / "run"
    out.mkdir()
    (out / "recipe.yaml").write_text(recipes.to_yaml(made), encoding="utf-8")
    inside = shutil.copy(made.demos.of_task(0), out / "d.safetensors")
    recipe = dataclasses.replace(made, demos=RobotDemos(paths=str(inside)))
    with pytest.raises(AegisError, match="d.safetensors' in the run"):
        train.run(recipe, out, overwrite=True)
    assert inside.is_file()


# --- a run of one task ----------------------------------------------------------------------------


@pytest.mark.parametrize("suite", [*SUITES, "libero/goal-3", "libero/all"])
def test_a_run_learns_a_suite_that_only_names(suite: str, tmp_path: Path) -> None:
    """And its held-out episodes are found again; without `only` it learns all."""
    texts = texts_of("libero/all", seed=4)
    folder = libero(tmp_path / "d", texts)
    found = demonstrations.load(folder, 0.3, 0, Selection(only=suite))
    own = [i for i, text in enumerate(texts) if text in table.instructions(suite)]
    assert found.episode_of[found.read].unique().tolist() == own
    assert demonstrations.learned_from(folder, len(texts), suite).tolist() == own
    assert demonstrations.is_one_of(folder, Selection(only=suite), {found.sha256})
    assert set(demonstrations.load(folder, 0.3, 0).texts) == set(texts)


def test_a_suite_that_is_not_there_is_no_choice_of_other_data(tmp_path: Path) -> None:
    folder = libero(tmp_path / "d", texts_of("libero/goal"))
    with pytest.raises(AegisError, match="no episode of 'libero/spatial'"):
        demonstrations.load(folder, 0.3, 0, Selection(only="libero/spatial"))
    assert not demonstrations.is_one_of(folder, Selection(only="libero/spatial"), {"x"})
    with pytest.raises(AegisError, match="libero/spatail"):
        demonstrations.load(folder, 0.3, 0, Selection(only="libero/spatail"))
