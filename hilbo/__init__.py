"""hilbo: human-in-the-loop Bayesian optimisation from ordinal responses.

Submodules are imported on first use, so that `import hilbo` is fast and parts that need no JAX do not import it.
"""

from typing import TYPE_CHECKING

import lazy_loader

_names, _, _every = lazy_loader.attach(
    __name__,
    submodules=[
        "acquisition",
        "app",
        "bcm",
        "cli",
        "device",
        "errors",
        "gaussian",
        "hardware_bridge",
        "hyperparameters",
        "identification",
        "inference",
        "kernels",
        "laplace",
        "likelihoods",
        "mechanics",
        "numerics",
        "ordinal_gp",
        "passivity",
        "population",
        "report",
        "search",
        "session",
        "simulation",
        "statistics",
        "study",
        "trials",
        "viscoelastic",
    ],
    submod_attrs={
        "errors": ["InputError"],
        "ordinal_gp": ["RBF", "OrdinalGP", "OrdinalProbit", "Posterior", "Trials", "fit"],
        "report.figures.on_axes": ["plot_map"],
        "session.choose.ask_tell": ["Session"],
        "study.analysis.prediction": ["aggregate", "best", "predict"],
        "study.cohort": ["read_trials"],
        "study.config": ["Study"],
    },
)

__all__ = [
    "RBF",
    "InputError",
    "OrdinalGP",
    "OrdinalProbit",
    "Posterior",
    "Session",
    "Study",
    "Trials",
    "aggregate",
    "best",
    "fit",
    "plot_map",
    "predict",
    "read_trials",
]
"""The objects of the package; its modules are attributes too, and are not imported by `from hilbo import *`."""

if TYPE_CHECKING:  # the same names for type checkers and editors; a test compares the two lists
    from hilbo import acquisition as acquisition
    from hilbo import app as app
    from hilbo import bcm as bcm
    from hilbo import cli as cli
    from hilbo import device as device
    from hilbo import errors as errors
    from hilbo import gaussian as gaussian
    from hilbo import hardware_bridge as hardware_bridge
    from hilbo import hyperparameters as hyperparameters
    from hilbo import identification as identification
    from hilbo import inference as inference
    from hilbo import kernels as kernels
    from hilbo import laplace as laplace
    from hilbo import likelihoods as likelihoods
    from hilbo import mechanics as mechanics
    from hilbo import numerics as numerics
    from hilbo import ordinal_gp as ordinal_gp
    from hilbo import passivity as passivity
    from hilbo import population as population
    from hilbo import report as report
    from hilbo import search as search
    from hilbo import session as session
    from hilbo import simulation as simulation
    from hilbo import statistics as statistics
    from hilbo import study as study
    from hilbo import trials as trials
    from hilbo import viscoelastic as viscoelastic
    from hilbo.errors import InputError as InputError
    from hilbo.ordinal_gp import RBF as RBF
    from hilbo.ordinal_gp import OrdinalGP as OrdinalGP
    from hilbo.ordinal_gp import OrdinalProbit as OrdinalProbit
    from hilbo.ordinal_gp import Posterior as Posterior
    from hilbo.ordinal_gp import Trials as Trials
    from hilbo.ordinal_gp import fit as fit
    from hilbo.report.figures.on_axes import plot_map as plot_map
    from hilbo.session.choose.ask_tell import Session as Session
    from hilbo.study.analysis.prediction import aggregate as aggregate
    from hilbo.study.analysis.prediction import best as best
    from hilbo.study.analysis.prediction import predict as predict
    from hilbo.study.cohort import read_trials as read_trials
    from hilbo.study.config import Study as Study

    __version__: str


def __dir__() -> list[str]:
    return sorted(_every)


def __getattr__(name: str):
    """Import a public name, or look up `__version__`, at its first use. Raises AttributeError for any other name."""
    if name == "__version__":
        from importlib.metadata import version  # slow to import, and rarely needed

        return version("hilbo")
    return _names(name)
