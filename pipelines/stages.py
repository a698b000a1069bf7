"""What a stage is, and how the stages of an experiment hang together.

The registry is data: a list of `Stage`. A stage sees only the parts of the config that it names in `reads` (plus
`machine`, which says where and how fast but never what), so its key cannot forget anything.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pipelines.store import MANIFEST, artifact_key, digest_of_files
from zsdt.errors import DataError, OptionError

PIECE = "piece."  # how the roles of pieces begin
Run = Callable[[SimpleNamespace, dict[str, Path], Path, Path], dict[str, Any]]


@dataclass(frozen=True)
class Stage:
    """One step of an experiment.

    name: what people type in ``stages=[...]``.
    version: to be raised when the code makes other numbers of the same options.
    reads: top-level parts of the config that the result depends on.
    run(cfg, inputs, out, scratch) -> figures: does the work; `inputs` are folders by role.
    inputs: names, or roles, of the stages whose artifacts it needs, or what names them for a config; those that do not
        apply are left out.
    provides: a role that several stages can fill (``dataset``).
    applies(config): whether it belongs to this experiment.
    shelf: folder of its artifacts where that is not its name, for stages that make the same kind of thing.
    ignores: dotted keys of `reads` that do not change the result.
    narrow(read): leaves out of what was read the options that others of them switch off.
    variants(config): name -> config of further runs of the stage (a black box of the same size); whoever needs
        the stage gets them too, under the role ``<stage>.<name>``.
    sources(cfg): files of somebody else that it reads; their contents count, not their place.
    elsewhere(config): role -> artifact folder or name of another experiment whose same stage it starts from.
    made_of, pieces(config): name of a stage, and name -> config of its runs, from whose artifacts this one can be put
        together; they change nothing in the result, so their keys are not part of its key.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    run: Run
    inputs: tuple[str, ...] | Callable[[DictConfig], tuple[str, ...]] = ()
    provides: str = ""
    applies: Callable[[DictConfig], bool] = lambda config: True
    shelf: str = ""
    ignores: tuple[str, ...] = ()
    narrow: Callable[[dict[str, Any]], dict[str, Any]] | None = None
    variants: Callable[[DictConfig], dict[str, DictConfig]] | None = None
    sources: Callable[[SimpleNamespace], list[Path]] | None = None
    elsewhere: Callable[[DictConfig], dict[str, str]] | None = None
    made_of: str = ""
    pieces: Callable[[DictConfig], dict[str, DictConfig]] | None = None


@dataclass(frozen=True)
class Task:
    """A stage with its config, its key, what it reads, the tasks before it, folders from elsewhere, pieces (by role).

    label: the stage's name, with the experiment before it where it belongs to another one.
    """

    stage: Stage
    label: str
    config: DictConfig
    key: str
    read: dict[str, Any]
    inputs: dict[str, Task] = field(default_factory=dict)
    folders: dict[str, Path] = field(default_factory=dict)
    pieces: dict[str, Task] = field(default_factory=dict)

    @property
    def shelf(self) -> str:
        """Folder of the store that its artifact lies in."""
        return self.stage.shelf or self.stage.name

    def settings(self) -> SimpleNamespace:
        """The parts of the config that the stage reads, and `machine`, as the rooms' dataclasses."""
        return settings_of(self.config, (*self.stage.reads, "machine"))


def settings_of(config: DictConfig, names: Iterable[str]) -> SimpleNamespace:
    """Parts of a config as the dataclasses (or plain values) that stand behind them.

    Raises: OptionError where a value makes no sense to its room.
    """
    found = {name: config[name] for name in names}
    return SimpleNamespace(**{k: OmegaConf.to_object(v) if OmegaConf.is_config(v) else v for k, v in found.items()})


def suggestion(word: str, known: Iterable[str]) -> str:
    """``; did you mean a or b?`` or, where nothing is close, ``; known are ...`` (short lists only)."""
    names = sorted(set(known))
    close = difflib.get_close_matches(word, names, n=2, cutoff=0.6)
    if close:
        return f"; did you mean {' or '.join(close)}?"
    return f"; known are {', '.join(names)}." if 0 < len(names) <= 12 else "."


class Planner:
    """Turns configs into tasks. `compose(experiment)` gives the config of another experiment by its name."""

    def __init__(self, stages: Sequence[Stage], compose: Callable[[str], DictConfig]):
        self.stages = stages
        self.compose = compose

    def check(self, config: DictConfig) -> None:
        """Looks at the names of the wanted stages and at the variants, without touching any file.

        Raises: OptionError where a stage is unknown or an option of a variant makes no sense.
        """
        names = [stage.name for stage in self.stages]
        for name in config.stages:
            if name not in names:
                raise OptionError(f"There is no stage '{name}'{suggestion(name, names)}")
        for stage in self.stages:
            if stage.variants is not None and stage.applies(config):
                for variant in stage.variants(config).values():
                    settings_of(variant, stage.reads)

    def plan(self, config: DictConfig) -> list[Task]:
        """The tasks of the stages that the config wants and of all that they need, inputs first.

        A stage that does not belong to this experiment (Psi_ini for foreign data) is left out.

        Raises: OptionError where a stage is unknown, DataError where files of somebody else are missing.
        """
        self.check(config)
        tasks: dict[str, Task] = {}  # by label, inputs first
        for stage in self.stages:
            if stage.name in config.stages and stage.applies(config):
                self._all(stage, config, tasks)
        return list(tasks.values())

    def _all(self, stage: Stage, config: DictConfig, tasks: dict[str, Task], before: str = "") -> dict[str, Task]:
        """The task of a stage and those of its variants: name of the variant (empty for the stage) -> task."""
        configs = {"": config} | (stage.variants(config) if stage.variants else {})
        return {name: self._task(stage, own, tasks, before, name) for name, own in configs.items()}

    def _task(
        self, stage: Stage, config: DictConfig, tasks: dict[str, Task], before: str = "", variant: str = ""
    ) -> Task:
        label = before + stage.name + (f".{variant}" if variant else "")
        if label in tasks:
            return tasks[label]
        inputs: dict[str, Task] = {}
        folders: dict[str, Path] = {}
        keys: dict[str, str] = {}
        for role in stage.inputs(config) if callable(stage.inputs) else stage.inputs:
            for other in self.stages:
                if role in (other.name, other.provides) and other.applies(config):
                    for name, task in self._all(other, config, tasks, before).items():
                        inputs[f"{role}.{name}" if name else role] = task
        for role, name in (stage.elsewhere(config) if stage.elsewhere else {}).items():
            if Path(name).is_dir():
                folders[role], keys[role] = Path(name), key_of_folder(Path(name))
            else:
                inputs[role] = self._from_experiment(stage, role, name, config, tasks)
        keys |= {role: task.key for role, task in inputs.items()}
        read = what_is_read(stage, config)
        if stage.sources is not None:
            keys["sources"] = digest_of_files(stage.sources(settings_of(config, stage.reads)))
        key = artifact_key(stage.shelf or stage.name, stage.version, read, keys)
        tasks[label] = Task(
            stage, label, config, key, read, inputs, folders, self._pieces(stage, config, tasks, before)
        )
        return tasks[label]

    def _pieces(self, stage: Stage, config: DictConfig, tasks: dict[str, Task], before: str) -> dict[str, Task]:
        """The tasks of the pieces that a stage is put together from: role -> task."""
        (maker,) = [other for other in self.stages if other.name == stage.made_of] or [stage]
        configs = stage.pieces(config) if stage.pieces else {}
        return {PIECE + name: self._task(maker, own, tasks, before, name) for name, own in configs.items()}

    def _from_experiment(self, stage: Stage, role: str, name: str, config: DictConfig, tasks: dict[str, Task]) -> Task:
        try:
            other = self.compose(name)
        except OptionError as error:
            raise OptionError(f"{role}={name} is neither an artifact folder nor an experiment: {error}") from error
        if stage.elsewhere and stage.elsewhere(other):
            raise OptionError(f"{role}={name} starts from another experiment itself; name that one instead.")
        other.machine = config.machine
        return self._task(stage, other, tasks, f"{name}/")


def key_of_folder(folder: Path) -> str:
    """Key of an artifact folder: its own if it has a manifest, else the digest of the files in it.

    Raises: DataError where the folder is empty.
    """
    if (folder / MANIFEST).is_file():
        key = json.loads((folder / MANIFEST).read_text()).get("key")
        if isinstance(key, str):
            return key
    files = [path for path in folder.iterdir() if path.is_file()]
    if not files:
        raise DataError(f"{folder} holds no artifact (it is empty); name a folder below outputs/artifacts.")
    return digest_of_files(files)


def what_is_read(stage: Stage, config: DictConfig) -> dict[str, Any]:
    """The resolved part of the config that goes into a stage's key: `reads` without `ignores`, narrowed."""
    read: dict[str, Any] = {}
    for name in stage.reads:
        value = config[name]
        is_config = OmegaConf.is_config(value)
        read[name] = OmegaConf.to_container(value, resolve=True, enum_to_str=True) if is_config else value
    for dotted in stage.ignores:
        *parents, last = dotted.split(".")
        node: Any = read
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if isinstance(node, dict):
            node.pop(last, None)
    return stage.narrow(read) if stage.narrow else read
