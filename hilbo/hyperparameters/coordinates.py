"""Unconstrained coordinates of the hyperparameters, and weak priors on them.

Logarithms of theta, variance and noise; the first threshold in prior standard deviations of the starting model, and
the logarithms of the gaps between thresholds. So a search takes the same steps in any unit of the latent function.
"""

from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from hilbo.gaussian import Scalar
from hilbo.ordinal_gp import OrdinalGP, OrdinalProbit

__all__ = ["OF_THE_LIKELIHOOD", "Coordinates", "Learnable", "coordinates_of", "log_prior", "model_at"]

Learnable = Literal["theta", "variance", "noise", "thresholds"]
Coordinates = dict[str, Float[Array, "..."]]

OF_THE_LIKELIHOOD = ("first", "gaps", "noise")
"""Coordinates of the likelihood; alphabetically they come before the kernel's."""

_WEAK_SD = {"theta": 1.5, "variance": 1.0, "noise": 1.0, "first": 1.0, "gaps": 1.0}
_FIELDS = {"theta": ("theta",), "variance": ("variance",), "noise": ("noise",), "thresholds": ("first", "gaps")}


def coordinates_of(gp: OrdinalGP, learn: Sequence[str], start: OrdinalGP | None = None) -> Coordinates:
    """Unconstrained coordinates of those hyperparameters of a model that `learn` names, by coordinate name.

    "thresholds" gives two: `first`, a scalar, and `gaps`, (C - 2,); the others are logarithms of the value's shape.
    `start`: the starting model, whose prior standard deviation is the unit of `first`; None if that is `gp` itself.
    Raises `KeyError` for other names.
    """
    thresholds = gp.likelihood.thresholds
    every = {
        "theta": jnp.log(gp.kernel.theta),
        "variance": jnp.log(gp.kernel.variance),
        "noise": jnp.log(gp.likelihood.noise),
        "first": thresholds[0] / jnp.sqrt((gp if start is None else start).kernel.variance),
        "gaps": jnp.log(jnp.diff(thresholds)),
    }
    return {field: every[field] for name in learn for field in _FIELDS[name]}


def model_at(coordinates: Coordinates, gp: OrdinalGP) -> OrdinalGP:
    """Copy of the starting model `gp` with the hyperparameters at these coordinates; those without a coordinate are as
    in `gp`.
    """
    held = {"theta": gp.kernel.theta, "variance": gp.kernel.variance, "noise": gp.likelihood.noise}
    positive = held | {k: jnp.exp(coordinates[k]) for k in held if k in coordinates}
    thresholds = gp.likelihood.thresholds
    if "first" in coordinates:
        first = coordinates["first"] * jnp.sqrt(gp.kernel.variance)
        steps = jnp.concatenate([first[None], jnp.exp(coordinates["gaps"])])
        thresholds = jnp.cumsum(steps)
    kernel = gp.kernel.with_numbers(positive["theta"], positive["variance"])
    return OrdinalGP(kernel, OrdinalProbit(thresholds, positive["noise"]))


def log_prior(gp: OrdinalGP, centre: OrdinalGP, learn: Sequence[str]) -> Scalar:
    """Log density of the weak priors on the coordinates in `learn`, at the model `gp`, up to a constant: a scalar, in
    nats.

    `centre`: the model at their centre.
    """
    coordinates, centres = coordinates_of(gp, learn, centre), coordinates_of(centre, learn)
    squares = [jnp.sum(((coordinates[k] - centres[k]) / _WEAK_SD[k]) ** 2) for k in coordinates]
    return -0.5 * jnp.sum(jnp.stack(squares))
