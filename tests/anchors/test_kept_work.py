"""An interrupted anchor goes on, to the same bytes, and takes nothing that is of another one."""

from __future__ import annotations

import dataclasses
import os
import signal
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from samples import processes
from samples.kept_anchors import go_on_there
from samples.parallel_runs import MeasuringAgain, Waiting, run_together
from samples.second_device import POSSIBLE
from samples.tiny import make_tiny
from samples.vqa_files import picture, write_jsonl

from aegis_cli.anchors import kept_work, measure
from aegis_cli.anchors.kept_work import Work
from aegis_cli.anchors.second_moments import SecondMoments
from aegis_cli.common import cache, kept_tensors, version
from aegis_cli.common.events import Event, OnEvent, Progress, Warned, ignore
from aegis_cli.common.kept_tensors import Kept
from aegis_cli.common.ranks import Ranks
from aegis_cli.core import moment_sums
from aegis_cli.recipes import ANCHOR_PARTS
from aegis_cli.recipes import Anchor as Settings

GROUP = 60_000  # bytes of sums; the tiny model's make several groups
ALL = Settings(samples=12, batch_size=2, parts=ANCHOR_PARTS, tokens=0.5, fisher_samples=4)
FRAMES = Settings(samples=24, batch_size=4, parts=("moments",), source="demos")
CPU = torch.device("cpu")

Run = Callable[..., bytes]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps come in groups, and sums are kept after each batch."""
    monkeypatch.setattr(measure._PartMeasurement, "_memory", GROUP)
    monkeypatch.setattr(kept_work, "_EVERY_S", 0.0)
    monkeypatch.setattr(kept_work, "_TIMES", 0)


@pytest.fixture
def run(tiny_folder: Path, tmp_path: Path) -> Run:
    """Measure an anchor, and read its file and what its report alone has."""

    def measured(settings: Settings = ALL, on_event: OnEvent = ignore, **named: Any) -> bytes:
        out = tmp_path / "anchor.safetensors"
        torch.manual_seed(torch.seed())  # another process has another random state
        report = measure.run(str(tiny_folder), settings, out, on_event, **named)
        assert report.samples == settings.samples
        return out.read_bytes() + str(report.entropy).encode()

    return measured


@pytest.fixture(scope="module")
def whole(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of an anchor of which nothing is kept."""
    out = tmp_path_factory.mktemp("whole") / "anchor.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure._PartMeasurement, "_memory", GROUP)
        report = measure.run(str(tiny_folder), ALL, out, keep=False)
    return out.read_bytes() + str(report.entropy).encode()


def kept() -> list[Path]:
    folder = cache.folder("anchors")
    return sorted(folder.iterdir()) if folder.is_dir() else []


def interrupted(
    run: Run, patch: pytest.MonkeyPatch, after: int, settings: Settings = ALL, **named: Any
) -> int:
    """End an anchor when it has kept something so many times; how often it had, if it came so far.

    Returns:
        How often something was kept.
    """
    plain, written = kept_tensors.write, 0

    def write(path: Path, what: Kept) -> None:
        nonlocal written
        plain(path, what)
        written += 1
        if written == after:
            raise KeyboardInterrupt

    with patch.context() as own:
        own.setattr(kept_tensors, "write", write)
        try:
            run(settings, **named)
        except KeyboardInterrupt:
            assert kept()
    return written


def begun_at(run: Run, settings: Settings = ALL, **named: Any) -> tuple[bytes, dict[str, int]]:
    """The file of an anchor, and where each stage of it has begun."""
    first: dict[str, int] = {}

    def note(event: Event) -> None:
        if isinstance(event, Progress) and event.stage.startswith("anchor"):
            first.setdefault(event.stage, event.done)

    return run(settings, note, **named), first


def test_an_interrupted_anchor_goes_on_to_the_same_bytes(
    run: Run, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        every = interrupted(run, patch, -1)
    assert every == 39 and not kept()  # of all parts, and of several groups
    for first in range(1, every + 1, 7):  # in each part, and between two groups
        interrupted(run, monkeypatch, first)
        if first % 2 == 0:
            interrupted(run, monkeypatch, 1 + first % 5)  # and a second time, a little later
        assert run() == whole, first
        assert not kept()


def test_what_is_done_is_not_done_again(
    run: Run, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes: list[int] = []
    plain = measure.backbones.load

    def load(name: str) -> Any:
        model = plain(name)
        model.stem.register_forward_hook(lambda *_: passes.append(1))
        return model

    monkeypatch.setattr(measure.backbones, "load", load)
    run(keep=False)
    needed = len(passes)
    for after in (2, 14, 24):
        passes.clear()
        interrupted(run, monkeypatch, after)
        before = len(passes)
        found, begun = begun_at(run)
        assert found == whole and 0 < before < needed and len(passes) == needed
        assert any(begun.values())  # the progress, too, goes on from there


def test_a_part_of_frames_goes_on(
    run: Run, demos_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uninterrupted = run(FRAMES, demos=demos_file, keep=False)
    interrupted(run, monkeypatch, 3, FRAMES, demos=demos_file)
    found, begun = begun_at(run, FRAMES, demos=demos_file)
    assert found == uninterrupted and begun["anchor"] == 12 and not kept()


@pytest.mark.parametrize(
    "other",
    [
        {"samples": 23},
        {"energy": 0.9},
        {"tokens": 0.4},
        {"batch_size": 5},
    ],
)
def test_another_anchor_takes_nothing(
    run: Run, monkeypatch: pytest.MonkeyPatch, other: dict[str, Any]
) -> None:
    interrupted(run, monkeypatch, 20)
    _, begun = begun_at(run, dataclasses.replace(ALL, **other))
    assert begun and not any(begun.values())
    assert kept()  # which wait for the first one


def test_other_weights_and_other_code_take_nothing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(run, monkeypatch, 20)
    make_tiny(seed=1).save(tmp_path / "other")
    events: list[Event] = []
    other = tmp_path / "other"
    measure.run(str(other), ALL, tmp_path / "b.safetensors", events.append)
    told = [event for event in events if isinstance(event, Progress) and event.unit == "images"]
    assert {event.done for event in told if "1 of" in event.stage} >= {0, 2}
    with monkeypatch.context() as patch:
        patch.setattr(version, "code", lambda: "another")
        _, begun = begun_at(run)
    assert begun and not any(begun.values())


def test_a_changed_image_or_answer_takes_nothing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_jsonl(tmp_path)
    settings = dataclasses.replace(ALL, vqa=str(path), samples=10, parts=("moments", "inputs"))
    interrupted(run, monkeypatch, 4, settings)
    assert any(begun_at(run, settings)[1].values())
    changes: tuple[Callable[[], object], ...] = (
        lambda: path.write_text(path.read_text().replace("two", "red")),
        lambda: [picture(99).save(image) for image in (tmp_path / "images").iterdir()],
    )
    for change in changes:
        interrupted(run, monkeypatch, 4, settings)
        change()
        assert not any(begun_at(run, settings)[1].values())


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty"])
def test_what_is_damaged_is_measured_again_with_a_warning(
    run: Run, whole: bytes, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    interrupted(run, monkeypatch, 10)
    for path in kept():
        raw = bytearray(path.read_bytes())
        raw[len(raw) // 2] ^= 16
        path.write_bytes({"flipped": raw, "cut": raw[:-40], "empty": b""}[damage])
    damaged, events = len(kept()), list[Event]()
    assert run(ALL, events.append) == whole
    warned = [
        event.text for event in events if isinstance(event, Warned) if "damaged" in event.text
    ]
    assert len(warned) == damaged > 1 and all("measured again" in text for text in warned)
    assert not kept()


def test_a_signal_keeps_the_batch_under_way(
    run: Run, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_work, "_EVERY_S", 1e9)
    events: list[Event] = []
    stage = ""

    def end(event: Event) -> None:
        nonlocal stage
        events.append(event)
        if isinstance(event, Progress) and event.stage.startswith("anchor inputs 1 of"):
            stage = event.stage
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(ALL, end)
    assert "is kept" in str([event.text for event in events if isinstance(event, Warned)])
    assert any("process-0" in path.name for path in kept())
    found, begun = begun_at(run)
    assert found == whole
    assert begun[stage] > 0


def test_sums_are_kept_so_seldom_that_it_takes_little_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A minute lies between two times at least, and fifty times what one takes."""
    now = 0.0
    monkeypatch.undo()
    monkeypatch.setattr(kept_work.time, "monotonic", lambda: now)
    times: list[float] = []

    def write(path: Path, what: Kept) -> None:
        nonlocal now
        times.append(now)
        now += cost

    monkeypatch.setattr(kept_tensors, "write", write)
    for cost, size, wanted in (
        (0.1, 8, [60.0, 121.0, 182.0]),
        (10.0, 8, [60.0, 570.0, 1080.0]),
        (10.0, 500_000_000, [125.0, 635.0, 1145.0]),  # of which the first takes 2.5 s by its size
    ):
        now = 0.0
        times.clear()
        sums = Kept({}, {"x": torch.empty(size // 8, dtype=torch.float64)})
        with Work({"a": cost}).piece("anchor").going(lambda sums=sums: sums) as passed:
            for done in range(1150):
                now = round(now)
                passed(done)
                now += 1
        assert [round(time) for time in times[:3]] == wanted


def test_what_has_no_room_on_the_disk_is_not_kept(
    run: Run, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[Event] = []
    monkeypatch.setattr(kept_work.shutil, "disk_usage", lambda _: _Usage(1000))
    assert interrupted(run, monkeypatch, -1) == 0
    assert run(ALL, events.append) == whole
    told = [event.text for event in events if isinstance(event, Warned) and "kept" in event.text]
    assert len(told) == 1 and "AEGIS_CACHE" in told[0] and "anchor.memory" in told[0]
    assert "not kept" in told[0] and "1e-06 GB that are free" in told[0]


def test_a_signal_does_not_promise_to_keep_what_has_no_room(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_work.shutil, "disk_usage", lambda _: _Usage(1000))
    events: list[Event] = []

    def end(event: Event) -> None:
        events.append(event)
        if isinstance(event, Progress) and event.stage == "anchor fisher" and event.done:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(dataclasses.replace(ALL, parts=("fisher",)), end)
    told = str([event.text for event in events if isinstance(event, Warned)])
    assert "of this part is not kept" in told and "so far is kept" not in told


@pytest.mark.parametrize(("processes_here", "free"), [(1, 4000), (4, 16000)])
def test_the_disk_needs_room_for_the_sums_of_each_process_and_for_one_result(
    monkeypatch: pytest.MonkeyPatch, processes_here: int, free: int
) -> None:
    """A quarter of the free disk holds exactly 1,000 bytes of each."""
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes_here))

    def write(bytes_free: int) -> tuple[bool, bool]:
        """Whether sums are kept, and whether the result is."""
        monkeypatch.setattr(kept_work.shutil, "disk_usage", lambda _: _Usage(bytes_free))
        work = Work({"free": bytes_free})
        piece = work.piece("anchor")
        thousand = Kept({}, {"x": torch.zeros(1000, dtype=torch.uint8)})
        with piece.going(lambda: thousand) as passed:
            passed(1)
        sums = piece.begun() is not None
        piece.finish(thousand)
        return sums, piece.finished() is not None

    assert write(free) == (True, True)
    assert write(free - 1) == (False, processes_here > 1)
    assert write(3999) == (False, False)


@dataclasses.dataclass
class _Usage:
    free: int


def test_a_cache_that_cannot_be_written_is_told_once(
    run: Run, whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("AEGIS_CACHE", str(tmp_path / "file"))
    events: list[Event] = []
    assert run(ALL, events.append) == whole
    told = [event.text for event in events if isinstance(event, Warned) and "kept" in event.text]
    assert len(told) == 1 and "AEGIS_CACHE" in told[0]


def test_several_processes_go_on_each_with_its_own_sums(tiny_folder: Path, tmp_path: Path) -> None:
    """Also where they were stopped at places of their own, and one has lost what it kept."""
    kept_in = tmp_path / "cache"
    names = ("whole", "again", "lost")
    stops = (None, (9, 11), (26, 12))
    settings = dataclasses.replace(ALL, samples=24)  # so that each has several batches
    jobs = [
        MeasuringAgain(tiny_folder, tmp_path / name, kept_in, settings, GROUP, stop, name == "lost")
        for name, stop in zip(names, stops, strict=True)
    ]
    run_together(2, jobs)
    found = [(tmp_path / name / "anchor.safetensors").read_bytes() for name in names]
    assert all(one == found[0] for one in found)
    assert not list((kept_in / "anchors").iterdir())


def test_processes_wait_for_each_other_longer_than_for_a_sum(
    tiny_folder: Path, tmp_path: Path
) -> None:
    settings = dataclasses.replace(ALL, parts=("fisher",))
    run_together(2, [Waiting(tiny_folder, tmp_path / "out", settings, limit_s=5, late_s=8)])
    assert (tmp_path / "out" / "anchor.safetensors").is_file()


@pytest.mark.parametrize("about", [{"an": "anchor"}, None])
def test_each_of_several_processes_saves_its_sums_and_then_waits(
    monkeypatch: pytest.MonkeyPatch, about: dict[str, str] | None
) -> None:
    monkeypatch.setattr(kept_work, "_EVERY_S", 1e9)
    piece = Work(about, Ranks(1, 2)).piece("anchor")
    found: list[Kept | None] = []
    monkeypatch.setattr(Ranks, "wait", lambda _: found.append(piece.begun()))
    with piece.going(lambda: Kept({}, {"x": torch.ones(3)})) as passed:
        passed(1)
        passed(2)
        assert not found and piece.begun() is None
    (saved,) = found
    assert (None if saved is None else saved.figures["done"]) == (2 if about else None)


def test_a_process_that_fails_does_not_wait_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ranks, "wait", lambda _: pytest.fail("it waits"))
    piece = Work({"an": "anchor"}, Ranks(1, 2)).piece("anchor")
    with pytest.raises(ValueError), piece.going(lambda: Kept({})):
        raise ValueError


def test_a_signal_after_the_last_batch_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_work, "_EVERY_S", 1e9)
    piece = Work({"an": "anchor"}).piece("anchor")
    with (
        pytest.raises(KeyboardInterrupt),
        piece.going(lambda: Kept({}, {"x": torch.ones(3)})) as passed,
    ):
        passed(1)
        os.kill(os.getpid(), signal.SIGINT)
    saved = piece.begun()
    assert saved is not None and saved.figures["done"] == 1


@pytest.mark.parametrize("part", ANCHOR_PARTS)
def test_saved_sums_are_in_memory_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    """What was read is released before the first pass, and no other sums are allocated."""
    settings = dataclasses.replace(ALL, parts=(part,))
    interrupted(run, monkeypatch, 2, settings)
    read: list[weakref.ref[Kept]] = []
    allocated: list[torch.Size] = []
    begun, going, zeros = kept_work.Piece.begun, kept_work.Piece.going, torch.zeros_like

    def note(piece: kept_work.Piece) -> Kept | None:
        found = begun(piece)
        if found is not None:
            read.append(weakref.ref(found))
        return found

    def go(piece: kept_work.Piece, sums: Callable[[], Kept]) -> Any:
        assert not allocated and not any(one() for one in read)
        return going(piece, sums)

    def zeros_like(x: torch.Tensor, **options: Any) -> torch.Tensor:
        if options.get("dtype") is torch.float64:
            allocated.append(x.shape)
        return zeros(x, **options)

    monkeypatch.setattr(kept_work.Piece, "begun", note)
    monkeypatch.setattr(kept_work.Piece, "going", go)
    monkeypatch.setattr(torch, "zeros_like", zeros_like)
    run(settings)
    assert len(read) == 1


def test_another_number_of_threads_takes_nothing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = dataclasses.replace(ALL, parts=("moments",))
    interrupted(run, monkeypatch, 3, settings)
    before = torch.get_num_threads()
    torch.set_num_threads(before + 1)
    try:
        _, begun = begun_at(run, settings)
    finally:
        torch.set_num_threads(before)
    assert begun and not any(begun.values())


def test_what_cannot_be_removed_does_not_keep_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work({"an": "anchor"})
    for stage in ("anchor", "anchor fisher", "anchor inputs"):
        work.piece(stage).finish(Kept({}))
    assert len(kept()) == 3
    plain, refused = Path.unlink, list[Path]()

    def unlink(path: Path, **options: Any) -> None:
        if not refused:
            refused.append(path)
            raise PermissionError
        plain(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        work.remove()
    assert kept() == refused


@pytest.mark.skipif(not POSSIBLE, reason="this torch takes no device of others' making")
def test_an_anchor_goes_on_on_a_device_besides_the_cpu(tiny_folder: Path, tmp_path: Path) -> None:
    """At a place of each part: a pass there takes long, so that all maps are one group."""
    places = processes.alone(go_on_there, tiny_folder, tmp_path, ALL, 1 << 30, 4)
    assert places == 4


def rows(width: int, seed: int) -> torch.Tensor:
    return torch.randn(50, width, generator=torch.Generator().manual_seed(seed))


def filled(sums: SecondMoments, seeds: range) -> Iterator[SecondMoments]:
    """Add the rows of each seed; all kinds of sums, in an order that is not the alphabet's."""
    for seed in seeds:
        sums.note("last")
        sums.add_rows(["z", "b"], rows(40, seed))
        if seed % 2:
            sums.add_rows(["b"], rows(40, seed + 100))
        sums.add_rows(["strips"], rows(600, seed), convolution=True)
        sums.add_rows(["sketch"], rows(400, seed))
        sums.add_rows(["trace"], rows(moment_sums.SKETCHED + 1, seed)[:3])
        sums.add("norm", rows(4, seed).double().T @ rows(4, seed).double(), 50)
        sums.add_rows(["last"], rows(40, seed))
        yield sums


def test_sums_of_every_kind_come_back_bit_for_bit(tmp_path: Path) -> None:
    *_, alone = filled(SecondMoments(whole=64), range(4))
    *_, begun = filled(SecondMoments(whole=64), range(2))
    kept_tensors.write(tmp_path / "kept", begun.kept())
    read = kept_tensors.read(tmp_path / "kept")
    assert read is not None
    restored = SecondMoments(whole=64)
    restored.restore(read, CPU)
    *_, restored = filled(restored, range(2, 4))
    wanted, found = alone.kept(), restored.kept()
    assert found.figures == wanted.figures and found.tensors.keys() == wanted.tensors.keys()
    for name, tensor in wanted.tensors.items():
        assert (
            torch.equal(found.tensors[name], tensor) and found.tensors[name].dtype == tensor.dtype
        )
    kinds = {type(one).__name__ for one in restored._rows.values()}
    assert kinds == {"FullSum", "Sketch", "TraceOnly"}
