"""The commands of this wing, whatever is installed."""

import pytest

from xplanes import cli
from xplanes.synthetic.pretraining.commands import add_commands


@pytest.fixture(autouse=True)
def commands_of_the_wing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "further_commands", lambda: [add_commands])
