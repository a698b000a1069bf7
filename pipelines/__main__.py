"""`python -m pipelines experiment=NAME [KEY=VALUE ...]`; `-m` before it for sweeps, `--help` for all keys."""

import sys

from pipelines.app import main
from pipelines.registry import APPLICATION

if __name__ == "__main__":
    sys.exit(main(APPLICATION))
