"""`aegis run` with a study of streams: every cell once, interrupted anywhere.

Its figures are those of the streams themselves.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import shutil
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from samples import stream_studies as samples
from samples.stream_studies import PAIRS, SHARED, VARIANTS, raw, study, write
from samples.streams import STREAMS, offer, recipe

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import Progress, ignore
from aegis_cli.continual import images, train
from aegis_cli.data.streams import folders
from aegis_cli.recipes import StreamRecipe, StreamStudyRecipe, study_cells
from aegis_cli.studies import stream_cells
from aegis_cli.studies import study as stage
from aegis_cli.studies.cells import Cell, CellStore
from aegis_cli.studies.figures import StreamFigures
from aegis_cli.studies.stream_cells import StreamRunner, StreamStudy, cell_key, stream_figures

pytestmark = pytest.mark.usefixtures("tiny_streams")

Aegis = Callable[..., tuple[int, str, str]]
TUNED = ["tuning/igsp/0.1", "tuning/igsp/10"]
TUNED_ALONE: dict[str, Any] = {"pairs": None, "seeds": [0], "variants": {"igsp": VARIANTS["igsp"]}}
PLACES = ("small", "pair", "contrary")
COMPARED = [
    f"{place}/{name}/{seed}"
    for seed in (0, 1)
    for place in PLACES
    for name in VARIANTS
    if name != "zero-shot" or not seed
]  # all its seeds are equal


class Stop(Exception):
    """Stands for the user's Ctrl-C."""


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bool]]:
    """The run folders of the streams that are learned, and whether on validation parts."""
    places: list[tuple[str, bool]] = []
    work = train.run

    def run(recipe: StreamRecipe, out: Path, *args: Any, **kwargs: Any) -> Any:
        places.append(("/".join(out.parts[-3:]), recipe.split == "validation"))
        return work(recipe, out, *args, **kwargs)

    monkeypatch.setattr(train, "run", run)
    return places


def invent(monkeypatch: pytest.MonkeyPatch, stop_after: int | None = None) -> list[str]:
    """Rows by a formula instead of runs; returns the labels of the calls.

    The call after `stop_after` raises a Ctrl-C.
    """
    labels: list[str] = []

    def measure(self: StreamRunner, cell: Cell[StreamRecipe]) -> StreamFigures:
        if len(labels) == stop_after:
            raise KeyboardInterrupt
        labels.append(cell.label)
        recipe = cell.recipe
        last, parameters = 0.5 + recipe.seed % 7 / 100, round(100 / (1 + recipe.igsp.reuse))
        return samples.row(method=recipe.train.method, last=last, parameters=parameters)

    monkeypatch.setattr(StreamRunner, "measure", measure)
    return labels


def timeless(table: Any) -> Any:
    """A report without its path and its duration."""
    plain = json.loads(json.dumps(table))
    plain.pop("out")
    for result in plain["results"]:
        result.pop("minutes")
    return plain


# --- really learned ------------------------------------------------------------------------------


def test_cells_are_stale_when_their_images_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def key(made: StreamRecipe) -> str:
        return StreamRunner(tmp_path, ignore).key(Cell("a", made))

    made = dataclasses.replace(recipe("igsp"), path=str(tmp_path / "data"), order=("one",))
    folder = picture_folders(tmp_path / "data" / "one")
    bare = key(dataclasses.replace(made, path=None))
    keys = [bare, key(made)]
    changes = [
        ("train/a/0.bmp", "other"),
        ("train/a/1.bmp", "more"),
        ("classes.json", "x"),
        ("classes.json", "y"),
        ("templates.txt", "a {}"),
        ("validation/a/0.bmp", "held back"),
        ("train/c/0.bmp", "a class"),
    ]
    for name, content in changes:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
        keys.append(key(made))
    (folder / "train" / "d").mkdir()  # a class, though without a picture
    keys.append(key(made))
    assert len(set(keys)) == len(keys) == 10 and key(made) == keys[-1]
    (folder / "train" / "a" / "notes.md").write_text("no picture")
    (tmp_path / "data" / "other.png").write_text("of no task")
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    assert key(dataclasses.replace(made, path=str(tmp_path / "elsewhere"))) == keys[-1]
    monkeypatch.setattr(images.streams, "edition", lambda name: ["newer"])
    assert key(dataclasses.replace(made, path=None)) != bare and key(recipe("igsp")) != bare


def picture_folders(task: Path, content: str = "first") -> Path:
    """A task's folder with two classes of one file each; none is ever decoded."""
    for place in ("train/a", "train/b", "test/a", "test/b"):
        (task / place).mkdir(parents=True)
        (task / place / "0.bmp").write_text(content)
    return task


def test_pictures_behind_links_and_others_of_their_size_are_told_apart(tmp_path: Path) -> None:
    made = dataclasses.replace(recipe("igsp"), order=("one",))
    found = []
    for content in ("first", "other"):
        real, root = picture_folders(tmp_path / f"real-{content}", content), tmp_path / content
        (root / "one").mkdir(parents=True)
        for part in ("train", "test"):
            (root / "one" / part).symlink_to(real / part)
        found.append(images.image_set(dataclasses.replace(made, path=str(root))))
        (root / "two").symlink_to(real)  # another link on the way to the same files
        assert (
            folders.contents(root / "two")
            == folders.contents(real)
            == folders.contents(root / "one")
        )
    assert found[0] != found[1]


def test_a_study_through_the_command_line_interrupted_and_not(
    aegis: Aegis, tmp_path: Path, learned: list[tuple[str, bool]]
) -> None:
    """One seed; the streams' own reports give the values that the table must have."""
    path = write(tmp_path, raw(seeds=[3], keep_runs=True))
    code, out, err = aegis("run", path, "--out", tmp_path / "whole", "--json")
    assert code == 0, err
    table = json.loads(out)
    compared = [label for label in COMPARED if label.endswith("/0")]
    assert learned == [(label, True) for label in TUNED] + [
        (f"{label[:-1]}3", False) for label in compared
    ]
    folder = tmp_path / "whole" / "small"
    assert files.load_json(folder / "table.json") == table and (
        table["finished"],
        table["cells"],
    ) == (11, 11)
    assert [r["variant"] for r in table["results"]] == list(VARIANTS)
    for result in table["results"]:
        run = files.load_json(folder / "small" / result["variant"] / "3" / "stream.json")
        for how, scores in (("told", run["scores"]), ("inferred", run["inferred_scores"])):
            assert {name: e["mean"] for name, e in result[how].items()} == scores
        assert result["parameters"]["mean"] == run["parameters"]
        for letter, name in PAIRS.items():
            both = files.load_json(folder / name / result["variant"] / "3" / "stream.json")
            first, second = (r["added"] for r in both["records"])
            added = result[f"pair_{letter}"]["added"]
            assert (added is None) if first == 0 else added["mean"] == second / first
            apart = files.load_json(folder / name / "isolated-lora" / "3" / "stream.json")[
                "oracle"
            ][1][1]
            gain = result[f"pair_{letter}"]["second_gain_points"]
            assert gain["mean"] == pytest.approx(100 * (both["oracle"][1][1] - apart))
            change = 100 * (both["oracle"][1][0] - both["oracle"][0][0])
            pair = result[f"pair_{letter}"]
            assert pair["first_change_points"]["mean"] == pair["worst_change_points"] == change
    assert [r["bar"] is None for r in table["results"]] == [True, True, False]
    assert [(p["value"], p["chosen"]) for p in table["tuning"]].count(
        (table["results"][2]["value"], True)
    ) == 1
    _on_validation(table["tuning"], folder)

    recipe = study(
        tmp_path, seeds=[3]
    )  # this time without keeping the runs, and interrupted in the middle of a cell
    for cut in ("tuning/igsp/10/task 2 two", "small/igsp/3/task 3 three"):

        def stop(event: Progress, cut: str = cut) -> None:
            if event.stage == cut and event.done == 5:
                raise Stop

        with pytest.raises(Stop):
            stage.run(recipe, tmp_path / "cut", stop)
    events: list[Progress] = []
    resumed = stage.run(recipe, tmp_path / "cut", events.append)
    # From the checkpoint of step 4.
    assert [e.done for e in events if e.stage == "small/igsp/3/task 3 three"] == [4, 5, 6]
    assert timeless(resumed.to_json()) == timeless(table)
    assert {p.name for p in (tmp_path / "cut" / "small").iterdir()} == {"cells.json", "table.json"}
    again = (tmp_path / "cut" / "small" / "table.json").read_bytes()
    learned.clear()
    code, out, _ = aegis("run", write(tmp_path, raw(seeds=[3])), "--out", tmp_path / "cut")
    assert (
        code == 0
        and learned == []
        and (tmp_path / "cut" / "small" / "table.json").read_bytes() == again
    )
    words = (
        "Task told",
        "Task inferred",
        "In phase 1",
        "Final parameters",
        "Pair A",
        "Pair B",
        "bar, by the worse end of each interval:",
        "igsp has no verdict",
    )
    saved = (tmp_path / "cut" / "small" / "table.md").read_text()
    assert [word for word in words if word not in out or word not in saved] == [], out
    assert aegis("inspect", tmp_path / "cut" / "small") == (0, out, "")
    assert max(map(len, out.splitlines())) <= 160


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The result of a study of `TUNED_ALONE` that was never interrupted."""
    folder = tmp_path_factory.mktemp("tuned")
    with pytest.MonkeyPatch.context() as patch:
        offer(patch)
        return timeless(stage.run(study(folder, **TUNED_ALONE), folder).to_json())


def test_a_tuning_run_finished_as_inspect_advises_is_of_validation_parts(
    aegis: Aegis, tuned: Any, tmp_path: Path
) -> None:
    asked = study(tmp_path, **TUNED_ALONE)

    def stop(event: Progress) -> None:
        if event.stage == "tuning/igsp/10/task 3 three":
            raise Stop

    with pytest.raises(Stop):
        stage.run(asked, tmp_path / "cut", stop)
    run = tmp_path / "cut" / "small" / "tuning" / "igsp" / "10"
    code, _, err = aegis("inspect", run)
    assert code == 2
    advised = next(line for line in err.splitlines() if "continue it: aegis " in line).partition(
        "aegis "
    )[2]
    code, out, err = aegis(*advised.split())
    assert code == 0 and "On validation parts" in out, err
    assert aegis("probe", run)[0] == 0
    assert timeless(stage.run(asked, tmp_path / "cut").to_json()) == tuned


def _on_validation(points: list[dict[str, Any]], folder: Path) -> None:
    """Choices are made on the validation parts, whose size shows in the accuracies.

    Figures are of the test parts.
    """
    for point in points:
        row = files.load_json(folder / "tuning" / "igsp" / str(point["value"]) / "stream.json")
        assert row["scores"]["last"] == point["last"]
        for accuracies in row["oracle"]:
            for accuracy, task in zip(accuracies, STREAMS["small"], strict=True):
                assert (accuracy * len(task.validation)) == pytest.approx(
                    round(accuracy * len(task.validation)), abs=1e-9
                )
    tested = files.load_json(folder / "small" / "igsp" / "3" / "stream.json")["oracle"]
    assert any(
        a * 12 != pytest.approx(round(a * 12), abs=1e-9)
        for accuracies in tested
        for a in accuracies
    )


@pytest.mark.usefixtures("quick_workers")
def test_processes_find_what_one_finds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variants = {
        "zero-shot": VARIANTS["zero-shot"],
        "wild": {"method": "isolated-lora", "set": {"train.lr": 1e30}},
    }
    asked = study(tmp_path, variants=variants, tuning=None, pairs=None, seeds=[0])
    alone = stage.run(asked, tmp_path / "alone")
    monkeypatch.setattr(stream_cells, "StreamRunner", samples.make)
    together = stage.run(asked, tmp_path / "together", workers=2)
    assert timeless(together.to_json()) == timeless(alone.to_json())
    assert [r.diverged for r in alone.results] == [[], ["small 0"]] and alone.results[
        1
    ].bar.passed is False
    assert alone.results[1].parameters is None and alone.results[0].told.last is not None
    assert multiprocessing.active_children() == []


# --- which cells, and in which order -------------------------------------------------------------


@pytest.mark.parametrize("done", [0, 1, 2, 3, 11, 16])
def test_a_study_cut_anywhere_loses_nothing(
    done: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = study(tmp_path)
    first = invent(monkeypatch, stop_after=done)
    with pytest.raises(KeyboardInterrupt):
        stage.run(small, tmp_path)
    second = invent(monkeypatch)
    resumed = stage.run(small, tmp_path)
    assert len(first) == done and [*first, *second] == [*TUNED, *COMPARED]
    invent(monkeypatch)
    assert timeless(resumed.to_json()) == timeless(
        stage.run(small, tmp_path / "elsewhere").to_json()
    )
    assert (
        resumed.results[2].value == 10.0 and resumed.results[2].told.last.runs == 2
    )  # equally accurate, and smaller


def changed(name: str, **keys: Any) -> dict[str, Any]:
    return {"variants": {**VARIANTS, name: {**VARIANTS.get(name, {}), **keys}}}


@pytest.mark.parametrize(
    ("changes", "again"),
    [
        ({}, []),
        ({"keep_runs": True}, []),
        ({"shared": {**SHARED, "moe_adapters": {"rank": 9}}}, []),  # for none of these learners
        (
            {"seeds": [1, 2]},
            [f"{place}/{name}/2" for place in PLACES for name in VARIANTS if name != "zero-shot"],
        ),
        ({"pairs": None}, []),
        (
            {"streams": ["small", "more"]},
            [
                "more/zero-shot/0",
                *(f"more/{name}/{seed}" for seed in (0, 1) for name in list(VARIANTS)[1:]),
            ],
        ),
        (
            changed("second", method="prototype"),
            [f"{p}/second/{s}" for s in (0, 1) for p in PLACES],
        ),
        ({"tuning": {**samples.TUNING, "seed": 7}}, TUNED),
        ({"tuning": {**samples.TUNING, "within": 0}}, []),
    ],
)
def test_only_cells_that_a_change_concerns_are_learned_again(
    changes: dict[str, Any], again: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STREAMS, "more", STREAMS["small"])
    invent(monkeypatch)
    stage.run(study(tmp_path), tmp_path)
    labels = invent(monkeypatch)
    stage.run(study(tmp_path, **changes), tmp_path)
    assert labels == again


def test_a_run_that_was_begun_with_other_settings_is_begun_anew(tmp_path: Path) -> None:
    def stop(event: Progress) -> None:
        if event.stage.startswith("task 2") or "/task 2" in event.stage:
            raise Stop

    asked = {"tuning": None, "pairs": None, "seeds": [0], "variants": {"igsp": {"method": "igsp"}}}
    with pytest.raises(Stop):
        stage.run(study(tmp_path, **asked), tmp_path, stop)
    assert (tmp_path / "small" / "small" / "igsp" / "0" / "state.safetensors").exists()
    other = asked | {"shared": {**SHARED, "igsp": {**SHARED["igsp"], "rank": 1}}}
    report = stage.run(study(tmp_path, **other), tmp_path)
    assert timeless(report.to_json()) == timeless(
        stage.run(study(tmp_path, **other), tmp_path / "new").to_json()
    )


@pytest.mark.parametrize("changed", ["encoder", "split"])
def test_an_interrupted_study_goes_on_after_its_encoder_has_moved(
    changed: str, tuned: Any, tmp_path: Path
) -> None:
    """The cell has the same key, and its recipe another name.

    The same holds for a tuning run from before recipes named their parts.
    """

    def stop(event: Progress) -> None:
        if event.stage == "tuning/igsp/10/task 2 two":
            raise Stop

    asked = dict(TUNED_ALONE)
    with pytest.raises(Stop):
        stage.run(study(tmp_path, **asked), tmp_path / "cut", stop)
    begun = tmp_path / "cut" / "small" / "tuning" / "igsp" / "10" / "recipe.yaml"
    if changed == "encoder":
        images.encoder("tiny").save(tmp_path / "moved")
        asked["shared"] = {**SHARED, "encoder": str(tmp_path / "moved")}
    else:
        begun.write_text(begun.read_text().replace("split: validation\n", ""))
    assert timeless(stage.run(study(tmp_path, **asked), tmp_path / "cut").to_json()) == tuned


def test_a_run_that_no_study_began_is_left_alone(tmp_path: Path) -> None:
    own = tmp_path / "small/small/igsp/0/stream.json"
    own.parent.mkdir(parents=True)
    own.write_text("{}")
    with pytest.raises(AegisError, match="did not begin it"):
        stage.run(
            study(
                tmp_path, tuning=None, pairs=None, seeds=[0], variants={"igsp": {"method": "igsp"}}
            ),
            tmp_path,
        )
    assert own.read_text() == "{}"


def test_a_key_tells_all_that_shapes_a_row_and_nothing_else(tmp_path: Path) -> None:
    recipe = study_cells.cell(study(tmp_path), "igsp", "small", 0, 0.1)

    def replace(part: str, **keys: Any) -> StreamRecipe:
        return dataclasses.replace(
            recipe, **{part: dataclasses.replace(getattr(recipe, part), **keys)}
        )

    def key_of(
        recipe: StreamRecipe, encoder: str = "0", images: str = "i", validation: bool = False
    ) -> str:
        return cell_key(Cell("a", recipe, validation), encoder * 64, images)

    def top(**keys: Any) -> StreamRecipe:
        return dataclasses.replace(recipe, **keys)

    key = key_of(recipe)
    same = [
        top(name="other", encoder="elsewhere"),
        replace("moe_adapters", rank=7),
        replace("sequential", lr=1.0),
    ]
    assert {key_of(r) for r in same} == {key}
    still = [
        replace("train", method="zero-shot"),
        dataclasses.replace(replace("train", method="zero-shot"), seed=1),
    ]
    assert len({key_of(r) for r in still}) == 1
    other = [
        top(seed=1),
        top(stream="pair"),
        top(order=("one", "two")),
        replace("train", steps=7),
        replace("train", method="prototype"),
        replace("igsp", reuse=0.2),
        replace("igsp", prune=False),
        replace("inference", quantile=0.5),
    ]
    keys = {key_of(r) for r in other}
    keys |= {
        key_of(recipe, validation=True),
        key_of(recipe, encoder="1"),
        key_of(recipe, images="j"),
    }
    assert len(keys | {key}) == len(other) + 4
    plain = [
        replace("train", method=name) for name in ("zero-shot", "sequential", "sequential-lora")
    ]  # they infer no task
    for shared in plain:
        told = dataclasses.replace(
            shared, inference=dataclasses.replace(shared.inference, rank=3, quantile=0.5)
        )
        assert key_of(told) == key_of(shared)


@pytest.mark.parametrize("content", ["[]", "broken", "entry"])
def test_cells_that_are_none_are_refused(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    invent(monkeypatch)
    small = study(tmp_path)
    stage.run(small, tmp_path)
    path = tmp_path / "small" / "cells.json"
    if content == "entry":
        files.save_json(path, {key: {"last": 1} for key in files.load_json(path)})
    else:
        path.write_text(content)
    with pytest.raises(AegisError, match="cells.json"):
        stage.run(small, tmp_path)


def test_a_row_is_what_the_report_says(tmp_path: Path) -> None:
    recipe = study_cells.cell(study(tmp_path), "igsp", "pair", 0, 0.1)
    report = train.run(recipe, tmp_path / "run")
    made = stream_figures(report)
    owners = [
        [owner for site in record.sites for owner in site.owners] for record in report.records
    ]
    assert made.new_experts == (owners[0].count(0), owners[1].count(1)) and made.new_experts[0] > 0
    assert sum(made.added) == made.parameters == report.parameters and made.first_change == 0
    assert made.own == (report.oracle[0][0], report.oracle[1][1])
    assert made.average == pytest.approx(statistics.fmean(v for r in report.oracle for v in r))
    kind = StreamStudy(study(tmp_path))
    kept = CellStore(kind, tmp_path / "store", ignore)
    kept.keep("k", made)
    assert CellStore(kind, tmp_path / "store", ignore).known("k", StreamFigures) == made
    shutil.rmtree(tmp_path / "run")
    assert (
        stream_figures(
            train.run(dataclasses.replace(recipe, split="validation"), tmp_path / "run")
        ).last
        != made.last
    )


# --- refused -------------------------------------------------------------------------------------

ONE = {"x": {"method": "igsp"}}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"streams": None}, ("no key 'streams'", "add the line")),
        ({"streams": ["small", "small"]}, ("streams: ['small', 'small']", "change 'streams'")),
        ({"seeds": [1000]}, ("tuning.seed: 1000 is also one of seeds", "set tuning.seed to 2000")),
        ({"tuning": None}, ("igsp with 'tune'", "add it: stream, seed, within")),
        (
            {"tuning": {"stream": "small", "witin": 1}},
            ("unknown key 'tuning.witin'", "did you mean 'tuning.within'?"),
        ),
        ({"tuning": {"seed": 5}}, ("no key 'tuning.stream'",)),
        (
            {"lr": 1e-3},
            ("unknown key 'lr'", "did you mean 'shared.train.lr' or 'shared.sequential.lr'?"),
        ),
        ({"stream": "small"}, ("unknown key 'stream'", "did you mean 'streams'?")),
        ({"pairs": {"a": "pair"}}, ("no key 'pairs.b'",)),
        ({"pairs": {"a": "pair", "b": "pair"}}, ("the stream 'pair' twice", "delete it")),
        ({"pairs": {"a": "pair", "b": "small"}}, ("the stream 'small' twice", "delete it")),
        ({"pairs": {"a": "pair", "c": "small"}}, ("unknown key 'pairs.c'", "no key 'pairs.b'")),
        (
            {"variants": {"zero-shot": {"method": "igsp"}}},
            ("variants.zero-shot.method: igsp", "rename"),
        ),
        (
            {"variants": {"isolated-lora": {"method": "prototype"}}},
            ("variants.isolated-lora.method", "rename"),
        ),
        (
            {"variants": {"isolated-lora-half": {"method": "igsp"}}},
            ("variants.isolated-lora-half.method", "rename"),
        ),
        (
            {"variants": {"x": {"method": "isgp"}}},
            ("variants.x.method: 'isgp'", "did you mean 'igsp'?"),
        ),
        (
            {"variants": {"x": {"method": "igsp", "set": {"inference.quantile": 0.1}}}},
            ("the same for all", "to 'shared'"),
        ),
        (
            {"variants": {"x": {"method": "igsp", "set": {"order": ["one"]}}}},
            ("x.set: order", "use 'streams'"),
        ),
        (
            {"variants": {"x": {"method": "igsp", "tune": {"igsp.kapa": [1]}}}},
            ("x: unknown key 'igsp.kapa'", "kappa"),
        ),
        (
            {"variants": {"x": {"method": "igsp", "tune": {"igsp.reuse": [0.1, -1]}}}},
            ("variants.x: igsp.reuse: -1",),
        ),
        (
            {"variants": ONE, "shared": {"encoder": "tiny", "seed": 3}},
            ("shared: seed", "use 'seeds'"),
        ),
        (
            {"variants": ONE, "shared": {"encoder": "tiny", "split": "validation"}},
            ("shared: split", "use 'tuning'"),
        ),
        (
            {"variants": {"x": {"method": "igsp", "set": {"split": "validation"}}}},
            ("x.set: split", "use 'tuning'"),
        ),
        (
            {"variants": ONE, "shared": {"train": {"stesp": 3}}},
            ("shared: unknown key 'train.stesp'", "'train.steps'?"),
        ),
        ({"variants": ONE, "shared": 3}, ("shared: 3",)),
        ({"variants": ONE, "shared": {"encoder": "none"}}, ("no dual encoder 'none'",)),
        ({"variants": ONE, "streams": ["unknown"]}, ("no stream 'unknown'",)),
        (
            {"variants": ONE, "streams": ["pair"], "pairs": {"a": "small", "b": "contrary"}},
            ("'small' has 3 tasks", "two"),
        ),
        (
            {"pairs": {"a": "pair", "b": "unknown"}},
            ("no stream 'unknown'",),
        ),  # before the knobs are tuned
    ],
)
def test_a_mistake_is_one_error(
    changes: dict[str, Any], says: tuple[str, ...], aegis: Aegis, tmp_path: Path
) -> None:
    code, out, err = aegis("run", write(tmp_path, raw(**changes)), "--out", tmp_path / "runs")
    assert (code, out) == (2, "") and "Traceback" not in err and err.count("found:") == 1
    assert [word for word in says if word not in err] == [], err
    assert not [
        path
        for name in ("cells.json", "recipe.yaml", "*.tmp")
        for path in (tmp_path / "runs").rglob(name)
    ]


def test_the_kinds_are_told_apart(aegis: Aegis, tmp_path: Path) -> None:
    assert isinstance(study(tmp_path), StreamStudyRecipe)
    code, _, err = aegis("train", tmp_path / "study.yaml", "--out", tmp_path / "x")
    assert (
        code == 2
        and "a study of several runs, a recipe for `aegis run`" in err
        and "aegis run " in err
    )
