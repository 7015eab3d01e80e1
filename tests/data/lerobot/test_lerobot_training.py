"""LeRobot folders as demonstrations: the same training as from a file, whatever the decoding."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from samples.command import refused
from samples.lerobot import (
    STATE,
    data_files,
    edit_info,
    edit_table,
    episodes,
    frames,
    joined,
    replaced,
    save,
)
from samples.small_run import recipe as small_recipe
from samples.training_runs import (
    STEPS,
    Start,
    assert_same_run,
    metrics,
    stop_at,
)

from aegis_cli.common import artifacts, cache, prefetch
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Event, Progress, Warned
from aegis_cli.data import demonstrations, record
from aegis_cli.data.batch import Normalizer
from aegis_cli.data.demonstrations import Demonstrations
from aegis_cli.data.lerobot import frames as camera_frames
from aegis_cli.data.lerobot import video
from aegis_cli.data.lerobot.on_demand import FramesOnDemand
from aegis_cli.data.lerobot.write import Limits
from aegis_cli.data.selection import Selection
from aegis_cli.evaluation import open_loop, results
from aegis_cli.recipes import Demos, Recipe
from aegis_cli.studies import pipeline
from aegis_cli.training import checkpoint, train

pytestmark = pytest.mark.usefixtures("frame_cache")

BOTH = ("top", "wrist")


@pytest.fixture(scope="session")
def reach_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The episodes of `demos_file` as a LeRobot dataset."""
    path = tmp_path_factory.mktemp("demos") / "reach"
    record.run("reach", 8, 0, path, workers=1, form="lerobot")
    return path


# --- what is loaded ------------------------------------------------------------------------------


def test_a_folder_and_a_file_of_the_same_episodes_give_the_same_batches(
    reach_folder: Path, demos_file: Path
) -> None:
    folder, file = (
        demonstrations.load(path, 0.3, 0, image_size=64) for path in (reach_folder, demos_file)
    )
    assert folder.task == file.task == "reach"
    assert torch.equal(folder.train, file.train) and torch.equal(folder.validation, file.validation)
    for step in range(5):
        numbers = np.random.default_rng(step).integers(0, len(file.episode_of), 16)
        one, other = (d.batch(numbers, 6) for d in (folder, file))
        assert one.instructions == other.instructions and one.is_pad.any() and not one.is_pad.all()
        for name in ("images", "proprio", "actions", "is_pad"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_chunks_stop_at_an_episodes_end(tmp_path: Path) -> None:
    made = episodes(6)
    loaded = demonstrations.load(save(tmp_path / "d", made), 0.3, 0)
    actions = joined(made)[1]
    ends = np.cumsum([len(e.actions) for e in made])
    for number in range(len(actions)):
        end = int(ends[ends > number][0])
        batch = loaded.batch(np.array([number]), 5)
        valid = min(5, end - number)
        assert batch.is_pad[0].tolist() == [False] * valid + [True] * (5 - valid)
        np.testing.assert_array_equal(batch.actions[0, :valid], actions[number : number + valid])


def test_an_episodes_text_may_change_from_frame_to_frame(tmp_path: Path) -> None:
    folder = save(tmp_path / "d", episodes(4))
    count = len(demonstrations.load(folder, 0.3, 0).episode_of)
    texts = pa.array(np.arange(count) % 3)
    edit_table(data_files(folder)[0], lambda table: replaced(table, "task_index", texts))
    loaded = demonstrations.load(folder, 0.3, 0)
    assert loaded.batch(np.arange(6), 2).instructions == [
        loaded.instructions[i % 3] for i in range(6)
    ]


def test_a_rate_may_be_off_a_little_and_a_recording_may_have_gaps(tmp_path: Path) -> None:
    folder = save(tmp_path / "d", episodes(4))
    edit_info(folder, lambda info: info.update(fps=10.9))
    path = data_files(folder)[0]
    edit_table(path, lambda t: replaced(t, "timestamp", _with_a_gap(t["timestamp"])))
    assert demonstrations.load(folder, 0.3, 0).fps == 10.9


def _with_a_gap(column: pa.ChunkedArray) -> pa.Array:
    """The times of an episode's first five frames; the last one is a second later."""
    times = column.to_numpy().copy()
    times[4] += 1
    return pa.array(times)


def test_episodes_without_an_instruction_are_told_before_they_are_learned_from(
    tmp_path: Path, tiny_folder: Path
) -> None:
    def warned(folder: Path, **demos: Any) -> list[str]:
        said: list[Event] = []
        recipe = replace(small_recipe(tiny_folder, steps=1), demos=Demos(**demos))
        train.run(recipe, "naive", folder, None, tmp_path / "run", False, said.append, True)
        return [event.text for event in said if isinstance(event, Warned)]

    texts = ("go to the red target", "", " \t", "go to the red target", "", "go to the red target")
    made = [replace(e, instruction=t) for e, t in zip(episodes(6), texts, strict=True)]
    folder = save(tmp_path / "d", made)
    (said,) = warned(folder)
    assert f"3 of the 6 episodes to learn from in '{folder}'" in said and "demos.only" in said
    (said,) = warned(folder, only="0,2-3")
    assert "1 of the 3 episodes" in said
    assert warned(folder, only="0,3,5") == []


@pytest.mark.parametrize("as_video", [False, True])
def test_the_camera_that_was_asked_for(as_video: bool, tmp_path: Path) -> None:
    made = episodes(4, BOTH, (16, 16), smooth=True)
    folder = save(tmp_path / "d", made, as_video=as_video)
    for camera in (*BOTH, "observation.images.wrist"):
        loaded = demonstrations.load(folder, 0.3, 0, Selection(camera))
        expected = frames(made, camera.removeprefix("observation.images."))
        np.testing.assert_allclose(
            loaded.frames[0].double().mean((1, 2)),
            expected.mean((1, 2)),
            atol=12 * as_video,
        )
    assert demonstrations.digest(folder, Selection("top")) != demonstrations.digest(
        folder, Selection("wrist")
    )


@pytest.mark.parametrize(
    "name",
    ["data/chunk-000/file-000.parquet", "videos/observation.images.top/chunk-000/file-000.mp4"],
)
def test_the_digest_is_of_every_file_that_is_read(name: str, tmp_path: Path) -> None:
    folder = save(tmp_path / "d", episodes(4, BOTH, (16, 16), smooth=True), as_video=True)
    before = [demonstrations.digest(folder, Selection(camera)) for camera in BOTH]
    if name.startswith("data"):
        edit_table(folder / name, lambda table: replaced(table, "timestamp", table["timestamp"]))
    else:
        (folder / name).write_bytes((folder / name).read_bytes() + b"0")
    after = [demonstrations.digest(folder, Selection(camera)) for camera in BOTH]
    assert before[0] != after[0] and (before[1] == after[1]) == name.startswith("videos")


def test_frames_keep_their_size_unless_the_backbone_has_one(tmp_path: Path) -> None:
    made = episodes(3)
    folder = save(tmp_path / "d", made)
    np.testing.assert_array_equal(demonstrations.load(folder, 0.3, 0).frames[0], frames(made))
    assert demonstrations.load(folder, 0.3, 0, image_size=64).frames[0].shape[1:] == (
        64,
        64,
        3,
    )


# --- the cache -----------------------------------------------------------------------------------


@pytest.mark.parametrize("as_video", [False, True])
def test_the_number_of_workers_changes_nothing(
    as_video: bool, tmp_path: Path, frame_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_frames, "_PART", 8)
    folder, kept = (
        save(tmp_path / "d", episodes(8, size=(16, 16), smooth=True), as_video=as_video),
        [],
    )
    for workers in (1, 2):
        demonstrations.load(folder, 0.3, 0, workers=workers)
        (file,) = (frame_cache / "frames").iterdir()
        kept.append(file.read_bytes())
        file.unlink()
    assert kept[0] == kept[1]


def test_frames_are_decoded_once(
    tmp_path: Path, frame_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = save(tmp_path / "d"), []
    loaded = demonstrations.load(folder, 0.3, 0, on_event=events.append)
    frames = len(loaded.episode_of)
    told = [(e.stage, e.done, e.total) for e in events]
    assert told == [("decode top", 0, frames), ("decode top", frames, frames)]
    monkeypatch.setattr(camera_frames, "_write", lambda *_: pytest.fail("decoded again"))
    again = demonstrations.load(folder, 0.3, 1, on_event=events.append)
    assert torch.equal(again.frames[0], loaded.frames[0]) and len(events) == 2
    assert len(list((frame_cache / "frames").iterdir())) == 1


@pytest.mark.parametrize("frame", [0, -1])
def test_a_cache_of_other_frames_is_refused(frame: int, tmp_path: Path, frame_cache: Path) -> None:
    folder = save(tmp_path / "d")
    demonstrations.load(folder, 0.3, 0)
    (file,) = (frame_cache / "frames").iterdir()
    frames = np.load(file)
    frames[frame] = 255 - frames[frame]
    np.save(file, frames)
    with pytest.raises(AegisError, match="are not those of") as caught:
        demonstrations.load(folder, 0.3, 0)
    assert caught.value.fix == f"rm '{file}'"


def test_other_frames_and_another_size_are_other_files(tmp_path: Path, frame_cache: Path) -> None:
    for number, (seed, size) in enumerate([(0, None), (1, None), (1, 64)]):
        demonstrations.load(
            save(tmp_path / f"{number}", episodes(seed=seed)), 0.3, 0, image_size=size
        )
    assert len(list((frame_cache / "frames").iterdir())) == 3


@pytest.mark.parametrize("as_video", [False, True])
def test_words_about_the_same_pictures_decode_nothing_again(
    as_video: bool, tmp_path: Path, frame_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of info.json, and beside a video also the tasks' texts and the actions."""
    folder = save(tmp_path / "d", episodes(smooth=True), as_video=as_video)
    before = demonstrations.load(folder, 0.3, 0)

    def rename(table: pa.Table) -> pa.Table:
        texts = [f"please {text}" for text in table.column("task").to_pylist()]
        return replaced(table, "task", pa.array(texts))

    def act(table: pa.Table) -> pa.Table:
        rows = [[0.5 for _ in row] for row in table.column("action").to_pylist()]
        return replaced(table, "action", pa.array(rows, table.schema.field("action").type))

    edit_info(folder, lambda info: info.update(robot_type="another arm", comment="corrected"))
    if as_video:
        edit_table(folder / "meta" / "tasks.parquet", rename)
        edit_table(data_files(folder)[0], act)
    monkeypatch.setattr(camera_frames, "_write", lambda *_: pytest.fail("decoded again"))
    after = demonstrations.load(folder, 0.3, 0)
    assert after.sha256 != before.sha256 and torch.equal(after.frames[0], before.frames[0])
    assert not as_video or after.instructions[0].startswith("please ")
    assert len(list((frame_cache / "frames").iterdir())) == 1


@pytest.mark.parametrize("change", ["pictures", "times", "starts"])
def test_other_pixels_under_the_same_words_are_decoded_anew(
    change: str, tmp_path: Path, frame_cache: Path
) -> None:
    made = episodes(smooth=True)
    folder = save(tmp_path / "d", made, as_video=True)
    demonstrations.load(folder, 0.3, 0)
    if change == "pictures":
        opposite = [
            replace(e, frames={name: 255 - shown for name, shown in e.frames.items()}) for e in made
        ]
        other = save(tmp_path / "other", opposite, as_video=True)
        shutil.rmtree(folder / "videos")
        shutil.copytree(other / "videos", folder / "videos")
    elif change == "times":
        edit_table(data_files(folder)[0], lambda table: shifted(table, "timestamp"))
    else:
        (table,) = (folder / "meta" / "episodes").rglob("*.parquet")
        edit_table(
            table, lambda found: shifted(found, "videos/observation.images.top/from_timestamp")
        )
    # Later by a tenth of a frame, a time is still that of the same frame.
    loaded = demonstrations.load(folder, 0.3, 0).frames[0].float()
    wanted = torch.from_numpy(frames(made)).float()
    wanted = 255 - wanted if change == "pictures" else wanted
    assert (loaded - wanted).abs().mean() < 4
    assert len(list((frame_cache / "frames").iterdir())) == 2


def shifted(table: pa.Table, name: str) -> pa.Table:
    """The table with the times of a column later by a tenth of a frame."""
    times = [time + 0.01 for time in table.column(name).to_pylist()]
    return replaced(table, name, pa.array(times, table.schema.field(name).type))


def test_decoded_frames_that_nobody_uses_any_more_are_removed(
    tmp_path: Path, frame_cache: Path
) -> None:
    """Using them does not count as writing them, for which a training that reads them would end."""
    long_ago = time.time() - 31 * 86_400
    folders = [save(tmp_path / name, episodes(seed=seed)) for seed, name in enumerate("abc")]
    demonstrations.load(folders[0], 0.3, 0)
    (unused,) = (frame_cache / "frames").iterdir()
    demonstrations.load(folders[1], 0.3, 0)
    (used,) = set((frame_cache / "frames").iterdir()) - {unused}
    for path in (unused, used):
        os.utime(path, (long_ago, long_ago))
    training = demonstrations.load(folders[1], 0.3, 0)
    demonstrations.load(folders[1], 0.3, 0)
    training.check_files()
    demonstrations.load(folders[2], 0.3, 0)
    assert not unused.exists() and used.exists()
    demonstrations.load(folders[0], 0.3, 0)  # decoded again
    assert unused.exists()


def test_writing_to_loaded_frames_does_not_reach_the_disk(tmp_path: Path) -> None:
    folder = save(tmp_path / "d")
    demonstrations.load(folder, 0.3, 0).frames[0].zero_()
    assert demonstrations.load(folder, 0.3, 0).frames[0].any()


def test_decoding_that_stops_leaves_no_file(tmp_path: Path, frame_cache: Path) -> None:
    folder = save(tmp_path / "d")

    def stop(event: Event) -> None:
        if isinstance(event, Progress) and event.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        demonstrations.load(folder, 0.3, 0, on_event=stop)
    assert not list((frame_cache / "frames").iterdir())


def test_a_cache_that_cannot_be_is_one_error(
    tmp_path: Path, frame_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = save(tmp_path / "d")
    demonstrations.load(folder, 0.3, 0)
    (file,) = (frame_cache / "frames").iterdir()
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(AegisError, match=f"rm '{file}'"):
        demonstrations.load(folder, 0.3, 0)
    file.unlink()
    usage = camera_frames.shutil.disk_usage(tmp_path)._replace(free=10)
    with monkeypatch.context() as patch:
        patch.setattr(camera_frames.shutil, "disk_usage", lambda _: usage)
        with pytest.raises(AegisError, match="AEGIS_CACHE") as full:
            demonstrations.load(folder, 0.3, 0)
    assert "0.00 MB free" in full.value.found and not full.value.expected.startswith("0.00 MB")
    (tmp_path / "file").touch()
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "file"))
    with pytest.raises(AegisError, match="cannot create the folder") as nowhere:
        demonstrations.load(folder, 0.3, 0)
    assert "set AEGIS_CACHE" in nowhere.value.fix


# --- frames on demand ----------------------------------------------------------------------------


@pytest.fixture
def filmed(tmp_path: Path) -> Path:
    """Videos of two cameras, each in several files with several episodes."""
    made = episodes(9, BOTH, (16, 32), smooth=True)
    return save(tmp_path / "d", made, Limits(video_mb=0), as_video=True)


@pytest.mark.parametrize("side", [None, 24])
def test_frames_on_demand_are_those_of_the_cache(
    side: int | None, filmed: Path, frame_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video, "_KEPT_OPEN", 2)  # fewer than there are, so some are opened again
    asked = demonstrations.load(filmed, 0.3, 0, Selection(BOTH), side, cache=False)
    assert not (frame_cache / "frames").exists() and len(set(filmed.rglob("*.mp4"))) > 4
    kept = demonstrations.load(filmed, 0.3, 0, Selection(BOTH), side)
    assert [frames.shape for frames in asked.frames] == [frames.shape for frames in kept.frames]
    rng = np.random.default_rng(0)
    for _ in range(8):
        numbers = rng.integers(0, len(kept.episode_of), 16)  # in any order, some repeated
        one, other = asked.batch(numbers, 3), kept.batch(numbers, 3)
        for seen, wanted in zip(one.images, other.images, strict=True):
            assert all(torch.equal(*pair) for pair in zip(seen, wanted, strict=True))
    assert asked.sha256 == kept.sha256 and torch.equal(asked.train, kept.train)


def test_frames_on_demand_are_the_same_for_every_thread(filmed: Path) -> None:
    asked = demonstrations.load(filmed, 0.3, 0, Selection("top"), cache=False)
    rows = [torch.randperm(len(asked.episode_of)) for _ in range(12)]
    wanted = [asked.images(numbers) for numbers in rows]
    with ThreadPoolExecutor(4) as threads:
        for seen, like in zip(threads.map(asked.images, rows), wanted, strict=True):
            assert torch.equal(seen, like)


def test_frames_that_are_kept_already_are_not_decoded_again(
    filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = demonstrations.load(filmed, 0.3, 0, Selection("top"))
    monkeypatch.setattr(video, "_open", lambda path: pytest.fail(f"opened {path}"))
    monkeypatch.setattr(camera_frames, "_check_some", lambda *_: None)
    asked = demonstrations.load(filmed, 0.3, 0, Selection("top"), cache=False)
    assert torch.equal(asked.frames[0], kept.frames[0])


def test_pictures_in_data_files_are_kept_whatever_was_asked_for(
    tmp_path: Path, frame_cache: Path
) -> None:
    demonstrations.load(save(tmp_path / "d"), 0.3, 0, cache=False)
    assert len(list((frame_cache / "frames").iterdir())) == 1


def test_a_video_that_changes_while_frames_are_asked_for_ends_the_training(
    filmed: Path, tmp_path: Path
) -> None:
    """Its frames would be different, under the digest of the first ones."""
    demos = demonstrations.load(filmed, 0.3, 0, Selection(BOTH), cache=False)
    demos.check_files()
    first, *_, last = sorted(filmed.rglob("*.mp4"))
    shutil.copyfile(first, tmp_path / "other.mp4")
    (tmp_path / "other.mp4").rename(last)  # like a tool that writes a new file and renames it
    with pytest.raises(AegisError, match=f"{last.name}' was written to"):
        demos.check_files()
    last.unlink()
    with pytest.raises(AegisError, match="no file"):
        demos.check_files()


@pytest.mark.parametrize("damage", ["removed", "cut"])
def test_a_video_that_is_damaged_is_one_error(damage: str, filmed: Path) -> None:
    demos = demonstrations.load(filmed, 0.3, 0, Selection("top"), cache=False)
    last = sorted(filmed.glob("videos/*top/**/*.mp4"))[-1]
    if damage == "cut":
        last.write_bytes(last.read_bytes()[:40])
    else:
        last.unlink()
    with pytest.raises(AegisError, match="no file|is damaged"):
        demos.images(torch.tensor([0, len(demos.episode_of) - 1]))


def test_a_full_disk_is_told_of_frames_on_demand(
    filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = camera_frames.shutil.disk_usage(filmed)._replace(free=10)
    monkeypatch.setattr(camera_frames.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(AegisError, match="--set demos.cache=false"):
        demonstrations.load(filmed, 0.3, 0, Selection("top"))


def test_frames_stay_in_their_videos_where_the_disk_has_little_room(
    filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless they are cached already; by default they take up to a quarter of the free space."""
    selection, events = Selection("top"), list[Event]()

    def loaded(free: int) -> Demonstrations:
        del events[:]
        usage = shutil.disk_usage(filmed)._replace(free=free)
        with monkeypatch.context() as patch:
            patch.setattr(camera_frames.shutil, "disk_usage", lambda _: usage)
            return demonstrations.load(
                filmed, 0.3, 0, selection, cache=None, on_event=events.append
            )

    first = loaded(10**9)
    needed = first.frames[0].numel()
    shutil.rmtree(cache.folder("frames"))
    asked = loaded(4 * needed - 4)
    (warned,) = [event for event in events if isinstance(event, Warned)]
    assert "stay in its videos" in warned.text and "--set demos.cache=true" in warned.text
    assert isinstance(asked.frames[0], FramesOnDemand)
    decoded = loaded(4 * needed)
    assert isinstance(decoded.frames[0], torch.Tensor)
    kept = loaded(10)
    assert isinstance(kept.frames[0], torch.Tensor)
    assert not [event for event in events if isinstance(event, Warned)]
    rows = torch.arange(3)
    for one, other in zip(asked.images(rows), kept.images(rows), strict=True):
        assert np.array_equal(one, other)


def test_a_run_of_frames_on_demand_has_the_weights_of_one_of_kept_ones(
    start: Start, recipe: Recipe, frame_cache: Path, tmp_path: Path
) -> None:
    """It can also be resumed with them."""
    film = tmp_path / "film"
    record.run("reach", 8, 0, film, workers=1, form="lerobot", as_video=True)
    asked = replace(recipe, demos=Demos(cache=False))
    start("naive", tmp_path / "asked", demos=film, recipe=asked)
    assert not (frame_cache / "frames").exists()
    with pytest.raises(KeyboardInterrupt):
        stop = stop_at(2, KeyboardInterrupt())
        start("naive", tmp_path / "kept", demos=film, on_event=stop)
    start("naive", tmp_path / "kept", demos=film, recipe=asked, resume=True)
    one, other = weights(tmp_path / "asked"), weights(tmp_path / "kept")
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


# --- prefetch ------------------------------------------------------------------------------------


def test_results_come_in_order_and_are_fetched_ahead() -> None:
    fetched: list[int] = []
    with prefetch.ahead(lambda i: fetched.append(i) or i * i, range(10)) as results:
        assert next(results) == 0
        taken = [0, *results]
    assert taken == [i * i for i in range(10)] and fetched == list(range(10))


def test_fetching_takes_one_core_and_leaves_the_work_its_own() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with prefetch.ahead(lambda _: torch.get_num_threads(), range(5)) as results:
            assert list(results) == [1] * 5 and torch.get_num_threads() == 3
        with ThreadPoolExecutor(1) as later:
            assert later.submit(torch.get_num_threads).result() == 3
    finally:
        torch.set_num_threads(before)


def test_no_more_is_fetched_ahead_than_said(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    class Counting(ThreadPoolExecutor):
        def submit(self, fetch: Any, index: int) -> Any:  # type: ignore[override]
            asked.append(index)
            return super().submit(fetch, index)

    monkeypatch.setattr(prefetch, "ThreadPoolExecutor", Counting)
    with pytest.raises(KeyboardInterrupt), prefetch.ahead(lambda i: i, range(1000)) as results:
        assert [next(results), next(results)] == [0, 1]
        raise KeyboardInterrupt
    assert asked == list(range(2 + prefetch.DEPTH))


def test_several_threads_work_at_once_and_their_results_keep_their_order() -> None:
    together = threading.Barrier(3, timeout=60)

    def met(index: int) -> int:
        together.wait()  # this returns only once all three are here
        return index

    with prefetch.ahead(met, range(9), depth=3, workers=3) as results:
        assert list(results) == list(range(9))


def test_one_pipeline_feeds_another() -> None:
    with (
        prefetch.ahead(lambda i: i * i, range(20), 4, workers=4) as squares,
        prefetch.ahead(lambda i: (i, next(squares)), range(20), 1) as pairs,
    ):
        assert [next(pairs) for _ in range(5)] == [(i, i * i) for i in range(5)]


def test_an_error_comes_out_in_its_turn() -> None:
    with prefetch.ahead(lambda i: 1 // (2 - i), range(9)) as results:
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(ZeroDivisionError):
            next(results)


# --- training ------------------------------------------------------------------------------------


def weights(run: Path) -> dict[str, Any]:
    last = run / "checkpoints" / "last"
    return (
        artifacts.load(last / "expert.safetensors").tensors
        | artifacts.load(last / "backbone/model.safetensors").tensors
    )


def test_training_from_a_folder_is_training_from_a_file(
    start: Start, reach_folder: Path, naive_run: Path, tmp_path: Path
) -> None:
    start("naive", tmp_path / "run", demos=reach_folder)
    one, other = weights(tmp_path / "run"), weights(naive_run)
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("done", [1, 4])
def test_an_interrupted_run_goes_on_to_the_same_bytes(
    done: int, start: Start, reach_folder: Path, tmp_path: Path
) -> None:
    start("naive", tmp_path / "whole", demos=reach_folder)
    with pytest.raises(KeyboardInterrupt):
        start(
            "naive",
            tmp_path / "parts",
            demos=reach_folder,
            on_event=stop_at(done, KeyboardInterrupt()),
        )
    start("naive", tmp_path / "parts", demos=reach_folder, resume=True)
    assert_same_run(tmp_path / "whole", tmp_path / "parts")


def test_a_changed_dataset_is_not_trained_on_further(
    start: Start, reach_folder: Path, tmp_path: Path
) -> None:
    start("naive", tmp_path / "run", demos=reach_folder)
    record.run("reach", 8, 1, tmp_path / "other", workers=1, form="lerobot")
    with pytest.raises(AegisError, match="a different demos than the run"):
        start("naive", tmp_path / "run", demos=tmp_path / "other", resume=True)


def test_the_time_for_data_is_logged(start: Start, reach_folder: Path, tmp_path: Path) -> None:
    start("naive", tmp_path / "run", demos=reach_folder)
    lines = metrics(tmp_path / "run")
    assert len(lines) == STEPS and all(0 <= line["data_s"] <= line["step_s"] for line in lines)


# --- normalisation -------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_quantiles_go_to_minus_one_and_one(scale: float) -> None:
    rows = torch.randn(1001, 3, generator=torch.Generator().manual_seed(0)) * scale + 5 * scale
    low, high = (torch.quantile(rows.double(), q, dim=0) for q in (0.01, 0.99))
    fitted = Normalizer.fit_quantiles(rows)
    torch.testing.assert_close(
        fitted(torch.stack([low, high]).float()), torch.tensor([[-1.0] * 3, [1.0] * 3])
    )
    lerobots = 2 * (rows.double() - low) / (high - low) - 1
    torch.testing.assert_close(fitted(rows).double(), lerobots, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(fitted.invert(fitted(rows)), rows)


def test_a_dimension_between_equal_quantiles_is_only_centred() -> None:
    rows = torch.zeros(1000, 1)
    rows[0] = 3.0
    assert Normalizer.fit_quantiles(rows)(rows).max() == 3


def test_quantiles_come_from_the_training_episodes_and_stay_with_the_expert(
    start: Start, recipe: Recipe, reach_folder: Path, tmp_path: Path
) -> None:
    settings = small_recipe(recipe.backbone, normalization="quantiles")
    start("naive", tmp_path / "run", demos=reach_folder, recipe=settings)
    loaded = demonstrations.load(reach_folder, settings.train.validation_share, settings.seed)
    actions = loaded.tensors["actions"][loaded.train].double().numpy()
    low, high = np.quantile(actions, 0.01, axis=0), np.quantile(actions, 0.99, axis=0)
    policy, meta = checkpoint.load_policy(tmp_path / "run")
    assert meta["normalization"] == "quantiles"
    np.testing.assert_allclose(
        policy.action_scale.invert(torch.tensor([[-1.0, -1.0], [1.0, 1.0]])), [low, high], atol=1e-6
    )
    other = loaded.scales("mean_std")[1]
    assert not torch.allclose(other.std, policy.action_scale.std)


# --- whole runs ----------------------------------------------------------------------------------


def test_a_recipe_names_its_demonstrations(tiny_folder: Path, tmp_path: Path) -> None:
    """A robot that Aegis does not simulate: its policy is trained, probed and evaluated open-loop.

    It is never rolled out. Its stages stay up to date until the data change.
    """
    folder = save(
        tmp_path / "d", [replace(e, instruction="go to the red pad") for e in episodes(4, BOTH)]
    )
    base = small_recipe(tiny_folder, ("naive",))
    given = replace(base, demos=Demos(path=str(folder), camera="wrist"))
    events: list[Event] = []
    report = pipeline.run(given, tmp_path / "runs", events.append)
    (row,) = report.rows
    assert (row.success_seen, row.success_held_out, row.wrong_target) == (
        None,
        None,
        None,
    ) and row.accuracy >= 0
    assert not any(e.stage == "demos" or "rollout" in e.stage for e in events)
    run = tmp_path / "runs" / "small" / "naive"
    alone = open_loop.run(run, folder)
    assert (row.open_loop_error, alone.split) == (alone.relative_error, "validation")
    assert row.hold_error is alone.hold_error is None  # these actions are not positions
    (kept,) = results.open_loops(run)
    assert kept.figures["relative_interval"] == alone.relative_interval
    progress = [e for e in events if isinstance(e, Progress)]
    ended = [e.metrics for e in progress if e.unit == "method" and e.done]
    assert [figures["open-loop error"] for figures in ended] == [row.open_loop_error]
    open_loop.run(run, folder, keep=True)
    assert results.open_loops(run) == [kept]  # measured again, with the same result
    events.clear()
    pipeline.run(given, tmp_path / "runs", events.append)
    work = {e.stage for e in events if e.unit not in ("method", "methods")}
    assert all("up to date" in stage or stage.endswith(("scenes", "probe")) for stage in work), work
    events.clear()
    pipeline.run(
        replace(base, demos=Demos(path=str(folder), camera="top")), tmp_path / "runs", events.append
    )
    assert {"naive/train", "naive/evaluate"} <= {e.stage for e in events}
    assert run.exists() and not list(run.parent.glob("naive.*"))  # all in the old run was ours


def test_the_open_loop_error_on_several_sets_is_the_mean_of_theirs(
    tiny_folder: Path, tmp_path: Path
) -> None:
    sets = [
        save(
            tmp_path / name,
            [
                replace(e, instruction="go to the red pad", actions=e.state)
                for e in episodes(4, seed=seed)
            ],
            action_names=STATE,
        )
        for seed, name in enumerate(("a", "b"))
    ]
    base = small_recipe(tiny_folder, ("naive",))
    given = replace(base, demos=Demos(path=tuple(map(str, sets))))
    (row,) = pipeline.run(given, tmp_path / "runs").rows
    run = tmp_path / "runs" / "small" / "naive"
    alone = [open_loop.run(run, data) for data in sets]
    errors = [found.relative_error for found in alone]
    assert None not in errors and len(set(errors)) == 2
    assert row.open_loop_error == pytest.approx(sum(errors) / 2)
    holds = [found.hold_error for found in alone]  # since these actions are positions
    assert None not in holds and row.hold_error == pytest.approx(sum(holds) / 2)
    assert len(results.open_loops(run)) == 2


def test_a_policy_of_no_simulated_task_plays_one_that_fits(
    aegis: Any, start: Start, reach_folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(reach_folder, tmp_path / "d")
    edit_info(tmp_path / "d", lambda info: info.update(robot_type="so101"))
    start("naive", tmp_path / "run", demos=tmp_path / "d")
    assert "--task reach" in refused(aegis("rollout", tmp_path / "run", "--episodes", 1))
    err = refused(aegis("rollout", tmp_path / "run", "--task", "point", "--episodes", 1))
    assert "6 positions and 2 actions for task 'point'" in err
    played = aegis("rollout", tmp_path / "run", "--task", "reach", "--episodes", 1, "--json")
    assert played[0] == 0 and json.loads(played[1])["task"] == "reach"
    assert "warning" not in played[2]  # its steps are as long as in training
    code, out, _ = aegis("inspect", tmp_path / "run", "--json")
    assert code == 0 and json.loads(out)["facts"]["task"] is None
