"""The list of seeded faults fits the code: each replaces one piece of text, and names tests that are there."""

from seeded_faults import FAULTS, ROOT


def test_each_fault_has_a_place_in_the_code():
    for fault in FAULTS:
        assert (ROOT / fault.file).read_text(encoding="utf-8").count(fault.right) == 1, fault.name
        assert all((ROOT / path).exists() for path in fault.tests.split()), fault.name
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 10
