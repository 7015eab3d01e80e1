"""Whether a model knows enough about some questions for a drop in accuracy to be meaningful."""

from __future__ import annotations

from aegis_cli.common.events import OnEvent, Warned
from aegis_cli.data.vqa import sets


def warn_if_little(
    accuracy: float, majority: float, model: str, ask: str, stage: str, on_event: OnEvent
) -> None:
    """Warn if a drop means nothing, because the questions were not answered before training either.

    Args:
        accuracy: of the model before training, in [0, 1].
        majority: accuracy of always giving a family's most common answer, in [0, 1].
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
