"""The contract of a stream's task: named classes, templates, and labelled images of three parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from aegis_cli.common.errors import AegisError


@dataclass(frozen=True)
class Part:
    """Labelled images, decoded on access.

    Attributes:
        labels: [N] int64, indices into the task's classes.
        images: indices [B] int64 -> images [B, S, S, 3] uint8, S being the image size that the task
            was loaded with.
    """

    labels: Tensor
    images: Callable[[Tensor], Tensor]

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True)
class StreamTask:
    """One classification task.

    Attributes:
        name: letters, digits and '-'; it is used as a file name in runs.
        classes: distinct names, as inserted into a template for the text tower; an image is
            classified among these only.
        templates: sentences, each with one "{}" and no other brace; training uses the first.
        train, validation, test: parts that share no image; choices are made on validation, and
            figures are reported on test.
    """

    name: str
    classes: tuple[str, ...]
    templates: tuple[str, ...]
    train: Part
    validation: Part
    test: Part

    def __post_init__(self) -> None:
        # Images of two classes with the same name could not be distinguished.
        if len(set(self.classes)) < max(2, len(self.classes)):
            found = f"task '{self.name}' with classes {list(self.classes)}"
            raise AegisError(found, "two or more, all different", "rename them")
        wrong = [template for template in self.templates if not has_one_gap(template)]
        if wrong or not self.templates:
            found = f"task '{self.name}' with templates {wrong or 'none'}"
            raise AegisError(
                found, "one '{}' in each, and no other brace", "write e.g. 'a photo of a {}.'"
            )
        for part in (self.train, self.validation, self.test):
            if not _is_labelled(part, len(self.classes)):
                found = (
                    f"task '{self.name}': a part of {len(part)} images with labels outside "
                    f"its {len(self.classes)} classes"
                )
                raise AegisError(
                    found, "images, each with a label of the task", "check the task's folder"
                )


def has_one_gap(template: str) -> bool:
    """Whether `str.format` with one class fills the template; any other brace would break it."""
    without_gaps = template.replace("{}", "")
    return template.count("{}") == 1 and not set(without_gaps) & set("{}")


def _is_labelled(part: Part, classes: int) -> bool:
    """Whether there are images, and each label is one of `classes` classes."""
    if not len(part):
        return False
    return int(part.labels.min()) >= 0 and int(part.labels.max()) < classes
