"""The attempts of attacks/access.py, and the table of their outcomes in the documentation."""

from pathlib import Path

import pytest
from simulated import needs_device, own_cache  # noqa: F401

from attacks.access import ATTEMPTS, table, tried
from attacks.access_ground import ground
from hilbo.app.rehearsal.robot import find_browser

LIVE = Path(__file__).parents[2] / "docs" / "guides" / "live.md"


def test_the_documentation_has_the_outcomes_that_are_tried():
    _, _, rest = LIVE.read_text(encoding="utf-8").partition("<!-- access -->\n")
    assert rest.partition("\n<!-- end of access -->")[0] == table(), "print it by python attacks/access.py --table"


@pytest.mark.deep
@needs_device
@pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)")
def test_every_attempt_has_its_outcome():
    with ground() as attacked:
        assert [words for attempt in ATTEMPTS if (words := tried(attacked, attempt)).startswith("THROUGH")] == []
