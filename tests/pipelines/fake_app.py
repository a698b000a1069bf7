"""Command line of the fake experiment; a file of its own because workers import the stages by their module."""

import sys

from fakes import FAKE

from pipelines.app import main

if __name__ == "__main__":
    sys.exit(main(FAKE))
