"""Whether a model knows enough of some questions for a drop in accuracy to mean anything."""

from __future__ import annotations

from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.data.vqa import sets


def warn_if_little(
    accuracy: float, majority: float, model: str, ask: str, stage: str, on_event: OnEvent
) -> None:
    """Warn where a drop says nothing, since the questions were not answered before either.

    Args:
        accuracy: of the model before its training, in [0, 1].
        majority: what always giving a family's commonest answer would have, in [0, 1].
        model: its name.
        ask: how the questions were asked.
    """
    if accuracy >= majority:
        return
    text = (
        f"'{model}' answers {100 * accuracy:.1f} % of these questions, and always the commonest "
        f"answer of their family would answer {100 * majority:.1f} %: it can hardly lose "
        "what it does not know. "
    )
    if ask == sets.PLAIN:
        text += (
            "A model that answers in sentences needs e.g. --ask '{} Answer with a single word or "
            "phrase.' (anchor.ask and probe.ask in a recipe)"
        )
    else:
        text += (
            f"They were asked as '{ask}': see what it answers (--predictions of aegis probe), or "
            "ask in the way that its own documentation has"
        )
    on_event(Warned(stage, text))
