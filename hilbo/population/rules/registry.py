"""The aggregation methods (rules): the only list of them, and their properties.

A method combines participants' responses into one population map, and defines its optimum. Study files, `--rule` and
result.json have its name; all code that depends on the method reads `RULES[name]`. `hilbo.population.maps` fits the
maps. A new method is a new entry here, with its recipe (`recipes`) if it learns the hyperparameters.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from hilbo.population.rules.recipes import LEARNT_1, LEARNT_2, LEARNT_3, Recipe

__all__ = ["DEFAULT", "GIVEN", "POINTWISE", "RECIPES", "RECOMMENDED", "RULES", "WITHDRAWN", "Rule", "RuleName"]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """An aggregation method."""

    name: str
    """In study files and results; never changes."""
    label: str
    """Of an optimum by it, on pages."""
    description: str
    """Of its model, in a pre-registration."""
    optimum: str = "the maximum of the population map"
    """Definition of the optimum on pages and in pre-registrations, with {goal} for the label of the goal; see
    `optimum_for`."""
    formula: str = ""
    """Of variance and mean of the map, as HTML, where it is short enough for a page."""
    pointwise: str
    """The rule by which posteriors are combined point by point where this one has no map of all answers: itself, if it
    is a sum over people at each point (`hilbo.population.pointwise`)."""
    weighted: bool = True
    """Whether that sum weights people by their precision; otherwise everybody counts the same."""
    learns_share: bool = False
    """Whether the share of the prior variance that people have in common is learnt, which takes two people."""
    homogeneous: bool = False
    """Whether people are assumed to have one function in common: where they differ, its intervals are too narrow."""
    joint: bool = False
    """Whether one model is fitted to all answers at once, where they are few enough;"""
    exact_only: bool = False
    """and no method replaces it where they are too many."""
    recipe: Recipe | None = None
    """Of a rule that learns the hyperparameters; others take them from [gp]."""
    predicts: bool = False
    """Whether pages print its probability of the goal as a new participant's response: in simulated populations like
    the paper's it is near to what happens, and its 95 % intervals contain that about as often as they should."""
    centred: bool = False
    """Whether the optimum is the point most often near the optimum of joint posterior draws (`best_places.nearness`),
    among points where the probability of the goal for a new participant is within 0.05 of its maximum."""

    def optimum_for(self, goal: str, is_highest: bool) -> str:
        """Definition of the optimum in a study whose goal has the label `goal` and is the highest response or not."""
        if is_highest or self.learns:
            return self.optimum.format(goal=goal)
        return "the point at which the population map is closest to the goal"

    @property
    def learns(self) -> bool:
        """Whether it learns the hyperparameters, so that a study needs no [gp]."""
        return self.recipe is not None

    @property
    def by_points(self) -> bool:
        """Whether it is itself a sum over participants at each point, and not a model of all responses with a
        stand-in.
        """
        return self.pointwise == self.name

    @property
    def product(self) -> bool:
        """Whether the map is a product of the individual posteriors, which has joint draws: of all methods only bcm."""
        return self.by_points and self.weighted and not self.learns_share

    @property
    def least_people(self) -> int:
        """Smallest number of participants with responses: 2 if the share is learnt, else 1."""
        return 2 if self.learns_share else 1


_LEARNT = "the hierarchical model with hyperparameters learnt from all answers, recipe "
_CENTRED = (
    "the point that is most often near the optimum of joint posterior draws, among points at which the probability that"
    ' a new participant answers "{goal}" is within 0.05 of its maximum'
)
_ALL: Final = (
    Rule(
        name="bcm",
        label="committee machine (bcm)",
        description="the Bayesian committee machine",
        formula="1/σ² = Σ<sub>j</sub> 1/σ<sub>j</sub>² − (M − 1)/<i>k</i> and"
        " μ = σ² Σ<sub>j</sub> μ<sub>j</sub>/σ<sub>j</sub>²",
        pointwise="bcm",
        homogeneous=True,
    ),
    Rule(
        name="hierarchical",
        label="people who differ (hierarchical)",
        description="the hierarchical model, with a learnt share that people have in common",
        pointwise="hierarchical",
        learns_share=True,
        joint=True,
    ),
    Rule(
        name="average",
        label="plain average of the latent functions",
        description="the plain average of people's latent functions",
        pointwise="average",
        weighted=False,
    ),
    Rule(
        name="pooled",
        label="one model of all answers",
        description="one function fitted to all answers",
        pointwise="bcm",
        homogeneous=True,
        joint=True,
        exact_only=True,
    ),
    Rule(
        name="learnt-1",
        label="people who differ, hyperparameters learnt (learnt-1)",
        description=f"{_LEARNT}learnt-1",
        optimum='the point with the largest probability that a new participant answers "{goal}"',
        pointwise="hierarchical",
        joint=True,
        recipe=LEARNT_1,
    ),
    Rule(
        name="learnt-2",
        label="people who differ, hyperparameters learnt (learnt-2)",
        description=f"{_LEARNT}learnt-2",
        optimum=_CENTRED,
        pointwise="hierarchical",
        joint=True,
        recipe=LEARNT_2,
        centred=True,
    ),
    Rule(
        name="learnt-3",
        label="people who differ, hyperparameters learnt (learnt-3)",
        description=f"{_LEARNT}learnt-3",
        optimum=_CENTRED,
        pointwise="hierarchical",
        joint=True,
        recipe=LEARNT_3,
        predicts=True,
        centred=True,
    ),
)
RULES: Final = {rule.name: rule for rule in _ALL}
"""Every rule by its name."""
if TYPE_CHECKING:
    RuleName = str
else:
    RuleName = Literal[tuple(RULES)]
"""Of a rule, checked where files are read; a Literal, since msgspec leaves a default out of a study's content, and so
of its hash, only where the value is that very text."""
GIVEN: Final = tuple(rule.name for rule in _ALL if not rule.learns)
"""Those that take the hyperparameters as they are given."""
POINTWISE: Final = tuple(rule.name for rule in _ALL if rule.by_points)
"""Those that are sums over people at each point."""
RECIPES: Final = {rule.name: rule.recipe for rule in _ALL if rule.recipe is not None}
"""What those learn by that learn."""
DEFAULT: Final = "bcm"
"""Of a study file that names none: the paper's."""
RECOMMENDED: Final = "learnt-2"
"""Method that is shown in addition to the study's."""
WITHDRAWN: Final = {
    "rbcm": '"rbcm", which was withdrawn: it won no comparison; write "learnt-2" (recommended) or "bcm" (the paper\'s).'
}
"""Rules of earlier versions, whose names stay reserved: name -> what an error says after "rule is"."""
