"""Each fault that is put into the core on purpose is noticed by a test."""

import importlib.util
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[2] / "firmware" / "tests" / "faults.py"
_SPEC = importlib.util.spec_from_file_location("faults", _FILE)
assert _SPEC is not None and _SPEC.loader is not None
faults = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(faults)


def test_each_fault_has_a_place_in_the_core():
    for fault in faults.FAULTS:
        assert (faults.CORE / fault.file).read_text(encoding="utf-8").count(fault.old) == 1, fault.name
    assert len({fault.name for fault in faults.FAULTS}) == len(faults.FAULTS) >= 10


@pytest.mark.deep
@pytest.mark.release  # each fault compiles the firmware and runs its tests
@pytest.mark.parametrize("fault", faults.FAULTS, ids=[fault.name for fault in faults.FAULTS])
def test_a_fault_is_noticed(fault):
    assert faults.is_noticed(fault)
