"""A short version of the attack on logs of running sessions: nothing acknowledged is lost."""

from attacks.lost_logs import FAULTS, lost_log_case
from attacks.support import run


def test_no_acknowledged_event_of_a_lost_log_is_lost():
    count = 2 * len(FAULTS)
    counts = run(lost_log_case(), count, 1)
    assert not [outcome for outcome in counts if outcome.startswith("THROUGH")], counts
    assert counts.total() == count
