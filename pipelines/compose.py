"""Composing a config, and saying in one sentence what is wrong with one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pipelines.stages import Planner, Stage, settings_of, suggestion
from zsdt.errors import OptionError

CONFIG_NAME = "config"
EXPERIMENT = "experiment"


@dataclass(frozen=True)
class Application:
    """What a command line works on: the folder of YAML files, the stages, and how options become schemas."""

    conf: Path
    stages: Sequence[Stage]
    register: Callable[[], None]

    def compose(self, overrides: Sequence[str]) -> DictConfig:
        """The config of one job, checked: every key exists and every part makes sense to its room.

        Raises: OptionError with one sentence otherwise.
        """
        self.register()
        try:
            config = self._compose(overrides)
            settings_of(config, [str(name) for name in config])
            return config
        except (HydraException, OmegaConfBaseException) as error:
            raise OptionError(self.explain(error, overrides)) from error
        except ValueError as error:  # Hydra's word for GROUP=null
            if "Config group override" not in str(error):
                raise
            raise OptionError("A group is chosen by a name, as in scene=glass; ~scene leaves it out.") from error

    def _compose(self, overrides: Sequence[str]) -> DictConfig:
        """Composes beside a run that may be under way: Hydra holds one of these for each process."""
        of_process = GlobalHydra.instance()
        under_way, of_process.hydra = of_process.hydra, None
        try:
            with initialize_config_dir(str(self.conf.resolve()), version_base="1.3"):
                return compose(CONFIG_NAME, list(overrides))
        finally:
            GlobalHydra.instance().hydra = under_way

    def experiments(self) -> list[str]:
        """Names of all experiments."""
        return sorted(path.stem for path in (self.conf / EXPERIMENT).glob("*.yaml"))

    def planner(self) -> Planner:
        """Planner that finds other experiments by their names."""

        def other(name: str) -> DictConfig:
            if name not in self.experiments():
                raise OptionError(f"there is no experiment '{name}'{suggestion(name, self.experiments())}")
            return self.compose([f"{EXPERIMENT}={name}"])

        return Planner(self.stages, other)

    def check(self, overrides: Sequence[str], multirun: bool) -> DictConfig:
        """Refuses a command line with a mistake before anything runs; of a sweep, each value of each key.

        Returns the config of the (first) job.

        Raises: OptionError.
        """
        jobs = _alternatives(overrides) if multirun else iter([list(overrides)])
        configs = [self.compose([text for text in job if not text.lstrip("+~").startswith("hydra")]) for job in jobs]
        for config in configs:
            self.planner().check(config)
        return configs[0]

    def explain(self, error: Exception, overrides: Sequence[str]) -> str:
        """One sentence about an error of Hydra or OmegaConf: what is wrong and what was perhaps meant."""
        text = str(error)
        cause = error.__cause__ or error
        if isinstance(error, MissingConfigException):
            return _explain_missing_choice(error, text)
        if key := _unknown_key(error, text):
            return f"There is no option '{key}'{suggestion(key, self._known_keys(overrides))}"
        if "parsing override" in text:
            return f"{_first_line(text)}; write KEY=VALUE, and lists as KEY=[A,B]."
        key = getattr(cause, "full_key", None) or ""
        reason = _first_line(str(cause))
        return f"The option '{key}' cannot be used: {reason}." if key else f"{_first_line(text)}."

    def _known_keys(self, overrides: Sequence[str]) -> list[str]:
        """Dotted keys of the config without the overrides of single keys (which may be the mistake)."""
        groups = {path.name for path in self.conf.iterdir() if path.is_dir()}
        kept = [text for text in overrides if text.split("=")[0] in groups and "," not in text]
        for attempt in (kept, []):
            try:
                return [*groups, *_dotted(self._compose(attempt))]
            except (HydraException, OmegaConfBaseException):
                continue
        return []


def _explain_missing_choice(error: MissingConfigException, text: str) -> str:
    wanted = re.search(r"Could not find '([^']*)'", text) or re.search(r"Could not load '([^']*)'", text)
    name = wanted.group(1) if wanted else str(error.missing_cfg_file)
    options = [str(option) for option in error.options or [] if not str(option).endswith("_schema")]
    group, _, choice = name.rpartition("/")
    if not options:
        return f"There is no config '{name}'; see the folder conf for those that there are."
    return f"There is no {group or 'config'} '{choice}'{suggestion(choice, options)}"


def _unknown_key(error: Exception, text: str) -> str | None:
    for pattern in (
        r"Could not override '([^']*)'\.\s+To append",
        r"Could not override '([^']*)'\. No match in the defaults list",
        r"Key '[^']*' (?:is not in struct|not in '[^']*')(?:.|\n)*?full_key: (\S+)",
        r"Could not delete from config\. '([^']*)' does not exist",
    ):
        if found := re.search(pattern, text):
            return found.group(1)
    return None


def _first_line(text: str) -> str:
    return text.strip().splitlines()[0].strip().rstrip(".") if text.strip() else "unknown reason"


def _dotted(config: DictConfig, before: str = "") -> Iterator[str]:
    for name in map(str, config):
        key = f"{before}{name}"
        yield key
        child = config._get_node(name)
        if isinstance(child, DictConfig) and not child._is_none() and not child._is_missing():
            yield from _dotted(child, f"{key}.")


def _alternatives(overrides: Sequence[str]) -> Iterator[list[str]]:
    """Single jobs that together use each value of each swept key once."""
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise OptionError(f"{_first_line(str(error))}; write KEY=VALUE, and sweeps as KEY=A,B.") from error
    values = [_values(override) for override in parsed]
    first = [choices[0] for choices in values]
    yield first
    for place, choices in enumerate(values):
        for other in choices[1:]:
            yield [*first[:place], other, *first[place + 1 :]]


def _values(override: Override) -> list[str]:
    if not override.is_sweep_override():
        return [str(override.input_line)]
    key, swept = override.get_key_element(), override.value()
    if isinstance(swept, IntervalSweep):
        return [f"{key}={swept.start}"]
    return [f"{key}={value}" for value in override.sweep_string_iterator()]
