"""The official rules for comparing answers, on cases worked out by hand."""

from __future__ import annotations

import random
from itertools import combinations

import pytest

from aegis_cli.data.vqa.answers import normalise, reference, soft_accuracy

WORDS = ("red", "dog's", "t-shirt", "Two", "2", "the", "yes", "p.m.", "1,000", "isnt", "b/w")


@pytest.mark.parametrize(
    ("answer", "compared"),
    [
        # case and space
        ("Red", "red"),
        ("  light \n\tblue ", "light blue"),
        # articles
        ("a dog", "dog"),
        ("The dog on an island", "dog on island"),
        ("anthem", "anthem"),
        ("the", "the"),
        # number words
        ("two", "2"),
        ("Ten dogs", "10 dogs"),
        ("zero", "0"),
        ("none", "0"),
        ("eleven", "eleven"),
        ("someone", "someone"),
        # contractions that lost an apostrophe; one that has it keeps it
        ("dont", "don't"),
        ("Don't", "don't"),
        ("isnt it", "isn't it"),
        ("couldnt've", "couldn't've"),
        ("couldn'tve", "couldn't've"),
        ("oclock", "o'clock"),
        ("yall'd've", "y'all'd've"),
        ("well", "well"),
        ("dog's", "dog's"),
        # a mark inside a word splits it, one at its edge is removed
        ("t-shirt", "t shirt"),
        ("black/white", "black white"),
        ("red, white", "red white"),
        ("red,white", "red white"),
        ("yes!", "yes"),
        ("yes !", "yes"),
        ("(left) side", "left side"),
        ("what?", "what"),
        # a comma between digits joins, and so do all other marks there
        ("1,000", "1000"),
        ("1,000-2,000", "10002000"),
        # periods, but not decimal points
        ("no.", "no"),
        ("5 p.m.", "5 pm"),
        ("2.5", "2.5"),
        ("u.s.a.", "usa"),
        (".5", ".5"),
        # colons and apostrophes do not count as marks
        ("6:30", "6:30"),
        ("dogs'", "dogs'"),
        # if nothing would remain, it stays
        ("A", "a"),
        ("the", "the"),
        (" + ", "+"),
        ("?", "?"),
        ("", ""),
    ],
)
def test_normalisation(answer: str, compared: str) -> None:
    assert normalise(answer) == compared


def test_case_spaces_and_articles_never_count() -> None:
    rng = random.Random(0)
    for _ in range(300):
        words = [*rng.choices(WORDS, k=rng.randint(0, 3)), "cat"]  # so that some word is no article
        spaced = rng.choice(("a ", "The  ", "\tan ", " ")) + "  ".join(words).upper() + "\n"
        assert normalise(spaced) == normalise(" ".join(words))


@pytest.mark.parametrize(
    ("people", "score"), [(0, 0.0), (1, 0.3), (2, 0.6), (3, 0.9), (4, 1.0), (7, 1.0), (10, 1.0)]
)
def test_soft_accuracy_of_ten_answers(people: int, score: float) -> None:
    """By hand, for two people of ten: (2/3 + 8 * 2/3) / 10.

    Without one of the two, one is left, min(1/3, 1); without one of the others, two are left.
    """
    answers = ["Red."] * people + [f"other {i}" for i in range(10 - people)]
    assert soft_accuracy("a red", answers) == pytest.approx(score)


def test_soft_accuracy_is_the_mean_over_the_subsets_without_one_person() -> None:
    rng = random.Random(1)
    for _ in range(200):
        answers, said = rng.choices(WORDS, k=rng.randint(2, 12)), rng.choice(WORDS)
        left = list(
            combinations([normalise(a) == normalise(said) for a in answers], len(answers) - 1)
        )
        assert soft_accuracy(said, answers) == pytest.approx(
            sum(min(1, sum(s) / 3) for s in left) / len(left)
        )


def test_one_persons_answer_is_right_or_wrong() -> None:
    assert soft_accuracy("two", ["2"]) == 1 and soft_accuracy("three", ["2"]) == 0


@pytest.mark.parametrize(
    ("answers", "chosen"),
    [
        (["red"], "red"),
        (["blue", "red", "red"], "red"),
        (["blue", "red", "Red.", "blue"], "blue"),  # equally common: the first one wins
        (
            ["gray", "Two", "2", "the two"],
            "Two",
        ),  # three ways of writing one answer, as the first wrote it
    ],
)
def test_the_reference_is_the_commonest_answer(answers: list[str], chosen: str) -> None:
    assert reference(answers) == chosen
