"""How a command ends: errors become one message and an exit code, here and nowhere else.

Exit codes: 0 done, 1 a gate failed (`probe --max-drop`, `merge --max-drop`, `probe.max_drop` of
`run`, `train --dry-run` where memory or disk are too small), 2 a problem to act on, 3 a defect of
Aegis, with its traceback, 130 Ctrl-C.
"""

from __future__ import annotations

import errno
import shlex
import traceback
from typing import Any

import typer
from typer.core import TyperGroup

from aegis_cli.cli import render
from aegis_cli.common.errors import AegisError

_WITH_RESUME = {
    "train": " --resume",
    "pretrain": " --resume",
    "run": "",
}  # `run` skips what is up to date


class Commands(TyperGroup):
    """The commands, in the order of the pipeline, and what becomes of their errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta["aegis.args"] = list(args)
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        return list(self.commands)  # in the order of the pipeline

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except AegisError as error:
            render.error(error)
            raise typer.Exit(2) from None
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise  # nobody reads the output any more: click ends quietly
            render.error(_refused(error))
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            render.note("interrupted" + _resume_hint(ctx.meta["aegis.args"]))
            raise typer.Exit(130) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if hasattr(error, "show"):
                raise  # click's own, of a misused command line, which it prints itself
            if _is_out_of_memory(error):
                render.error(_too_large(error))
                raise typer.Exit(2) from None
            traceback.print_exc()  # Python's own exit code for it is that of a failed gate
            raise typer.Exit(3) from None


def _is_out_of_memory(error: Exception) -> bool:
    """The GPU's too, whose class torch has; importing that takes seconds."""
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError"


def _too_large(error: Exception) -> AegisError:
    said = (str(error).splitlines() or [""])[0]
    fix = (
        "a smaller --batch-size or --set train.batch_size=..., fewer --workers, or "
        "train.gradient_checkpointing; see --dry-run"
    )
    return AegisError(f"out of memory{': ' * bool(said)}{said}", "work that fits", fix)


def _refused(error: OSError) -> AegisError:
    """The error for what the system would not do, where no stage expected it.

    Examples are a name too long, or a folder that may not be looked into.
    """
    found = str(error) if error.filename is None else f"'{error.filename}': {error.strerror}"
    fix = "check the path, the permissions of its folders (ls -ld) and the space on its disk"
    return AegisError(found, "a path that can be used", fix)


def _resume_hint(args: list[str]) -> str:
    flag = _WITH_RESUME.get(args[0])
    if flag is None:
        return ""
    return f"; resume with: aegis {shlex.join(args)}" + ("" if flag.strip() in args else flag)
