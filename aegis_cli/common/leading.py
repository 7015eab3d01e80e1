"""One of several processes leads a job, and calls the others to those parts that all share.

A job such as `aegis run` has parts for one process, such as to record demonstrations, and others
that several do together, such as a training. The first process goes through the whole job. The
others wait, as long as it takes, until it names a function that all call.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from aegis_cli.common.errors import AegisError
from aegis_cli.common.events import OnEvent, ignore
from aegis_cli.common.ranks import ALONE, Ranks, among, joined

T = TypeVar("T")


@dataclass(frozen=True)
class _Call:
    """A function of a module, which all processes are to call with these arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    options: dict[str, Any]


@dataclass(frozen=True)
class _End(Generic[T]):
    """What the job has led to."""

    report: T


@dataclass(frozen=True)
class _Failure:
    """What is wrong with the job."""

    error: AegisError


@dataclass
class _Lead:
    """The first process's view of the others.

    Attributes:
        listening: whether they wait for a word. While they call a function they do not; nor after
            one has failed, for it may have failed in them too.
    """

    ranks: Ranks
    listening: bool = True

    def tell(self, word: _Call | _End[Any] | _Failure) -> None:
        """Say to the others what comes next."""
        self.ranks.agree(word)

    @contextmanager
    def calling(self) -> Generator[None]:
        """Do the block together with the others, which are called to it."""
        self.listening = False
        with among(self.ranks):
            yield
        self.listening = True


_lead: _Lead | None = None  # of a job that this process leads


def led(job: Callable[[], T]) -> T:
    """Let the first process do the job, and the others what it calls them to.

    Returns:
        The job's report, in every process.

    Raises:
        AegisError: whatever is wrong, in every process; or another process has ended.
    """
    with joined() as ranks:
        if not ranks.several:
            return job()
        return _led(job, _Lead(ranks)) if ranks.first else _follow(ranks)


def _led(job: Callable[[], T], lead: _Lead) -> T:
    try:
        # Alone, so that what the job does by itself asks nobody to take a share.
        with _leading(lead), among(ALONE):
            report = job()
    except AegisError as error:
        if lead.listening:
            lead.tell(_Failure(error))
        raise
    lead.tell(_End(report))
    return report


@contextmanager
def _leading(lead: _Lead) -> Generator[None]:
    """Let `together` find the others inside the block."""
    global _lead
    _lead = lead
    try:
        yield
    finally:
        _lead = None


def _follow(ranks: Ranks) -> Any:
    """Do what the first process says, until the job ends."""
    while True:
        word = ranks.agree(None)
        if isinstance(word, _Failure):
            raise word.error
        if isinstance(word, _End):
            return word.report
        assert isinstance(word, _Call)
        word.function(*word.arguments, on_event=ignore, **word.options)


def together(
    function: Callable[..., T], *arguments: Any, on_event: OnEvent = ignore, **options: Any
) -> T:
    """Call a function, with all others where this process leads a job; each then takes its share.

    Args:
        function: of a module, which finds the others by `joined`.
        arguments, options: what it is called with. They travel, so they have to be such that they
            can be pickled.
        on_event: told by this process alone.

    Returns:
        What it returns in this process.
    """
    if _lead is None:
        return function(*arguments, on_event=on_event, **options)
    _lead.tell(_Call(function, arguments, options))
    with _lead.calling():
        return function(*arguments, on_event=on_event, **options)
