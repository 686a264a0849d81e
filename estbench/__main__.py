"""`python -m estbench` is the command line."""

from estbench.commands.cli import main

if __name__ == "__main__":
    main()
