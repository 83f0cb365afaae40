"""The models reproduce the outputs of the published code."""

import pytest

import xplanes.lrm
from tests.lrm.checks import CHECKS


@pytest.mark.parametrize("check", [check for _, check in CHECKS], ids=[name for name, _ in CHECKS])
def test_model_reproduces(check):
    check(xplanes.lrm)
