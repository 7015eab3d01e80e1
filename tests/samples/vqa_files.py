"""Question sets as users bring them: lines of JSON, the official files, Hugging Face datasets."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# Questions and answers in the words of the embedded VLM.
ASKED = (("what color is the cube", ["red", "red", "blue"]), ("how many balls are there", ["two"]))


def picture(seed: int, width: int = 40, height: int = 30) -> Image.Image:
    return Image.fromarray(
        np.random.default_rng(seed).integers(256, size=(height, width, 3), dtype=np.uint8)
    )


def row(image: str, asked: int = 0, **changes: Any) -> dict[str, Any]:
    """One line's content; a change to None removes the key."""
    text, answers = ASKED[asked]
    made = {"image": image, "question": text, "answers": answers, **changes}
    return {key: value for key, value in made.items() if value is not None}


def write_jsonl(
    folder: Path, images: int = 24, name: str = "set.jsonl", extra: Sequence[str] = ()
) -> Path:
    """Two questions about each of some images of several sizes; `extra` lines follow."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = []
    for i in range(images):
        picture(i, 30 + i).save(folder / "images" / f"{i}.png")
        lines += [json.dumps(row(f"images/{i}.png", asked)) for asked in range(len(ASKED))]
    path = folder / name
    path.write_text("".join(f"{line}\n" for line in [*lines, *extra]))
    return path


def official_pair(images: int = 24) -> tuple[dict[str, Any], dict[str, Any]]:
    """A questions file and its annotations in VQAv2's format: ten answers each."""
    questions, annotations = [], []
    for i in range(images):
        for n, (text, answers) in enumerate(ASKED):
            ids = {"image_id": 262148 + i, "question_id": 262148000 + 1000 * i + n}
            questions.append({**ids, "question": text})
            said = [
                {
                    "answer": answers[k % len(answers)],
                    "answer_confidence": "yes",
                    "answer_id": k + 1,
                }
                for k in range(10)
            ]
            kind = "number" if text.startswith("how many") else "other"
            annotations.append(
                {
                    **ids,
                    "question_type": text[:8],
                    "answer_type": kind,
                    "multiple_choice_answer": answers[0],
                    "answers": said,
                }
            )
    about = {
        "info": {"version": "2.0"},
        "license": {},
        "data_type": "mscoco",
        "data_subtype": "val2014",
    }
    return {**about, "task_type": "Open-Ended", "questions": questions}, {
        **about,
        "annotations": annotations,
    }


def write_official(
    folder: Path,
    release: str = "v2_",
    own_folder: bool = True,
    images: int = 24,
    **changed: dict[str, Any],
) -> Path:
    """The files under their official names; returns the questions file.

    The images are placed as in COCO's archive, or beside the files.
    """
    questions, annotations = official_pair(images)
    place = folder / "val2014" if own_folder else folder
    place.mkdir(parents=True, exist_ok=True)
    for i in range(images):
        picture(i).save(place / f"COCO_val2014_{262148 + i:012d}.jpg")
    path = folder / f"{release}OpenEnded_mscoco_val2014_questions.json"
    path.write_text(json.dumps(changed.get("questions", questions)))
    (folder / f"{release}mscoco_val2014_annotations.json").write_text(
        json.dumps(changed.get("annotations", annotations))
    )
    return path


def hub_rows(images: int = 24, **columns: Any) -> dict[str, list[Any]]:
    """The columns of a data set, two rows per image; a change to None removes the column."""
    count = images * len(ASKED)
    made = {
        "image": [picture(i // len(ASKED), 30 + i // len(ASKED)) for i in range(count)],
        "question": [ASKED[i % len(ASKED)][0] for i in range(count)],
        "answers": [ASKED[i % len(ASKED)][1] for i in range(count)],
        **columns,
    }
    return {name: list(column) for name, column in made.items() if column is not None}
