"""What Hydra finds of X-Planes: a sweeper with rows, resolvers, and further names of the LRMs.

Hydra imports this module whenever it starts, and takes sweepers from ``hydra_plugins`` only.
"""

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from xplanes.config import CONF
from xplanes.sweeps import jobs

ALIASES = {
    "openlrm_small": "small",
    "openlrm_base": "base",
    "triposr": "large",
    "openlrm_large": "xlarge",
}
"""Names of the published LRMs, and what the X-Planes paper calls them."""


class RowSweeper(BasicSweeper):
    """Hydra's own sweeper, with the jobs of `xplanes.sweeps.jobs`.

    Args:
        max_batch_size: As in Hydra's sweeper.
        params: As in Hydra's sweeper: values of each setting, separated by commas.
        rows: Settings that change together: ``key=value``, separated by spaces.
        demo: ``params`` and ``rows`` that replace these with ``experiment=demo``.
    """

    def __init__(
        self,
        max_batch_size: int | None = None,
        params: Mapping[str, str] | None = None,
        rows: Sequence[str] = ("",),
        demo: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(max_batch_size)

    def split_arguments(  # type: ignore[override]
        self, overrides: list[Override], max_batch_size: int | None
    ) -> list[list[list[str]]]:
        """Overrides of all jobs, in batches."""
        assert self.config is not None
        assert self.hydra_context is not None
        hydra: Any = OmegaConf.to_container(self.config.hydra, resolve=False)
        found = jobs(hydra, self.hydra_context.config_loader)
        return [list(batch) for batch in self.split_overrides_to_chunks(found, max_batch_size)]


def file_name(scene: Any) -> str:
    """The name of a scene as a part of a run directory's: no folders, and nothing to quote."""
    return re.sub(r"[^\w.+-]+", "-", Path(str(scene)).name).strip("-") or "scene"


def case(key: str, choices: Mapping[str, Any], otherwise: Any, *, _root_: Any) -> Any:
    """A value that depends on another setting: ``${case:recipe,{fair:0.0},0.1}``."""
    return choices.get(str(OmegaConf.select(_root_, key)), otherwise)


def options(group: str) -> str:
    """The options of a group and further names of them, for conf/hydra/help/train.yaml."""
    also = {name: f"{name}\xa0({alias})" for alias, name in ALIASES.items() if group == "lrm"}
    names = sorted(also.get(path.stem, path.stem) for path in (CONF / group).glob("*.yaml"))
    lines = textwrap.fill(", ".join(names), 84, subsequent_indent=11 * " ")
    return lines.replace("\xa0", " ")  # Which kept names and aliases on one line.


for _name, _resolver in {"file_name": file_name, "case": case, "options": options}.items():
    OmegaConf.register_new_resolver(_name, _resolver, replace=True)
_store = ConfigStore.instance().store
_sweeper = {"_target_": f"{__name__}.RowSweeper", "max_batch_size": None, "params": None}
_store("rows", _sweeper | {"rows": [""], "demo": None}, group="hydra/sweeper", provider="xplanes")
for _alias, _name in ALIASES.items():
    _store(_alias, {"defaults": [_name]}, group="lrm", provider="xplanes")
