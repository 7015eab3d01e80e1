"""One of several processes leads a job, and calls the others for the parts that all share.

A job such as `aegis run` has parts for one process, such as recording demonstrations, and parts
that several processes do together, such as training. The first process goes through the whole job.
The others wait, as long as it takes, until it names a function that all of them call.
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
    """A module-level function that all processes are to call with these arguments."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    options: dict[str, Any]


@dataclass(frozen=True)
class _End(Generic[T]):
    """The end of the job, with its report."""

    report: T


@dataclass(frozen=True)
class _Failure:
    """The error that ended the job."""

    error: AegisError


@dataclass
class _Lead:
    """The first process's view of the others.

    Attributes:
        listening: whether they wait for a message. They do not while they call a function, nor
            after one has failed, because it may have failed in them too.
    """

    ranks: Ranks
    listening: bool = True

    def tell(self, word: _Call | _End[Any] | _Failure) -> None:
        """Tell the others what comes next."""
        self.ranks.agree(word)

    @contextmanager
    def calling(self) -> Generator[None]:
        """Run the block together with the others, which were called to it."""
        self.listening = False
        with among(self.ranks):
            yield
        self.listening = True


_lead: _Lead | None = None  # for a job that this process leads


def led(job: Callable[[], T]) -> T:
    """Let the first process do the job, and the others what it calls them for.

    Returns:
        The job's report, in every process.

    Raises:
        AegisError: the job's error, in every process; or another process has ended.
    """
    with joined() as ranks:
        if not ranks.several:
            return job()
        return _led(job, _Lead(ranks)) if ranks.first else _follow(ranks)


def _led(job: Callable[[], T], lead: _Lead) -> T:
    try:
        # Alone, so that what the job does by itself does not ask other processes for a share.
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
    """Do what the first process asks for, until the job ends."""
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
    """Call a function, in all processes if this one leads a job; each then takes its share.

    Args:
        function: a module-level function, which finds the other processes by `joined`.
        arguments, options: its arguments. They are sent, so they must be picklable.
        on_event: called only in this process.

    Returns:
        The result in this process.
    """
    if _lead is None:
        return function(*arguments, on_event=on_event, **options)
    _lead.tell(_Call(function, arguments, options))
    with _lead.calling():
        return function(*arguments, on_event=on_event, **options)
