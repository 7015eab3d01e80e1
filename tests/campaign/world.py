"""A folder with a small file of every kind that Aegis reads, made by Aegis itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from campaign import forks
from samples import lerobot, small_run, studies, vqa_files
from samples.tiny import make_tiny

from aegis_cli import recipes
from aegis_cli.anchors import measure
from aegis_cli.common.events import Progress
from aegis_cli.continual import train as stream_training
from aegis_cli.data import record
from aegis_cli.recipes import (
    ANCHOR_PARTS,
    Anchor,
    Expert,
    Igsp,
    Probe,
    Recipe,
    RobotDemos,
    RobotRollout,
    RobotStreamRecipe,
    RobotTrain,
    Rollout,
)
from aegis_cli.recipes.strict_yaml import dump
from aegis_cli.training import train

DEMOS, ANCHOR, RECIPE = "demos.safetensors", "anchor.safetensors", "small.yaml"
ASKED = "questions/lines/set.jsonl"
TRAIN = ("--method", "aegis", "--demos", DEMOS, "--anchor", ANCHOR)
STEPS = 4  # of the run


class Enough(Exception):
    """Ends a training that is to be resumed later."""


def begin(root: Path) -> Path:
    """Make the files below `root` that the commands read.

    The work is done in child processes, which leave nothing behind.
    """
    root.mkdir(parents=True, exist_ok=True)
    for make in (_model_and_demos, _recipes, _anchor, _questions, _dataset):
        forks.call(make, root)
    return root


def finish(root: Path) -> None:
    """Make the outputs of commands, finished and in progress, also in child processes."""
    _done(root, "train", RECIPE, *TRAIN, "--out", "run")
    _done(root, "export", "run", "--format", "lerobot", "--out", "exported")
    _done(root, "train", "stream.yaml", "--out", "stream")
    _done(root, "run", "job.yaml", "--out", "jobs")
    _done(root, "run", "study.yaml", "--out", "studies")
    forks.call(_run_in_progress, root)
    forks.call(_stream_in_progress, root)


def _done(root: Path, *args: object) -> None:
    ended = forks.run(args, root, 600.0)
    if ended.code:
        raise RuntimeError(f"aegis {' '.join(map(str, args))}: {ended.code}\n{ended.err}")


# --- each function runs in the world's folder ----------------------------------------------------


def _model_and_demos() -> None:
    make_tiny().save(Path("model"))
    for task in ("reach", "point"):
        record.run(task, 4, 0, Path(DEMOS if task == "reach" else "point.safetensors"), workers=1)


def _recipes() -> None:
    small = small_run.recipe("model", ("aegis",), steps=STEPS)
    quick = {"probe": Probe(questions=14, vqa=ASKED), "rollout": Rollout(episodes=1, replan=20)}
    job = dataclasses.replace(small, name="job", methods=("naive",), **quick)
    made: dict[str, Recipe | RobotStreamRecipe] = {
        RECIPE: small,
        "job.yaml": dataclasses.replace(job, train=dataclasses.replace(job.train, steps=2)),
        "stream.yaml": _stream_recipe(),
    }
    for name, recipe in made.items():
        Path(name).write_text(recipes.to_yaml(recipe), encoding="utf-8")
    shared: dict[str, Any] = studies.raw("model")["shared"]
    shared |= {name: dataclasses.asdict(section) for name, section in quick.items()}
    shared["train"] |= {"steps": 2}
    variants = {"plain": {"method": "stop-gradient"}}
    keys = studies.raw("model", shared=shared, variants=variants, seeds=[0], tuning=None)
    Path("study.yaml").write_text(dump(keys), encoding="utf-8")


def _stream_recipe() -> RobotStreamRecipe:
    return RobotStreamRecipe(
        name="stream",
        tasks=("reach", "point"),
        backbone="model",
        demos=RobotDemos(paths=(DEMOS, "point.safetensors")),
        train=RobotTrain(
            method="igsp",
            steps=2,
            batch_size=4,
            chunk=20,
            flow_samples=2,
            lr=1e-2,
            expert_lr=3e-3,
            warmup=1,
            checkpoint_every=2,
            log_every=1,
            precision="float32",
        ),
        expert=Expert(width=16, mlp_ratio=1),
        rollout=RobotRollout(episodes=1, replan=20),
        probe=Probe(questions=7),
        igsp=Igsp(rank=2, identify=0.5, check_every=2, checks=1),
    )


def _anchor() -> None:
    settings = Anchor(samples=14, batch_size=14, parts=ANCHOR_PARTS, energy=1.0, fisher_samples=4)
    measure.run("model", settings, Path(ANCHOR))


def _questions() -> None:
    """Question sets of each form: lines of JSON, the official files, a saved dataset, parquet."""
    from datasets import Dataset, Features, Image, Sequence, Value

    folder = Path("questions")
    vqa_files.write_jsonl(folder / "lines", images=8)
    vqa_files.write_official(folder / "official", images=8)
    features = Features(
        {"image": Image(), "question": Value("string"), "answers": Sequence(Value("string"))}
    )
    rows = Dataset.from_dict(vqa_files.hub_rows(8), features=features)
    rows.save_to_disk(str(folder / "saved"))
    (folder / "parquet").mkdir()
    rows.to_parquet(str(folder / "parquet" / "train-00000-of-00001.parquet"))


def _dataset() -> None:
    """A LeRobot dataset with instructions whose words the tiny model knows."""
    texts = ("go to the red target", "go to the blue target")
    made = [
        dataclasses.replace(episode, instruction=texts[number % len(texts)])
        for number, episode in enumerate(lerobot.episodes(4, size=(16, 16)))
    ]
    lerobot.save(Path("dataset"), made)


def _run_in_progress() -> None:
    """A run whose last checkpoint is one step old."""

    def stop(event: Progress) -> None:
        if event.stage == "train" and event.done == STEPS - 1:
            raise Enough

    try:
        train.run(
            recipes.load(Path(RECIPE)),
            "aegis",
            Path(DEMOS),
            Path(ANCHOR),
            Path("begun"),
            on_event=stop,
        )
    except Enough:
        return
    raise RuntimeError("the run went on to its end")


def _stream_in_progress() -> None:
    """A stream whose second task has begun."""
    out = Path("stream-begun")

    def stop(_: Progress) -> None:
        if any(out.rglob("state.safetensors")):
            raise Enough

    try:
        stream_training.run(_stream_recipe(), out, on_event=stop)
    except Enough:
        return
    raise RuntimeError("the stream went on to its end")
