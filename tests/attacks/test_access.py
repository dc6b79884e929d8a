"""The attempts of attacks/access.py, and the table of their outcomes in the documentation."""

import subprocess
import sys

import pytest
from simulated import ENVIRONMENT, ROOT, needs_device, own_cache  # noqa: F401

from attacks.access import ATTEMPTS, table
from hilbo.app.rehearsal.robot import find_browser

LIVE = ROOT / "docs" / "guides" / "live.md"


def test_the_documentation_has_the_outcomes_that_are_tried():
    _, _, rest = LIVE.read_text(encoding="utf-8").partition("<!-- access -->\n")
    assert rest.partition("\n<!-- end of access -->")[0] == table(), "print it by python attacks/access.py --table"


@pytest.mark.deep
@needs_device
@pytest.mark.skipif(find_browser() is None, reason="needs playwright and Chromium (Debian: chromium)")
def test_every_attempt_has_its_outcome():
    """In a process of its own: attempts of another user fork, which JAX's threads in this one forbid."""
    command = [sys.executable, str(ROOT / "attacks" / "access.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=ENVIRONMENT)
    assert done.returncode == 0, done.stderr + done.stdout
    assert f"{len(ATTEMPTS)}  in all" in done.stdout
