"""Where a result comes from: versions, host, commit, seeds; and making a process deterministic before it builds."""

from __future__ import annotations

import logging
import os
import platform
import random
import subprocess
import sys
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("zsdt", "numpy", "scipy", "numba", "torch", "lightning", "h5py", "hydra-core", "omegaconf", "rerun-sdk")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


def provenance() -> dict[str, Any]:
    """Versions of Python and of the packages that make numbers, host, processor count, and the git commit."""
    return {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "host": platform.node(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "git_commit": git_commit(),
        "command": sys.argv,
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed as a package"


def git_commit() -> str:
    """Commit of the working tree with ``+changes`` where files differ from it; ``unknown`` outside of a clone."""
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True, timeout=20)
        return done.stdout.strip()

    try:
        commit = git("rev-parse", "HEAD")
        return commit + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def commit_words(commit: str | None = None) -> str:
    """A commit (default: `git_commit` now) as pages name it: short, and whether files differed from it."""
    name, changed, _ = (git_commit() if commit is None else commit).partition("+")
    return name[:12] + (" with uncommitted changes" if changed else "")


def set_thread_environment(threads: int) -> None:
    """Limits BLAS, OpenMP and numba of this process and its children; counts only before those are imported.

    Variables that the user has set are left as they are.
    """
    for name in THREAD_VARIABLES:
        os.environ.setdefault(name, str(threads))


def make_deterministic(seed: int, threads: int) -> None:
    """Seeds Python, numpy and torch, and asks torch for deterministic kernels on `threads` threads."""
    import torch

    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002  (libraries that still use the global generator)
    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.set_num_threads(threads)
