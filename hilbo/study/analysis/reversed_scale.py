"""Participants whose scale looks reversed, as sentences; nothing is changed."""

from hilbo.population.judged.reversed_scale import reversed_people
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["reversed_sentences"]

_MOST = 200  # participants: for more, each against all others takes long


def reversed_sentences(study: Study, cohort: Cohort) -> tuple[str, ...]:
    """A sentence for each participant whose responses fit the map of the others better with the scale reversed.

    `study`: with learnt hyperparameters; stated ones may not fit, and then honest participants look reversed. Empty
    without them, and for more than 200 participants.
    """
    if study.learnt is None or len(cohort.names) > _MOST:
        return ()
    factors = reversed_people(study.gp, cohort.trials, study.learnt.model.share)
    return tuple(
        f"{cohort.names[row]}: the responses fit the map of the others better with the scale reversed (log Bayes factor"
        f" {factor:.1f}); check whether lowest and highest were exchanged. Nothing was changed."
        for row, factor in factors.items()
    )
