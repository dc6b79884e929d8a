"""Prior covariance of all responses in low-rank form, and the linear system of Newton's steps.

With p features of M participants with n responses each, K = F F' + blockdiag(K_j), curvatures W, L_j L_j' = I +
W_j^(1/2) K_j W_j^(1/2) and A_j = L_j^-1 W_j^(1/2) F_j, every system is solved by the Cholesky factor C of the smaller
of two matrices: S = I + A'A (p, p), the posterior precision of the features' weights, or, where responses are fewer
than features, T = I + A A' (M n, M n). By the matrix inversion lemma

    I - A S^-1 A' = T^-1,   I - S^-1 = A'T^-1 A,   |S| = |T|.

A A' = blockdiag(L_j^-1 W_j^(1/2)) F F' blockdiag(W_j^(1/2) L_j^-T), so that only F F' is needed, once for all steps.
The symbols are those of `low_rank`. Reference: Rasmussen & Williams (2006), appendix A.3.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float, PyTree

from hilbo.kernels import gram
from hilbo.numerics.linalg import eigh
from hilbo.numerics.sharding import of_each_person, sharded
from hilbo.population.shared.features import Pivots, features_of
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Tallies

__all__ = ["LowRankPrior", "System", "prior_of", "system_at"]


class LowRankPrior(NamedTuple):
    """Prior covariance K = F F' + blockdiag(K_j) of all responses' latent values: `features` F (M, n, p), `blocks` K_j
    (M, n, n), and `together` F F' (M, n, M n) where responses are fewer than pivots; None otherwise.
    """

    features: Float[Array, "M n p"]
    blocks: Float[Array, "M n n"]
    together: Float[Array, "M n N"] | None

    def times(self, weights: Float[Array, "M n"]) -> Float[Array, "M n"]:
        """K a for weights a, (M, n) -> (M, n); the result is sharded over devices as K is."""
        of_features = jnp.einsum("jnp,jn->p", self.features, weights)
        return sharded(self.features @ of_features + jnp.einsum("jnm,jm->jn", self.blocks, weights))


class System(NamedTuple):
    """Factors of the matrix of Newton's steps, at curvatures W: W^(1/2), L_j, A_j, `inner` S or T with its Cholesky
    factor, and log |I + K W|.
    """

    root: Float[Array, "M n"]  # W^(1/2)
    lower: Float[Array, "M n n"]  # L_j
    half: Float[Array, "M n p"]  # A_j
    inner: Float[Array, "s s"]  # S, or T where responses are fewer than pivots
    factor: Float[Array, "s s"]  # its Cholesky factor
    log_determinant: Float[Array, ""]  # log |I + K W|

    @property
    def of_responses(self) -> bool:
        """Whether `inner` is T."""
        return self.inner.shape[0] < self.half.shape[2]

    def solve(self, right: Float[Array, "M n"]) -> Float[Array, "M n"]:
        """(K + W^-1)^-1 y for y (M, n), computed without W^-1; 0 where W is 0."""
        first = _each(lambda p: solve_triangular(p[0], p[1], lower=True), (self.lower, self.root * right))
        if self.of_responses:
            rest = cho_solve((self.factor, True), first.reshape(-1)).reshape(first.shape)
        else:
            rest = first - self.half @ cho_solve((self.factor, True), jnp.einsum("jnp,jn->p", self.half, first))
        return self.root * _each(lambda p: solve_triangular(p[0], p[1], lower=True, trans=1), (self.lower, rest))

    def explained(self, rank: int) -> Float[Array, "k r"]:
        """V with V'V = I - S_g^-1, the explained part of the prior variance of the first `rank` features' weights, r.

        S_g is their precision, that of the others integrated out. Eigenvalues of S_g - I below 0, which are rounding,
        are taken as 0.
        """
        if self.of_responses:
            return solve_triangular(self.factor, self.half.reshape(-1, self.half.shape[2])[:, :rank], lower=True)
        excess, vectors = eigh(self.precision(rank) - jnp.eye(rank, dtype=self.root.dtype))
        return jnp.sqrt(jnp.where(excess > 0, excess / (1.0 + excess), 0.0))[:, None] * vectors.T

    def explained_variance(self, features: Float[Array, "m r"]) -> Float[Array, " m"]:
        """phi'(I - S_g^-1) phi of features phi (m, r), the first r: explained part of the variance of m weighted sums.

        As `explained`, without its eigendecomposition.
        """
        rank = features.shape[1]
        if self.of_responses:
            return jnp.sum((self.explained(rank) @ features.T) ** 2, axis=0)
        lower = jnp.linalg.cholesky(self.precision(rank))
        rest = solve_triangular(lower, features.T, lower=True)
        return jnp.sum(features**2, axis=1) - jnp.sum(rest**2, axis=0)

    def precision(self, rank: int) -> Float[Array, "r r"]:
        """S_g of the first `rank` features' weights, r; of a system of S."""
        if self.inner.shape[0] == rank:
            return self.inner
        cross, own = self.inner[:rank, rank:], self.inner[rank:, rank:]
        half = solve_triangular(jnp.linalg.cholesky(own), cross.T, lower=True)
        return self.inner[:rank, :rank] - half.T @ half

    def covariance(self) -> Float[Array, "p p"]:
        """S^-1, posterior covariance of all features' weights."""
        eye = jnp.eye(self.half.shape[2], dtype=self.root.dtype)
        if self.of_responses:
            explained = self.explained(len(eye))
            return eye - explained.T @ explained
        return cho_solve((self.factor, True), eye)


def _each(function: Callable[..., Any], people: PyTree, *shared: Any) -> Any:
    """Stacked results of `function(person, *shared)` for each row of `people`, one after the other on each device."""

    def some(people, *shared):
        return jax.lax.map(lambda person: function(person, *shared), people)

    return of_each_person(some, people, *shared)


def prior_of(model: PeopleModel, answers: Tallies, pivots: Pivots) -> LowRankPrior:
    """Prior covariance of the latent values at all points of the responses; contexts of a random effect are features
    too.
    """
    unit = of_each_person(lambda x, kernel, pivots: features_of(kernel, pivots, x), answers.x, model.unit, pivots)

    def block(person, kernel, own, shared):
        x, own_features = person
        covariance = gram(kernel, x, x)
        return own * covariance + shared * (covariance - own_features @ own_features.T)

    features = jnp.sqrt(model.shared) * unit
    if model.effect is not None:
        of_context = jax.nn.one_hot(answers.context, answers.contexts, dtype=unit.dtype)
        features = jnp.concatenate([features, jnp.sqrt(model.effect) * of_context], axis=-1)
    features, flat = sharded(features), features.reshape(-1, features.shape[2])
    together = sharded(features @ flat.T) if len(flat) < unit.shape[2] else None
    return LowRankPrior(features, _each(block, (answers.x, unit), model.unit, model.own, model.shared), together)


def system_at(prior: LowRankPrior, curvature: Float[Array, "M n"]) -> System:
    """Factors of the matrix of Newton's steps at curvatures W >= 0, (M, n); where W is 0 a response has no
    influence.
    """
    answered = curvature > 0
    root = jnp.where(answered, jnp.sqrt(jnp.where(answered, curvature, 1.0)), 0.0)

    def person(prior_and_root):
        block, features, root = prior_and_root
        lower = jnp.linalg.cholesky(jnp.eye(len(root), dtype=root.dtype) + root[:, None] * block * root[None, :])
        return lower, solve_triangular(lower, root[:, None] * features, lower=True)

    lower, half = _each(person, (prior.blocks, prior.features, root))
    inner = _of_features(half) if prior.together is None else _of_responses(prior.together, lower, root)
    factor = jnp.linalg.cholesky(inner)
    logs = jnp.sum(jnp.log(jnp.diagonal(lower, axis1=1, axis2=2))) + jnp.sum(jnp.log(jnp.diagonal(factor)))
    return System(root, lower, half, inner, factor, 2.0 * logs)


def _of_features(half: Float[Array, "M n p"]) -> Float[Array, "p p"]:
    """S = I + sum_j A_j'A_j."""
    flat = half.reshape(-1, half.shape[2])
    return jnp.eye(half.shape[2], dtype=half.dtype) + flat.T @ flat


def _of_responses(
    together: Float[Array, "M n N"], lower: Float[Array, "M n n"], root: Float[Array, "M n"]
) -> Float[Array, "N N"]:
    """T = I + A A', from F F'; N = M n."""

    def person(rows_of_person):
        lower, root, rows = rows_of_person
        return solve_triangular(lower, root[:, None] * rows, lower=True)

    def from_left(rows):
        return _each(person, (lower, root, rows)).reshape(-1, together.shape[2])

    once = from_left(together)
    return jnp.eye(len(once), dtype=once.dtype) + from_left(once.T.reshape(together.shape))
