"""Recipes that learn the hyperparameters from all people's answers.

Each has its rule's name, and never changes: a study that names one gets the same numbers from a later hilbo, but for
how near the search comes to the maximum, which is hundredths of a standard deviation. A better recipe gets another
name.

In units of the classification noise, with d parameters and C categories, people's functions and answers are those of
`people_model.PeopleModel`. The priors of the hyperparameters:

    coordinate                                   learnt-1            learnt-2            learnt-3
    kernel                                       RBF                 Matern 3/2          Matern 3/2
    log theta_i                                  log(24 / d), 1.2    the same            the same
    log shared variance                          log 3, 1            log 3, 2            log 3, 2
    log own variance                             0, 1                0, 2                0, 2
    middle of the thresholds                     0, 1.5              0, 4                0, 4
    log distance of neighbouring thresholds      log 0.8, 0.7        log 0.8, 2          log 0.8, 2
    log width_j of a person, if C > 2            0, 0.4              the same            the same
    log sensitivity_j of a person                none                none                0, spread
    log spread of the sensitivities              none                none                log 0.3, 1
    log variance of a random effect, if any      0, 2                the same            the same
"""

import math
from typing import Final, Literal, NamedTuple

__all__ = ["EFFECT", "LEARNT_1", "LEARNT_2", "LEARNT_3", "Prior", "Recipe"]


class Prior(NamedTuple):
    """Normal prior of one coordinate: mean and standard deviation."""

    mean: float
    sd: float


class Recipe(NamedTuple):
    """Definition of a method that learns the hyperparameters: frozen name, kernel, and priors."""

    name: str
    kernel: Literal["rbf", "matern32"]
    """Of the function that people share, and of each participant's own part."""
    priors: dict[str, Prior]
    """By the names of `posterior.Coordinates`; that of theta less log d. With "spread" participants may differ in
    sensitivity."""
    worth: float
    """Smallest gain of log evidence, in nats, for individual widths, and for sensitivities about the middle of the
    thresholds instead of the highest one."""


WIDTHS: Final = Prior(0.0, 0.4)
"""Of the logarithm of a person's distances between thresholds, about their middle."""
EFFECT: Final = Prior(0.0, 2.0)
"""Of the logarithm of the variance of what a context adds, as far as a study names a random effect."""

LEARNT_1: Final = Recipe(
    "learnt-1",
    "rbf",
    {
        "theta": Prior(math.log(24.0), 1.2),
        "shared": Prior(math.log(3.0), 1.0),
        "own": Prior(0.0, 1.0),
        "middle": Prior(0.0, 1.5),
        "gaps": Prior(math.log(0.8), 0.7),
        "widths": WIDTHS,
        "effect": EFFECT,
    },
    3.0,
)
LEARNT_2: Final = Recipe(
    "learnt-2",
    "matern32",
    {
        "theta": Prior(math.log(24.0), 1.2),
        "shared": Prior(math.log(3.0), 2.0),
        "own": Prior(0.0, 2.0),
        "middle": Prior(0.0, 4.0),
        "gaps": Prior(math.log(0.8), 2.0),
        "widths": WIDTHS,
        "effect": EFFECT,
    },
    3.0,
)
LEARNT_3: Final = LEARNT_2._replace(name="learnt-3", priors=LEARNT_2.priors | {"spread": Prior(math.log(0.3), 1.0)})
