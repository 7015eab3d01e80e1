"""Several cameras of a LeRobot dataset: each frame is an image of the prompt, in order."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from samples.command import refused
from samples.lerobot import edit_info, episodes, frames, save
from samples.serving import Client, served
from samples.small_run import recipe as small
from samples.training_runs import assert_same_run

from aegis_cli import load_policy
from aegis_cli.anchors import measure
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Warned
from aegis_cli.data import demonstrations
from aegis_cli.data.lerobot import dataset, source
from aegis_cli.data.lerobot.write import NewEpisode
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import open_loop
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Anchor, Demos, Recipe
from aegis_cli.studies import pipeline
from aegis_cli.training import checkpoint, loading, train

pytestmark = pytest.mark.usefixtures("frame_cache")

BOTH = ("wrist", "top")  # not the dataset's own order
FULL = tuple(f"observation.images.{name}" for name in BOTH)
Made, Command = Callable[[str], Path], Callable[..., Any]


def recorded(count: int = 5) -> list[NewEpisode]:
    """Episodes with two cameras; the wrist's pictures are smaller."""
    made, small_ones = (
        episodes(count, ("top", "wrist"), (16, 24)),
        episodes(count, ("wrist",), (12, 12), seed=1),
    )
    short = [
        np.resize(e.frames["wrist"], (len(m.actions), 12, 12, 3))
        for m, e in zip(made, small_ones, strict=True)
    ]
    return [
        dataclasses.replace(e, frames=e.frames | {"wrist": wrist}, instruction="go to the red pad")
        for e, wrist in zip(made, short, strict=True)
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("demos") / "d", recorded())


# --- what is loaded -------------------------------------------------------------------------------


def test_a_row_holds_each_cameras_frame_in_the_order_asked_for(folder: Path) -> None:
    loaded, wanted = (
        demonstrations.load(folder, 0.3, 0, Selection(BOTH)),
        [frames(recorded(), name) for name in BOTH],
    )
    numbers = np.array([3, 0, 7])
    batch = loaded.batch(numbers, 2)
    assert loaded.cameras == FULL and len(batch.images) == 3
    for row, number in zip(batch.images, numbers, strict=True):
        assert [image.shape for image in row] == [(12, 12, 3), (16, 24, 3)]
        for image, camera in zip(row, wanted, strict=True):
            np.testing.assert_array_equal(image, camera[number])


@pytest.mark.parametrize("name", BOTH)
def test_a_list_of_one_is_that_one(name: str, folder: Path) -> None:
    one, listed = (
        demonstrations.load(folder, 0.3, 0, Selection(camera)) for camera in (name, (name,))
    )
    assert (
        one.sha256
        == listed.sha256
        == demonstrations.digest(folder, Selection(name))
        == demonstrations.digest(folder, Selection((name,)))
    )
    images = [d.batch(np.arange(4), 2).images for d in (one, listed)]
    assert isinstance(images[0], torch.Tensor) and torch.equal(*images)


def test_the_digest_knows_the_cameras_and_their_order(folder: Path) -> None:
    digests = [
        demonstrations.digest(folder, Selection(camera))
        for camera in ("top", "wrist", BOTH, BOTH[::-1])
    ]
    assert len(set(digests)) == 4
    found = dataset.load(folder)
    assert digests[:2] == source.digests(
        source.find(found), ["observation.images.top", "observation.images.wrist"]
    )
    assert demonstrations.load(folder, 0.3, 0, Selection(BOTH)).sha256 == digests[2]


def test_cameras_share_their_decoded_frames(folder: Path, frame_cache: Path) -> None:
    for camera in (BOTH, "top", "wrist", BOTH[::-1]):
        demonstrations.load(folder, 0.3, 0, Selection(camera))
    assert len(list((frame_cache / "frames").iterdir())) == 2


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (("top", "observation.images.top"), "'observation.images.top' twice"),
        (("top", "front"), "no camera 'front'"),
        (None, r"--set 'demos.camera=\[observation.images.top, observation.images.wrist\]'"),
    ],
)
def test_cameras_that_cannot_be(
    camera: str | tuple[str, ...] | None, says: str, folder: Path
) -> None:
    with pytest.raises(AegisError, match=says):
        demonstrations.load(folder, 0.3, 0, Selection(camera))


# --- a run ----------------------------------------------------------------------------------------


def settings(model: Path, folder: Path, **changes: Any) -> Recipe:
    return dataclasses.replace(small(model, **changes), demos=Demos(path=str(folder), camera=BOTH))


@pytest.fixture(scope="module")
def run(
    tmp_path_factory: pytest.TempPathFactory, folder: Path, hf_folder: Made, hf_anchor: Made
) -> Path:
    """A finished run of `aegis` on SmolVLM2 with both cameras; read-only."""
    out = tmp_path_factory.mktemp("runs") / "run"
    report = train.run(
        settings(hf_folder("smolvlm"), folder), "aegis", folder, hf_anchor("smolvlm"), out
    )
    assert report.cameras == list(FULL)
    return out


def test_what_was_seen_is_written_down(run: Path, aegis: Command) -> None:
    card = (checkpoint.last(run) / "backbone" / "README.md").read_text()
    assert f"seen by `{FULL[0]}`, then `{FULL[1]}`" in card and "None" not in card
    _, meta = checkpoint.load_policy(run)
    assert meta["cameras"] == list(FULL) and checkpoint.sizes_of(meta) == ((12, 12), (16, 24))
    assert load_policy(run).sizes == ((12, 12), (16, 24))
    code, out, err = aegis("inspect", run, "--json")
    assert code == 0 and json.loads(out)["facts"]["cameras"] == list(FULL), err


def test_the_policy_acts_on_both(run: Path, folder: Path) -> None:
    policy, _ = checkpoint.load_policy(run)
    batch = demonstrations.load(folder, 0.3, 0, Selection(BOTH)).batch(np.arange(3), 2)
    other = [(image, 255 - second) for image, second in batch.images]
    chunks = [
        policy.act(rows, batch.instructions, batch.proprio, torch.Generator().manual_seed(0))
        for rows in (batch.images, other)
    ]
    assert chunks[0].shape == (3, 20, 2) and not torch.equal(*chunks)


def test_the_policy_is_compared_with_what_both_have_seen(run: Path, folder: Path) -> None:
    of_run = open_loop.run(run, folder)
    assert of_run.split == open_loop.VALIDATION and len(of_run.episodes) == 1
    # A checkpoint alone knows its cameras too, but not which episodes were held out.
    with pytest.raises(AegisError, match="outside its run"):
        open_loop.run(copied(run / "checkpoints" / "last"), folder)


@pytest.mark.parametrize("smooth", [False, True])
def test_other_sizes_are_evaluated_in_those_of_training_as_a_deployed_policy_sees_them(
    smooth: bool, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For pictures that are decoded beforehand, and for videos that are decoded on demand."""
    made = episodes(2, BOTH, (40, 30), smooth=smooth)
    known = [dataclasses.replace(e, instruction="go to the red pad") for e in made]
    data = save(tmp_path / "d", known, as_video=smooth)
    read = demonstrations.load(data, None, 0, Selection(BOTH), cache=False)
    assert [frames.shape[1:3] for frames in read.frames] == [(40, 30), (40, 30)]
    monkeypatch.setattr(Policy, "draw_noise", _one_noise)
    found = open_loop.run(run, data, batch_size=1, traced=True)
    assert found.split == open_loop.OTHER and len(found.traces) == 2
    own = load_policy(run)
    for trace in found.traces:
        first = int(read.tensors["episode_starts"][trace.episode])
        for start in range(0, len(trace.predicted), trace.replan):
            batch = read.batch(torch.tensor([first + start]), 1)
            seen = {n: p.numpy() for n, p in zip(FULL, batch.images[0], strict=True)}
            acted = own.predict_action_chunk(seen, "go to the red pad", batch.proprio[0].numpy())
            then = trace.predicted[start : start + trace.replan]
            np.testing.assert_array_equal(then, acted[: len(then)])


def _one_noise(policy: Policy, frames: int, _: torch.Generator) -> torch.Tensor:
    """The same noise for each frame, whoever asks for it and however often."""
    size = policy.expert.shape.chunk, len(policy.action_scale.mean)
    return torch.randn(size, generator=torch.Generator().manual_seed(0)).expand(frames, *size)


def copied(checkpoint_folder: Path) -> Path:
    """A checkpoint taken out of its run."""
    out = checkpoint_folder.parent.parent.parent / "taken"
    shutil.copytree(checkpoint_folder, out)
    return out


def test_a_client_sends_a_picture_of_each(run: Path, folder: Path) -> None:
    made = recorded()[0]
    pictures = {name: made.frames[name][0] for name in BOTH}
    seen = {f"observation/{name}": picture for name, picture in pictures.items()}
    seen |= {"observation/state": made.state[0], "prompt": made.instruction}
    with served(load_policy(run)) as serving, Client(serving.url) as client:
        assert client.metadata["images"] == [f"observation/{name}" for name in BOTH]
        found = client.infer(seen)["actions"]
    named = dict(zip(FULL, pictures.values(), strict=True))
    own = load_policy(run).predict_action_chunk(named, made.instruction, made.state[0])
    np.testing.assert_array_equal(found, own)


def test_a_simulated_task_has_one_camera(run: Path, aegis: Command) -> None:
    err = refused(aegis("rollout", run, "--task", "reach", "--episodes", 1))
    assert "trained on 2 cameras: " + ", ".join(FULL) in err and "--set demos.camera=" in err


def test_a_resumed_run_ends_in_the_same_bytes(
    run: Path, folder: Path, hf_folder: Made, hf_anchor: Made, tmp_path: Path, aegis: Command
) -> None:
    def stop(event: Any) -> None:
        if event.stage == "train" and event.done == 2:
            raise KeyboardInterrupt

    given = (
        settings(hf_folder("smolvlm"), folder),
        "aegis",
        folder,
        hf_anchor("smolvlm"),
        tmp_path / "run",
    )
    with pytest.raises(KeyboardInterrupt):
        train.run(*given, on_event=stop)
    turned = dataclasses.replace(given[0], demos=Demos(path=str(folder), camera=BOTH[::-1]))
    with pytest.raises(AegisError, match="demos.camera"):
        train.run(turned, *given[1:], resume=True)
    train.run(*given, resume=True)
    assert_same_run(run, tmp_path / "run")


@pytest.mark.parametrize(
    ("camera", "warns"),
    [(BOTH, False), (BOTH[::-1], True), ("top", True)],
)
def test_an_anchor_of_other_cameras_frames_is_warned_of(
    camera: str | tuple[str, ...], warns: bool, folder: Path, hf_folder: Made, tmp_path: Path
) -> None:
    model, anchor = hf_folder("smolvlm"), tmp_path / "anchor.safetensors"
    frames = Anchor(samples=30, source="demos", parts=("moments",))
    measure.run(str(model), frames, anchor, demos=folder, selection=Selection(camera))
    told: list[Event] = []
    given = (settings(model, folder, steps=1), "aegis", folder, anchor, tmp_path / "run")
    train.run(*given, on_event=told.append)
    said = [event.text for event in told if isinstance(event, Warned)]
    asked = f"--demos {folder} --camera {FULL[0]} --camera {FULL[1]}"
    assert len(said) == warns and all(asked in text for text in said)


@pytest.mark.parametrize(
    ("meta", "shown", "warns"),
    [
        ({"vqa": "scenes"}, FULL, False),  # a question has one image
        ({"demos": "d"}, FULL, True),
        ({"demos": "d"}, FULL[:1], False),
        ({"demos": "d"}, (), False),
        ({"demos": "d", "cameras": list(FULL)}, (), True),
        ({"demos": "d", "cameras": [FULL[0]]}, (), False),
        ({"demos": "d", "cameras": [FULL[0]]}, FULL[1:], True),
    ],
)
def test_of_one_camera_that_nobody_has_named_nothing_is_said(
    meta: dict[str, Any], shown: tuple[str, ...], warns: bool, tmp_path: Path
) -> None:
    anchor = tmp_path / "anchor.safetensors"
    names = [f"layers.0.{of}.{what}" for of in ("image", "text") for what in ("mean", "var")]
    moments = {name: torch.ones(3, dtype=torch.float64) for name in names}
    artifacts.save(anchor, "anchor", moments | {"count": torch.tensor([5, 5])}, meta=meta)
    told: list[Event] = []
    sets = Path("my demos"), Path("others")
    loading._warn_of_other_cameras(anchor, sets, shown, {"cam": "top"}, told.append)
    assert bool(told) is warns
    if told:
        assert "aegis anchor --demos 'my demos' " in told[0].text
        assert told[0].text.endswith("--rename cam=top")


def test_through_the_command_line(
    folder: Path, hf_folder: Made, tmp_path: Path, aegis: Command
) -> None:
    """The command that a user types: a list after --set; --dry-run says what each prompt shows."""
    path = tmp_path / "small.yaml"
    path.write_text(
        f"name: small\nbackbone: {hf_folder('qwen2_5_vl')}\ntrain: {{steps: 2, batch_size: 2, "
        f"warmup: 1}}\n"
    )
    given = ["train", path, "--demos", folder, "--out", tmp_path / "run", "--json", "--dry-run"]
    plans = []
    for camera in ("top", "[wrist, top]"):
        code, out, err = aegis(*given, "--set", f"demos.camera={camera}")
        assert code == 0, err
        plans.append(json.loads(out))
    assert [plan["cameras"] for plan in plans] == [[FULL[1]], list(FULL)]
    assert plans[1]["tokens_per_frame"] > plans[0]["tokens_per_frame"]
    assert "cameras" in refused(aegis(*given)) and not (tmp_path / "run").exists()


def test_a_whole_run_of_a_simulated_task_seen_by_two_cameras_is_not_rolled_out(
    folder: Path, hf_folder: Made, tmp_path: Path
) -> None:
    made = save(tmp_path / "d", recorded(4))
    edit_info(made, lambda info: info.update(robot_type="aegis/reach"))
    (row,) = pipeline.run(
        settings(hf_folder("smolvlm"), made, methods=("naive",)), tmp_path / "runs"
    ).rows
    assert row.success_seen is None and row.accuracy >= 0
    report = json.loads((tmp_path / "runs/small/naive/train.json").read_text())
    assert report["cameras"] == list(FULL)
    header = artifacts.read_header(
        tmp_path / "runs/small/naive/checkpoints/last/expert.safetensors"
    )
    assert header.meta["task"] == "reach" and header.meta["cameras"] == list(FULL)
