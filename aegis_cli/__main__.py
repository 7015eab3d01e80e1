"""`python -m aegis_cli`: the command where its script is not on the path, and for what starts
modules (torchrun, debuggers).
"""

from aegis_cli.cli.app import main

if __name__ == "__main__":
    main()
