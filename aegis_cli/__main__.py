"""The command's entry: the script `aegis`, and `python -m aegis_cli` where it is not on the path.

What starts modules (torchrun, debuggers) uses the latter too.
"""

from aegis_cli.common import garbage, interrupts


def main() -> None:
    """Listen to Ctrl-C, then load the commands, which takes a moment, and run one."""
    interrupts.leave_at_ctrl_c()
    with garbage.left_out():
        from aegis_cli.cli import app

    app.main()


if __name__ == "__main__":
    main()
