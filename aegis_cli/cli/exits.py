"""How a command ends. Only this module turns errors into a message and an exit code.

Exit codes: 0 done, 1 a gate failed (`probe --max-drop`, `merge --max-drop`, `probe.max_drop` of
`run` and `probe`, `train --dry-run` if memory or disk are too small, `doctor`), 2 a problem that
the user can fix, 3 a defect of Aegis, with its traceback, 129 SIGHUP, 130 Ctrl-C, 141 nobody reads
the output, 143 SIGTERM.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import typer
from typer.core import TyperGroup

from aegis_cli.cli import other_trainers, render
from aegis_cli.common import interrupts, launch
from aegis_cli.common.errors import AegisError, PeerLost
from aegis_cli.common.home import word_at_home
from aegis_cli.recipes import Recipe
from aegis_cli.recipes.decoding import below

# What is added to a command to resume it; `run` skips stages that are up to date.
_WITH_RESUME = {"train": " --resume", "pretrain": " --resume", "run": ""}
_KEEPS = {  # what other commands do not measure again, if the cache can be written
    "anchor": (
        "all but the last of what is measured so far is kept, unless a warning says otherwise"
    ),
    "evaluate": "predictions so far are kept",
    "merge": "the strengths so far are kept",
    "probe": "answers so far are kept",
    "rollout": "episodes so far are kept",
}
# pydantic's names for a value of the wrong type -> the words for the user.
_NO_NUMBER = {
    "int_parsing": "no whole number",
    "int_from_float": "no whole number",
    "float_parsing": "no number",
}
GOES_ON = "aegis.goes_on"  # key of a function that returns the words to resume a run, or None
LIGHTER = "aegis.lighter"  # key of a function that returns those of commands that take less memory


class Commands(TyperGroup):
    """The commands, in the order of the pipeline, and the handling of their errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        args = [word_at_home(word) for word in args]
        ctx.meta["aegis.args"] = list(
            args
        )  # as typed, except for ~/; a copy, because click consumes its own list
        try:
            return super().parse_args(ctx, args)
        except OSError as error:  # from --help, whose output may go to a full disk
            raise typer.Exit(ended_by(error)) from None
        except Exception as error:
            # A usage error of click, or of the click that typer bundles.
            if hasattr(error, "show"):
                raise typer.Exit(_misused(error)) from None
            raise

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)  # in the order of the pipeline

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        found = super().resolve_command(ctx, args)
        if not ctx.resilient_parsing:  # set during shell completion
            _, command, rest = found
            _check_each_once(command, ctx, rest)
        return found

    def invoke(self, ctx: Any) -> Any:
        try:
            with interrupts.listening():
                return super().invoke(ctx)
        except AegisError as error:
            _say(render.error, error)
            raise typer.Exit(2) from None
        except OSError as error:
            raise typer.Exit(ended_by(error, ctx.meta)) from None
        except KeyboardInterrupt as error:
            number = error.number if isinstance(error, interrupts.Stopped) else signal.SIGINT
            _say(render.note, f"{_ended(number)}; {_what_now(ctx.meta)}")
            raise typer.Exit(128 + number) from None  # a shell's exit code for a signal
        except (typer.Exit, typer.Abort):  # these have an exit code, such as that of a failed gate
            raise
        except Exception as error:
            if hasattr(error, "show"):
                raise typer.Exit(_misused(error)) from None
            if _is_out_of_memory(error):
                _say(render.error, _too_large(error, ctx.meta))
                raise typer.Exit(2) from None
            traceback.print_exc()  # not re-raised: Python would exit with 1, the code of a gate
            raise typer.Exit(3) from None


def _check_each_once(command: Any, ctx: Any, args: Sequence[str]) -> None:
    """Raise AegisError if an option that takes a single value is given twice.

    Click would silently take the last one.
    """
    try:
        own = command.context_class(command, parent=ctx)
        _, _, order = command.make_parser(own).parse_args(list(args))
    except Exception as error:
        if hasattr(error, "show"):  # a usage error, which the command itself will report
            return
        raise
    given = set[str]()
    for option in order:
        single = option.param_type_name == "option" and option.nargs == 1 and not option.multiple
        if not single or getattr(option, "is_flag", False):  # a flag twice means the same
            continue
        if option.name in given:
            name = max(option.opts, key=len)
            raise AegisError(f"{name} twice", f"one {name}", "leave one of them out")
        given.add(option.name)


def _misused(error: Any) -> int:
    """Show click's own error for a misused command line, and return the exit code.

    Click itself would not handle a stderr that cannot be written.
    """
    _name_the_key(error)
    _name_the_value(error)
    _say(lambda misuse: misuse.show(), error)
    return error.exit_code


def _name_the_value(error: Any) -> None:
    """Add the value of an option to its error: pydantic, which typer uses, leaves it out."""
    problems = getattr(error.__cause__, "errors", None)
    if problems is None:
        return
    first = problems()[0]
    if first["type"] == "value_error":  # typer's own message for a choice, which has the value
        error.message = error.message.removeprefix("Value error, ")
    elif first["type"] in _NO_NUMBER:
        error.message = f"{first['input']!r} is {_NO_NUMBER[first['type']]}."


def _name_the_key(error: Any) -> None:
    """Suggest `--set` for a recipe key that was given as an option.

    Other training programs take their settings like this, as in `--batch_size=8`, or under other
    names.
    """
    option, context = getattr(error, "option_name", None), error.ctx
    if option is None or context is None:
        return
    if not any("--set" in parameter.opts for parameter in context.command.params):
        return
    keys = _keys_for(option.lstrip("-").replace("-", "_"))
    if keys:
        named = "a key of recipes" if len(keys) == 1 else "keys of recipes"
        error.message += f", but {named}: {' '.join(f'--set {key}=...' for key in keys)}"
        error.possibilities = None


def _keys_for(name: str) -> Sequence[str]:
    """The keys of a policy's recipe for an option of this name, here or in other programs."""
    if name in {field.name for field in dataclasses.fields(Recipe)}:
        return (name,)
    last = name.rpartition(".")[2]
    places = [place for place in below(last, Recipe) if name in (last, place)]
    if places:  # batch_size is a key of several sections
        return (min(places, key=lambda place: not place.startswith("train.")),)
    return other_trainers.KEYS.get(name, ())


def ended_by(error: OSError, meta: Mapping[str, Any] = MappingProxyType({})) -> int:
    """Report an error of the operating system, and return the exit code.

    Args:
        meta: of the command's context.
    """
    if error.errno == errno.EPIPE:  # as with `| head`, where the reader has stopped reading
        _close_output()
        return 128 + signal.SIGPIPE
    is_memory = error.errno == errno.ENOMEM
    _say(render.error, _too_large(error, meta) if is_memory else _refused(error))
    _close_output()
    return 2


def _close_output() -> None:
    """Discard output that cannot be written, as nobody reads it any more or the disk is full.

    Otherwise Python would report it at exit and change the exit code.
    """
    for stream in (sys.__stdout__, sys.__stderr__):
        if stream is None:
            continue
        with contextlib.suppress(OSError, ValueError):  # closed
            try:
                stream.flush()
            except OSError:
                # Redirected, since the stream still holds the output that it could not write.
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


# The first process reports problems of all processes at once. When it ends, torchrun ends the
# others, so a process that still runs after this time has a problem of its own. A process that has
# only lost another one waits longer.
_OWN_S, _LOST_S = 10.0, 20.0


def _say(show: Callable[[Any], None], what: Any) -> None:
    """Show a message to the user, whose terminal may be gone; the exit code remains."""
    if isinstance(what, PeerLost):
        time.sleep(_LOST_S)
    elif launch.rank() > 0:
        if show is render.note:  # a signal reaches all processes, and the first one reports it
            return
        time.sleep(_OWN_S)
    with contextlib.suppress(OSError, ValueError):  # ValueError: the file is closed
        show(what)
        return
    _close_output()


# Messages of torch and the C library (RuntimeError) and of the linker (ImportError) for too little
# memory. The linker's message is longer for a library that is not for this machine, or on a disk
# without permission to execute.
_WANTING = ("DefaultCPUAllocator", "Cannot allocate memory", "std::bad_alloc", "new thread")
_UNMAPPED = ("failed to map segment from shared object", "cannot allocate memory")


def _is_out_of_memory(error: Exception) -> bool:
    """Whether there was too little memory, including that of a GPU.

    torch's exception is recognized by its name, because importing torch takes seconds.
    """
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, ImportError):
        return str(error).lower().endswith(_UNMAPPED)
    return isinstance(error, RuntimeError) and any(word in str(error) for word in _WANTING)


def _too_large(error: Exception, meta: Mapping[str, Any]) -> AegisError:
    said = (str(error).splitlines() or [""])[0]
    fix = (
        "use a smaller --batch-size or --set train.batch_size=..., fewer train.flow_samples or "
        "--workers, or train.gradient_checkpointing or train.accumulate; see --dry-run"
    )
    if commands := _lighter(meta.get(LIGHTER)):
        fix = (
            f"resume in less memory: {', or '.join(commands)}; a smaller train.batch_size or fewer "
            "train.flow_samples make another run (--overwrite, or another --out)"
        )
    return AegisError(f"out of memory{': ' * bool(said)}{said}", "work that fits in memory", fix)


def _refused(error: OSError) -> AegisError:
    """The AegisError for an error of the operating system that no stage expected.

    Examples are a file name that is too long, or a folder without read permission.
    """
    if error.filename == render.STDOUT:  # set by `render.name_errors`
        return AegisError(
            f"{render.STDOUT} cannot be written: {error.strerror}",
            "an output that can be written to",
            "free some space on its disk, or redirect the output elsewhere",
        )
    found = str(error) if error.filename is None else f"'{error.filename}': {error.strerror}"
    fix = "check the path, the permissions of its folders (ls -ld) and the space on its disk"
    return AegisError(found, "a path that can be used", fix)


def _ended(number: int) -> str:
    """How a command was ended, in words."""
    return "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"


def _what_now(meta: Mapping[str, Any]) -> str:
    """What an interrupted command has left, and the command to resume it or start again."""
    args = meta["aegis.args"]
    if args[0] == "serve":  # it usually ends by Ctrl-C
        return "the server is closed"
    flag = _WITH_RESUME.get(args[0])
    if flag is None or "--dry-run" in args:
        again = f"{_program()} {shlex.join(args)}"
        # A merge with a single strength is not a sweep and keeps nothing.
        if args[0] in _KEEPS and not any(word.startswith("--strength") for word in args):
            return f"{_KEEPS[args[0]]}; go on with: {again}"
        return f"no half-written file is left; begin again with: {again}"
    alone = _alone(meta.get(GOES_ON))
    if alone is not None:
        return f"resume with: {_program()} {shlex.join(alone)}"
    args = [word for word in args if word != "--overwrite"]  # which would start again
    command = f"{_program()} {shlex.join(args)}"
    if flag.strip() not in args:
        command += flag
    return f"resume with: {command}"


def _alone(goes_on: Callable[[], list[str] | None] | None) -> list[str] | None:
    """The words to resume a run from its folder alone; None if the folder does not suffice."""
    if goes_on is None:
        return None
    try:
        return goes_on()
    except AegisError:  # the folder holds another run; the same command will report it
        return None


def _lighter(found: Callable[[], list[list[str]]] | None) -> list[str]:
    """The commands that resume a run in less memory; none if it cannot be resumed."""
    if found is None:
        return []
    try:
        return [f"{_program()} {shlex.join(words)}" for words in found()]
    except AegisError:
        return []


def _program() -> str:
    """How the command was started: alone, or as several processes on one or more machines."""
    if launch.world_size() == 1:
        return "aegis"
    here = launch.local_world_size()
    machines = launch.world_size() // here
    more = f" --nnodes {machines}" if machines > 1 else ""
    return f"torchrun{more} --nproc-per-node {here} -m aegis_cli"
