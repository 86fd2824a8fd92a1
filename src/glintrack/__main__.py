"""``python -m glintrack``: the command line."""

from glintrack.cli.app import main

if __name__ == "__main__":
    main()
