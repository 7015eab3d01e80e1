"""Words to ids for the embedded models: the vocabulary is closed; unknown words are errors."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from aegis_cli.common.errors import AegisError

PAD, ANSWER, END = "<pad>", "<answer>", "<end>"
SPECIAL = (PAD, ANSWER, END)


class Tokenizer:
    """Splits on spaces, and at question marks if it knows them.

    `vocabulary` holds the special tokens first.

    Raises:
        ValueError: it holds something else than words, or lacks the special tokens.
    """

    def __init__(self, vocabulary: Sequence[str]) -> None:
        others = [word for word in vocabulary if type(word) is not str]
        if others:
            raise ValueError(f"a vocabulary has words, not {others[0]!r}")
        if tuple(vocabulary[: len(SPECIAL)]) != SPECIAL:
            raise ValueError(f"a vocabulary starts with {SPECIAL}, not {tuple(vocabulary[:3])}")
        self.vocabulary = tuple(vocabulary)
        self._ids = {word: i for i, word in enumerate(self.vocabulary)}
        self.pad, self.answer, self.end = (self._ids[token] for token in SPECIAL)

    def encode(self, text: str) -> list[int]:
        """Ids of the words of `text`.

        Raises:
            AegisError: a word that is not in the vocabulary.
        """
        marked = text.replace("?", " ? ") if "?" in self._ids else text
        words = marked.lower().split()
        unknown = [word for word in words if word not in self._ids or word in SPECIAL]
        if unknown:
            close = difflib.get_close_matches(unknown[0], self.vocabulary[len(SPECIAL) :], n=1)
            known = len(self.vocabulary) - len(SPECIAL)
            fix = "rephrase with words such as: " + ", ".join(self.vocabulary[3:11])
            if close:
                fix = f"did you mean '{close[0]}'?"
            raise AegisError(
                f"the word '{unknown[0]}' in '{text}'",
                f"words among the {known} that the embedded model knows",
                f"{fix}; texts of any words need a Hugging Face model as the backbone",
            )
        return [self._ids[word] for word in words]

    def prompt(self, text: str) -> list[int]:
        """The ids of a question or instruction, ending with the token that an answer follows."""
        return [*self.encode(text), self.answer]

    def decode(self, ids: Sequence[int]) -> str:
        """The words before the first end token."""
        words = []
        for i in ids:
            if i == self.end:
                break
            words.append(self.vocabulary[i])
        return " ".join(words)
