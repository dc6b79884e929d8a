"""Computations over people that are sharded over devices: functions of each person, and sums over all people.

Devices are those of JAX's current mesh (`jax.set_mesh`) along the axis "people"; with one device, or without a mesh,
the same functions are plain loops. Rows are padded to a multiple of the devices with copies of the first row, which are
cut off again or add exactly 0, so that results differ between numbers of devices only in the order of summation.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec
from jaxtyping import PyTree

__all__ = ["devices", "host_local", "of_each_person", "people_mesh", "replicated", "sharded", "sum_over_people"]

_AXIS = "people"
_GROUP = 1000  # terms of a sum whose intermediate values a derivative keeps; those of other groups are computed again

_Tree = TypeVar("_Tree", bound=PyTree)


def people_mesh() -> Mesh:
    """New mesh of the devices of all processes, with the one axis "people"; it is not made the current one."""
    return jax.make_mesh((jax.device_count(),), (_AXIS,), axis_types=(AxisType.Auto,))


def devices() -> int:
    """Number of devices that people are sharded over; 1 without a mesh."""
    return jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1)


def of_each_person(function: Callable[..., Any], people: PyTree, *shared: Any) -> Any:
    """`function(people, *shared)`, with the people sharded over the devices: each computes its own rows.

    **Arguments:** `function`: returns arrays with one row for each person that depends on that person alone. It must
    not close over traced arrays: they are given as `shared`. `people`: arrays with one row for each person. Without a
    mesh `function` is simply called.
    """
    if devices() == 1:
        return function(people, *shared)
    rows = PartitionSpec(_AXIS)
    computed = _on_devices(function, rows)(_padded(people), shared)
    return jax.tree.map(lambda leaf: leaf[: _count(people)], computed)


def sum_over_people(term: Callable[..., Any], people: PyTree, *shared: Any) -> Any:
    """Sum of `term(person, *shared)` over people, computed one person after the other on each device.

    **Arguments:** `term`: returns arrays, for one person; it must not close over traced arrays. `people`: arrays with
    one row for each person. Only one term is in memory at a time; derivatives take memory for 1,000 people at a time.
    """
    if devices() == 1:
        return _sum_in_groups(lambda person: term(person, *shared), people)
    present = np.arange(_count(people) + -_count(people) % devices()) < _count(people)

    def of_device(some, *shared):
        total = _sum_in_groups(lambda one: _where(one[1], term(one[0], *shared)), some)
        return jax.lax.psum(total, _AXIS)

    return _on_devices(of_device, PartitionSpec())((_padded(people), jnp.asarray(present)), shared)


def _on_devices(function: Callable[..., Any], out: PartitionSpec) -> Callable[[PyTree, tuple[Any, ...]], Any]:
    """Function `(people, shared)` that runs `function(people, *shared)` on each device for its own rows of people.

    `out`: how the results are laid out over the devices. Non-arrays in `shared` are passed unchanged.
    """

    def call(people, shared):
        arrays, rest = eqx.partition(shared, eqx.is_array)

        def of_device(people, arrays):
            return function(people, *eqx.combine(arrays, rest))

        specs = PartitionSpec(_AXIS), PartitionSpec()
        return jax.shard_map(of_device, in_specs=specs, out_specs=out, check_vma=False)(people, arrays)

    return call


def sharded(people: _Tree) -> _Tree:
    """The same arrays, their rows sharded over the devices of the mesh; unchanged without one."""
    return people if devices() == 1 else jax.lax.with_sharding_constraint(people, PartitionSpec(_AXIS))


def replicated(arrays: _Tree) -> _Tree:
    """The same arrays, with a copy on each device of the mesh; unchanged without one."""
    return arrays if devices() == 1 else jax.lax.with_sharding_constraint(arrays, PartitionSpec())


def host_local(arrays: _Tree) -> _Tree:
    """The same arrays, but those that lie on several devices copied to this process's default device.

    For work that other processes do not do. The arrays must be replicated.
    """

    def local(leaf):
        several = isinstance(leaf, jax.Array) and len(leaf.sharding.device_set) > 1
        return jnp.asarray(np.asarray(leaf)) if several else leaf

    return jax.tree.map(local, arrays)


def _count(people: PyTree) -> int:
    """Number of people: length of the first array."""
    return jax.tree.leaves(people)[0].shape[0]


def _padded(people: _Tree) -> _Tree:
    """People, filled up to a multiple of the devices with copies of the first one."""
    more = -_count(people) % devices()
    if more == 0:
        return people
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[:1], more, axis=0)]), people)


def _where(counted: Any, terms: Any) -> Any:
    """The terms where `counted` (a boolean scalar) is true, else zeros; for rows that only pad."""
    return jax.tree.map(lambda leaf: jnp.where(counted, leaf, jnp.zeros_like(leaf)), terms)


def _sum_in_groups(term: Callable[[Any], Any], people: Any) -> Any:
    """Sum of `term(person)` over people in their order, as a scan.

    Above `_GROUP` people the scan runs in groups whose intermediate values a derivative computes again, to save memory.
    """
    shape = jax.eval_shape(term, jax.tree.map(lambda leaf: leaf[0], people))
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)

    def add(total, one):
        return jax.tree.map(jnp.add, total, term(one)), None

    def add_all(total, some):
        return jax.lax.scan(add, total, some)[0]

    groups, rest = divmod(_count(people), _GROUP)
    if groups == 0 or (groups == 1 and rest == 0):
        return add_all(zero, people)
    first = jax.tree.map(lambda leaf: leaf[: groups * _GROUP].reshape(groups, _GROUP, *leaf.shape[1:]), people)
    last = jax.tree.map(lambda leaf: leaf[groups * _GROUP :], people)
    again = jax.checkpoint(add_all)
    total = jax.lax.scan(lambda total, group: (again(total, group), None), zero, first)[0]
    return total if rest == 0 else again(total, last)
