"""`python -m aegis_cli` is the command where its script is not on the path.

What starts modules (torchrun, debuggers) uses it too.
"""

from aegis_cli.cli.app import main

if __name__ == "__main__":
    main()
