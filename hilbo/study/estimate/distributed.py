"""Several devices and several processes: roles of the processes, distribution of work, and joint termination on
failure.

Participants are sharded over the devices of all processes (`hilbo.numerics.sharding`). Each process reads all data and
runs the same programs in the same order; results are copied to all processes. They find each other by
`jax.distributed`: automatically under Slurm and Open MPI, elsewhere by the address of process 0. On CPUs they
communicate by gloo.

No process waits for ever: bad input is exchanged before work begins, so that all stop with a message; if a process dies
later, the next exchange fails, or JAX's heartbeat misses it, and the others end with an error.
"""

import contextlib
import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import PyTree, UInt8

from hilbo.errors import InputError
from hilbo.numerics.sharding import people_mesh

__all__ = ["Crew", "crew", "digest"]

_MEETING, _HEARTBEAT = 120, 60  # s to find each other, and after which a silent process counts as dead
_WRITING = 3600  # s that the others wait at the end for the one that writes; a dead one is missed by then


class AgreedError(InputError):
    """Bad input of which all processes know, so that all of them stop in order."""


class Crew(NamedTuple):
    """Index (`rank`) of this process and number (`count`) of all processes."""

    rank: int
    count: int

    @property
    def writes(self) -> bool:
        """Whether this process writes the results and reports progress: only process 0 does."""
        return self.rank == 0

    @staticmethod
    def sharded() -> contextlib.AbstractContextManager[Any]:
        """A context in which people are sharded over the devices of all processes; a no-op for one device."""
        return jax.set_mesh(people_mesh()) if jax.device_count() > 1 else contextlib.nullcontext()

    @contextlib.contextmanager
    def agreement(self) -> Iterator[Callable[[str], None]]:
        """Context manager for reading input, which all processes must enter. Gives a function to call with a digest of
        what was read.

        At its end all processes wait for each other. Raises `AgreedError` in all of them if one raised `InputError` in
        the block, or if the digests differ. Other exceptions pass without an exchange.
        """
        read = []
        try:
            yield read.append
        except InputError as error:
            self._exchange("")
            raise AgreedError(str(error)) from error
        marks = self._exchange("".join(read) or "nothing")
        failed = [str(rank) for rank, mark in enumerate(marks) if not mark.any()]
        if failed:
            raise AgreedError(f"process {failed[0]} of {self.count} refused its input; its message has the reason.")
        if any((mark != marks[0]).any() for mark in marks):
            raise AgreedError(
                f"the {self.count} processes read different data or were given different options; start all with the"
                " same command on the same files."
            )

    def _exchange(self, text: str) -> UInt8[np.ndarray, "count 8"]:
        """First 8 bytes of the SHA-256 of each process's text, (count, 8), zeros for an empty text. Waits for all
        processes."""
        mark = np.frombuffer(hashlib.sha256(text.encode()).digest()[:8], np.uint8) if text else np.zeros(8, np.uint8)
        if self.count == 1:
            return mark[None]
        return np.asarray(multihost_utils.process_allgather(mark)).reshape(self.count, 8)


@contextlib.contextmanager
def crew(
    distributed: bool, coordinator: str | None = None, processes: int | None = None, process: int | None = None
) -> Iterator[Crew]:
    """Context manager that gives this process's `Crew`; to be entered before JAX computes anything.

    Without `distributed` it is a single process, and InputError is raised if another option is given. With it, the
    processes connect first, which raises InputError if it fails. An exception in the block prints a message and ends
    this process: with exit code 2 for an `AgreedError`, otherwise with 1 and without waiting for the others.
    """
    if not distributed:
        if (coordinator, processes, process) != (None, None, None):
            raise InputError("--coordinator, --processes and --process-id need --distributed.")
        yield Crew(0, 1)
        return
    _meet(coordinator, processes, process)
    rank, count = jax.process_index(), jax.process_count()
    try:
        yield Crew(rank, count)
    except AgreedError as error:
        _leave(str(error), rank, count, 2)
    except BaseException as error:
        _leave(f"{type(error).__name__}: {error}", rank, count, 1, wait=False)
        raise
    jax.distributed.shutdown()


def _meet(coordinator: str | None, processes: int | None, process: int | None) -> None:
    """Connect to the other processes by `jax.distributed`. Raises `InputError` for bad options, and if that takes too
    long."""
    if processes is not None and process is not None and not 0 <= process < processes:
        raise InputError(f"--process-id is {process}; it must be from 0 to {processes - 1}, another for each process.")
    if coordinator is not None and not (coordinator.rpartition(":")[0] and coordinator.rpartition(":")[2].isdigit()):
        raise InputError(f'--coordinator is "{coordinator}"; it must be HOST:PORT, the address of process 0.')
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            coordinator,
            processes,
            process,
            initialization_timeout=_MEETING,
            heartbeat_timeout_seconds=_HEARTBEAT,
            shutdown_timeout_seconds=_WRITING,
        )
    except ValueError as error:  # neither given nor found
        raise InputError(
            "--distributed: no coordinator is known; start hilbo with Slurm's srun or Open MPI's mpirun, or give each"
            " process --coordinator HOST:PORT, --processes COUNT and --process-id 0, 1, ..."
        ) from error
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"--distributed: the processes did not meet within {_MEETING} s ({reason}).") from error


def _leave(sentence: str, rank: int, count: int, code: int, wait: bool = True) -> None:
    """Print a message to stderr and end this process with the exit code `code`, without cleanup. `wait`: shut down in
    order with the other processes first."""
    try:
        print(f"hilbo: process {rank} of {count}: {sentence}", file=sys.stderr, flush=True)
        if wait:
            jax.distributed.shutdown()
    finally:
        os._exit(code)


def digest(*parts: PyTree) -> str:
    """SHA-256 (64 hex digits) of nested records, arrays, texts and numbers: their values and their structure."""
    hasher = hashlib.sha256()
    for leaf in jax.tree.leaves(parts):
        is_array = isinstance(leaf, jax.Array | np.ndarray)
        hasher.update(np.ascontiguousarray(leaf).tobytes() if is_array else repr(leaf).encode())
    hasher.update(repr(jax.tree.structure(parts)).encode())  # with the non-array fields of records
    return hasher.hexdigest()
