"""Actions relative to the robot's position: which ones, what is learned, what is predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.command import refused
from samples.lerobot import episodes, save
from samples.small_run import recipe as small_recipe
from samples.training import make_policy, robot_batch
from samples.training_runs import Start

from aegis_cli.common.errors import AegisError
from aegis_cli.core.continuation import Continued
from aegis_cli.data import demonstrations, relative
from aegis_cli.data.batch import Normalizer
from aegis_cli.data.relative import Origins
from aegis_cli.models.policy import Policy
from aegis_cli.publishing import export
from aegis_cli.training import checkpoint

NAMES = ("a.pos", "b.pos", "c.pos", "gripper.pos")
STATE, ACTION = ("x", "y", "z"), ("z", "x")
PLACES = (2, 0)  # of ACTION in STATE


# --- which position belongs to an action ----------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_an_action_belongs_to_the_position_of_its_name(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = [str(name) for name in rng.permutation([*NAMES, "torque"])]
    actions = [str(name) for name in rng.permutation(NAMES)[: rng.integers(1, 5)]]
    sizes = (len(actions), len(positions))
    found = relative.places(actions, positions, sizes, ())
    assert [positions[place] for place in found if place is not None] == actions


def test_words_leave_actions_absolute() -> None:
    found = relative.places(NAMES, NAMES, (4, 4), ["GRIPPER", "b."])
    assert found == (0, None, 2, None)


def test_nameless_actions_belong_to_positions_by_their_order() -> None:
    assert relative.places((), (), (3, 3), ()) == (0, 1, 2)


@pytest.mark.parametrize(
    ("actions", "positions", "absolute", "found"),
    [
        ((), ("x", "y"), (), "not all of which have names"),
        (("x", "y"), (), (), "not all of which have names"),
        (("x", "dy"), ("x", "y"), (), "no position is named dy"),
        (("x", "y"), ("x", "y"), ("hand",), "'hand', which is in no action's name"),
        (("x", "x"), ("x", "y"), (), "several actions or positions named 'x'"),
        (("x", "y"), ("x", "x"), ("y",), "several actions or positions named 'x'"),
    ],
)
def test_what_belongs_to_no_position_is_refused(
    actions: Sequence[str], positions: Sequence[str], absolute: Sequence[str], found: str
) -> None:
    with pytest.raises(AegisError, match=found):
        relative.places(actions, positions, (2, 2), absolute)


def test_nameless_ones_of_other_numbers_are_refused() -> None:
    with pytest.raises(AegisError, match="2 actions and 3 positions"):
        relative.places((), (), (2, 3), ())


@pytest.mark.parametrize("told", [[0], [0, 3], [0, -1], [0, True], [0, "x"], [0, 1.5], {"0": 1}])
def test_places_of_a_file_that_are_none_are_refused(told: Any) -> None:
    with pytest.raises(ValueError, match="relative"):
        relative.of_meta({"relative": told}, 2, 3)


def test_files_without_places_have_absolute_actions() -> None:
    assert relative.of_meta({}, 2, 3) == ()
    assert relative.of_meta({"relative": [2, None]}, 2, 3) == (2, None)


def test_words_without_relative_actions_are_refused(aegis: Any, tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text("kind: policy\nname: r\ntrain:\n  relative_exclude: [gripper]\n")
    said = refused(aegis("inspect", path))
    assert "relative_exclude: gripper" in said and "relative_actions: true" in said


# --- what is learned, and what comes out ----------------------------------------------------------


def relative_policy(places: relative.Places) -> Policy:
    plain = make_policy()
    scales = plain.proprio_scale, plain.action_scale
    return Policy(plain.backbone, plain.expert, *scales, places)


@pytest.mark.parametrize("places", [(0, 1), (2, 0), (None, 1), (1, None)])
def test_a_policy_learns_actions_less_their_positions_and_adds_these_again(
    places: relative.Places,
) -> None:
    plain, policy = make_policy(), relative_policy(places)
    batch = robot_batch()
    origins = torch.zeros(len(batch), 1, 2)
    for d, place in enumerate(places):
        if place is not None:
            origins[:, 0, d] = batch.proprio[:, place]
    shifted = replace(batch, actions=batch.actions - origins)
    encoding = plain.encode(batch.images, batch.instructions)
    losses = []
    for model, given in ((plain, shifted), (policy, batch)):
        generator = torch.Generator().manual_seed(0)
        losses.append(model.flow_loss(given, encoding, 2, generator))
    assert torch.equal(*losses)

    seen = batch.images, batch.instructions, batch.proprio
    noise = plain.draw_noise(len(batch), torch.Generator().manual_seed(1))
    absolute = plain.act_from(*seen, noise)
    assert torch.equal(policy.act_from(*seen, noise), absolute + origins)
    # So is the rest of a chunk that is continued after the robot has executed some of it.
    left = absolute[:, 1:] + 0.3
    held = plain.act_from(*seen, noise, Continued(left, 1))
    found = policy.act_from(*seen, noise, Continued(left + origins, 1))
    torch.testing.assert_close(found, held + origins)
    assert not torch.allclose(held, absolute)


def test_places_are_no_part_of_the_weights() -> None:
    """They are in the meta; a policy's file without them is unchanged."""
    assert relative_policy((0, None)).state_dict().keys() == make_policy().state_dict().keys()
    assert Origins()(torch.zeros(2, 3)) == 0


@pytest.mark.usefixtures("frame_cache")
@pytest.mark.parametrize("most", [10_000, 7])
@pytest.mark.parametrize("kind", ["mean_std", "quantiles"])
def test_the_scale_is_of_all_steps_of_the_training_chunks(
    kind: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If there are many frames, a sample of them is used."""
    monkeypatch.setattr(demonstrations, "_MOST_ROWS", most)
    folder = save(tmp_path / "d", episodes(6), state_names=STATE, action_names=ACTION)
    demos, chunk = demonstrations.load(folder, 0.3, 0), 3
    assert demos.relative_places(()) == PLACES
    every = max(1, -(-len(demos.train) * chunk // most))
    rows = []
    for frame in demos.train[::every].tolist():
        (end,) = demos.tensors["episode_starts"][demos.episode_of[frame] + 1][None].tolist()
        for step in range(frame, min(frame + chunk, end)):
            origin = demos.tensors["proprio"][frame][list(PLACES)]
            rows.append(demos.tensors["actions"][step] - origin)
    fit = {"mean_std": Normalizer.fit, "quantiles": Normalizer.fit_quantiles}[kind]
    expected, (_, found) = fit(torch.stack(rows)), demos.scales(kind, chunk, PLACES)
    assert torch.equal(found.mean, expected.mean) and torch.equal(found.std, expected.std)


# --- through runs ---------------------------------------------------------------------------------


@pytest.fixture
def arm(tmp_path: Path, frame_cache: Path) -> Path:
    made = [replace(e, instruction="go to the red pad") for e in episodes(4)]
    return save(tmp_path / "arm", made, state_names=STATE, action_names=ACTION)


@pytest.mark.parametrize("method", ["naive", "insulate"])
def test_a_run_and_what_is_exported_of_it_answer_the_same_absolute_actions(
    method: str, arm: Path, tiny_folder: Path, start: Start, tmp_path: Path
) -> None:
    wanted = small_recipe(tiny_folder, relative_actions=True, relative_exclude=("z",))
    run, out = tmp_path / "run", tmp_path / "out"
    start(method, run, demos=arm, recipe=wanted)
    policy, meta = checkpoint.load_policy(run)
    assert meta["relative"] == [None, 0] == list(policy.origins.places)

    export.run(run, out, "lerobot")
    exported, _ = checkpoint.load_policy(out)
    loaded = demonstrations.load(arm, 0.3, 0, image_size=policy.backbone.image_size)
    batch = loaded.batch(np.arange(3), 6)
    noise = policy.draw_noise(3, torch.Generator().manual_seed(0))
    seen = batch.images, batch.instructions, batch.proprio, noise
    answers = policy.act_from(*seen)
    assert torch.equal(exported.act_from(*seen), answers)
    plain = Policy(policy.backbone, policy.expert, policy.proprio_scale, policy.action_scale)
    torch.testing.assert_close(
        (answers - plain.act_from(*seen))[:, 0],
        torch.stack([torch.zeros(3), batch.proprio[:, 0]], dim=1),
    )


def test_an_expert_that_predicts_others_is_no_beginning(
    arm: Path, tiny_folder: Path, start: Start, tmp_path: Path
) -> None:
    absolute = small_recipe(tiny_folder, steps=1)
    start("naive", tmp_path / "first", demos=arm, recipe=absolute)
    begun = replace(absolute.expert, start=str(tmp_path / "first"))
    train = replace(absolute.train, relative_actions=True)
    with pytest.raises(AegisError, match="absolute actions, this training actions relative"):
        start(
            "naive",
            tmp_path / "second",
            demos=arm,
            recipe=replace(absolute, expert=begun, train=train),
        )
    assert not (tmp_path / "second" / "checkpoints").exists()


def test_the_files_of_an_absolute_policy_say_nothing_of_it(
    arm: Path, tiny_folder: Path, start: Start, tmp_path: Path
) -> None:
    start("naive", tmp_path / "run", demos=arm, recipe=small_recipe(tiny_folder, steps=1))
    export.run(tmp_path / "run", tmp_path / "out", "lerobot")
    assert "relative" not in checkpoint.load_policy(tmp_path / "out")[1]


def test_targets_for_other_threads_stay_on_the_cpu() -> None:
    """The policy itself may go to another device, here 'meta'."""
    policy = make_policy()
    policy.origins = Origins([1, None])
    batch = robot_batch(4)
    wanted, on_cpu = policy.targets(batch), policy.targets_on_cpu()
    policy.to("meta")
    torch.testing.assert_close(on_cpu(batch), wanted)
