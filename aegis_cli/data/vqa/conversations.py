"""Conversations about a picture, as in instruction data of VLMs: each turn is a question.

Three forms are read, by the keys of a turn: `user` and `assistant` (The Cauldron, FineVision),
`from` and `value` (LLaVA), or `role` and `content` (chat messages, as in TRL).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from aegis_cli.data.vqa.entries import ANSWERS, bad, make_question
from aegis_cli.data.vqa.questions import Question

# The possible keys of a conversation; the first one present is used.
KEYS = ("texts", "conversations", "messages")
_MARKER = "<image>"  # the picture's place in a text
_PLACE = re.compile(rf"\s*{_MARKER}\s*")
_ASKS, _ANSWERS = ("human", "user"), ("gpt", "assistant")
_EXPECTED = (
    "turns such as {user, assistant}, {from: human, value} or {role: user, content}, each question "
    "with its answer"
)


def key_of(names: Sequence[str] | Mapping[str, Any]) -> str | None:
    """The key of a row's or line's conversation; None if it asks a single question."""
    for answers in ANSWERS:
        if answers in names:
            return None
    for key in KEYS:
        if key in names:
            return key
    return None


def questions(where: str, turns: Any, name: str | int, source: Any) -> list[Question]:
    """A question for each turn, asked separately: earlier turns are not repeated.

    Args:
        turns: the conversation.
        name: of its row; several questions each get a number appended.
        source: the row's source, which determines the family; None without one.

    Raises:
        AegisError: this is no conversation, or a turn has no answer.
    """
    pairs = _pairs(where, turns)
    several = len(pairs) > 1
    asked = []
    for number, (text, answer, own) in enumerate(pairs, start=1):
        taken = own if _is_name(own) else source
        family = taken if _is_name(taken) else "all"
        named = f"{name}.{number}" if several else name
        asked.append(make_question(where, text, answer, named, family))
    return asked


def one_picture(where: str, pictures: Any) -> Any:
    """The picture of a row that lists its pictures.

    Raises:
        AegisError: it has none, or several.
    """
    if not isinstance(pictures, list):
        return pictures
    if len(pictures) != 1:
        raise bad(
            where,
            f"a list of {len(pictures)} images",
            "one image of each question",
            "name the one that is asked about, or join them into one picture",
        )
    return pictures[0]


def _pairs(where: str, turns: Any) -> list[tuple[Any, Any, Any]]:
    """Question, answer and source of each turn."""
    if (plain := _plain(turns)) is not None:
        return plain
    if isinstance(turns, dict) and all(isinstance(column, list) for column in turns.values()):
        # Older versions of `datasets` store lists of objects as columns.
        rows = zip(*turns.values(), strict=False)
        turns = [dict(zip(turns, row, strict=True)) for row in rows]
    if not isinstance(turns, list) or not turns or not all(isinstance(t, dict) for t in turns):
        found = "an empty conversation" if turns == [] else f"a conversation that is {_kind(turns)}"
        raise bad(where, found, _EXPECTED, "correct the row")
    if all("user" in turn and "assistant" in turn for turn in turns):
        return [(_text(t["user"]), _text(t["assistant"]), t.get("source")) for t in turns]
    said = [_said(where, turn) for turn in turns]
    said = [each for each in said if each[0] != "system"]
    asks, answers = said[::2], said[1::2]
    in_turn = all(speaker in _ASKS for speaker, _ in asks)
    answered = all(speaker in _ANSWERS for speaker, _ in answers)
    if not asks or len(asks) != len(answers) or not in_turn or not answered:
        order = ", ".join(speaker for speaker, _ in said) or "no turn"
        raise bad(where, f"a conversation of {order}", _EXPECTED, "correct the row")
    return [(ask, answer, None) for (_, ask), (_, answer) in zip(asks, answers, strict=True)]


def _plain(turns: Any) -> list[tuple[Any, Any, Any]] | None:
    """The same for turns of a speaker and a text, as nearly all are; None for any others."""
    if type(turns) is not list or not turns or len(turns) % 2:
        return None
    said = []
    for number, turn in enumerate(turns):
        if type(turn) is not dict or len(turn) != 2:
            return None
        if "from" in turn and "value" in turn:
            speaker, text = turn["from"], turn["value"]
        elif "role" in turn and "content" in turn:
            speaker, text = turn["role"], turn["content"]
        else:
            return None
        if type(text) is not str or speaker not in (_ANSWERS if number % 2 else _ASKS):
            return None
        said.append(_text(text))
    return [(ask, answer, None) for ask, answer in zip(said[::2], said[1::2], strict=True)]


def _said(where: str, turn: dict[str, Any]) -> tuple[str, Any]:
    """The speaker of a turn, and the text."""
    speaker, content = turn.get("from", turn.get("role")), turn.get("value", turn.get("content"))
    if not isinstance(speaker, str):
        raise bad(
            where, f"a turn with {', '.join(turn) or 'nothing'}", _EXPECTED, "correct the row"
        )
    if isinstance(content, list):  # pieces of text and of pictures
        content = " ".join(
            str(piece.get("text") or "") for piece in content if isinstance(piece, dict)
        )
    return speaker, _text(content)


def _kind(turns: Any) -> str:
    """What is there instead of a conversation."""
    if isinstance(turns, list):
        return f"a list of {type(turns[0]).__name__}"
    return "nothing" if turns is None else f"a {type(turns).__name__}"


def _text(said: Any) -> Any:
    """A text without its image markers."""
    if not isinstance(said, str):
        return said
    # Most texts have no marker, and the pattern would try every space.
    return (_PLACE.sub(" ", said) if _MARKER in said else said).strip()


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)
