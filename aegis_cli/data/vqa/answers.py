"""How people's answers are compared, by the rules of VQA's official evaluation (arXiv 1505.00468).

Two differences to its code, and none to its text: an answer is always normalised, also where all
people said the same; and one of which nothing would be left, such as the letter A or a plus sign,
stays as it is, or to say nothing would be right.
"""

from __future__ import annotations

import re
from collections import Counter
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
    """The contraction for each way to write it with an apostrophe forgotten."""
    # This entry is a slip of the official table; scores stay comparable only with it.
    table = {"somebody'd": "somebodyd"}
    for word in _APOSTROPHES.split():
        for i, letter in enumerate(word):
            if letter == "'":
                table[word[:i] + word[i + 1 :]] = word
    return table


_CONTRACTIONS = _contractions()


@lru_cache(maxsize=1 << 16)  # people give few different answers to many questions
def normalise(answer: str) -> str:
    """An answer in the form in which answers are compared.

    It has lower case, no punctuation, digits for number words, no articles, and its apostrophes
    restored. An answer of articles and punctuation alone keeps them.
    """
    spaced = " ".join(answer.split())
    # The official order: marks, number words, articles, and apostrophes at last.
    words = [_NUMBERS.get(word, word) for word in _strip_marks(spaced).lower().split()]
    kept = [word for word in words if word not in _ARTICLES]
    said = " ".join(_CONTRACTIONS.get(word, word) for word in kept)
    return said or spaced.lower()


def _strip_marks(text: str) -> str:
    """The words without punctuation.

    Marks at a word's edge vanish, and those inside a word split it. If a comma stands between
    digits anywhere, every mark vanishes, so that the digits join.
    """
    number, bare = re.search(r"\d,\d", text), text
    for mark in _MARKS:
        vanishes = number or f"{mark} " in text or f" {mark}" in text
        bare = bare.replace(mark, "" if vanishes else " ")
    return re.sub(r"\.(?!\d)", "", bare)  # a decimal point stays


def reference(answers: Sequence[str]) -> str:
    """The answer that most people gave, as the first of them wrote it.

    Among equally common answers it is the first.
    """
    if len(answers) == 1:  # as in all 48,000 of easy-VQA
        return answers[0]
    forms = [normalise(answer) for answer in answers]
    commonest = Counter(forms).most_common(1)[0][0]  # insertion order breaks ties
    return answers[forms.index(commonest)]


def soft_accuracy(said: str, answers: Sequence[str]) -> float:
    """min(people who said it / 3, 1), averaged over the subsets that leave one person out.

    With one person it is whether the two are equal.

    With the official ten answers 1, 2, 3 and 4 people who said it make 0.3, 0.6, 0.9 and 1. With
    two or three answers none reaches 1, as few people cannot agree more.
    """
    matches = [normalise(answer) == normalise(said) for answer in answers]
    if len(matches) == 1:
        return float(matches[0])
    # Without one person, those who said it are one fewer if that person did.
    without_each = [min(1.0, (sum(matches) - match) / 3) for match in matches]
    return sum(without_each) / len(matches)
