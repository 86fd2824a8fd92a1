"""``python -m glintrack``: the command line."""

from glintrack.cli.app import program

if __name__ == "__main__":
    program()
