"""Compare people's answers by the rules of VQA's official evaluation (arXiv 1505.00468).

There are two differences from its code, and none from its text: an answer is always normalised,
even if all people gave the same; and an answer that would become empty, such as the letter A or a
plus sign, stays as it is, since otherwise an empty answer would count as correct.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

_MARKS = ';/[]"{}()=+\\_-><@`,?!'
_NUMBERS = {"none": "0"} | {
    word: str(i)
    for i, word in enumerate("zero one two three four five six seven eight nine ten".split())
}
_ARTICLES = {"a", "an", "the"}
_APOSTROPHES = (
    "ain't aren't can't could've couldn't couldn't've didn't doesn't don't hadn't hadn't've "
    "hasn't haven't he'd he'd've he's how'd how'll how's isn't it'd it'd've it'll ma'am mightn't "
    "mightn't've might've mustn't must've needn't not've o'clock oughtn't 'ow's'at shan't "
    "she'd've should've shouldn't shouldn't've somebody'd've somebody'll somebody's someone'd "
    "someone'd've someone'll someone's something'd something'd've something'll that's there'd "
    "there'd've there're there's they'd they'd've they'll they're they've 'twas wasn't we'd've "
    "we've weren't what'll what're what's what've when's where'd where's where've who'd who'd've "
    "who'll who's who've why'll why're why's won't would've wouldn't wouldn't've y'all y'all'll "
    "y'all'd've you'd you'd've you'll you're you've"
)


def _contractions() -> dict[str, str]:
    """Each contraction by the spellings that lack an apostrophe."""
    # This entry is an error in the official table; it is kept for comparable scores.
    table = {"somebody'd": "somebodyd"}
    for word in _APOSTROPHES.split():
        for i, letter in enumerate(word):
            if letter == "'":
                table[word[:i] + word[i + 1 :]] = word
    return table


_CONTRACTIONS = _contractions()


@lru_cache(maxsize=1 << 16)  # many questions have few different answers
def normalise(answer: str) -> str:
    """An answer in its normal form, for comparison.

    That is lower case, without punctuation and articles, with digits for number words and
    apostrophes restored. An answer of only articles and punctuation keeps them.
    """
    spaced = " ".join(answer.split())
    # The official order: punctuation, number words, articles, and last the apostrophes.
    words = [_NUMBERS.get(word, word) for word in _strip_marks(spaced).lower().split()]
    kept = [word for word in words if word not in _ARTICLES]
    said = " ".join(_CONTRACTIONS.get(word, word) for word in kept)
    return said or spaced.lower()


def _strip_marks(text: str) -> str:
    """The words without punctuation.

    Marks at the edge of a word are removed, and those inside a word split it. If a comma stands
    between digits anywhere, every mark is removed, so that the digits join.
    """
    number, bare = re.search(r"\d,\d", text), text
    for mark in _MARKS:
        vanishes = number or f"{mark} " in text or f" {mark}" in text
        bare = bare.replace(mark, "" if vanishes else " ")
    return re.sub(r"\.(?!\d)", "", bare)  # a decimal point stays


def reference(answers: Sequence[str]) -> str:
    """The most common answer, as the first person wrote it.

    Among equally common answers it is the first.
    """
    if len(answers) == 1:  # as in all 48,000 of easy-VQA
        return answers[0]
    forms = [normalise(answer) for answer in answers]
    counts = dict.fromkeys(forms, 0)
    for form in forms:
        counts[form] += 1
    commonest = max(counts, key=counts.__getitem__)  # insertion order breaks ties
    return answers[forms.index(commonest)]


def soft_accuracy(said: str, answers: Sequence[str]) -> float:
    """min(people who said it / 3, 1), averaged over the subsets that leave one person out.

    With one person it is 1 if the two are equal, else 0.

    With the official ten answers, 1, 2, 3 and 4 people who said it give 0.3, 0.6, 0.9 and 1. With
    two or three answers the score never reaches 1, since so few people cannot agree more.
    """
    matches = [normalise(answer) == normalise(said) for answer in answers]
    if len(matches) == 1:
        return float(matches[0])
    # Leaving one person out removes one match if that person said it.
    without_each = [min(1.0, (sum(matches) - match) / 3) for match in matches]
    return sum(without_each) / len(matches)
