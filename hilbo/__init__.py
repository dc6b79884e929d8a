"""hilbo: human-in-the-loop Bayesian optimisation from ordinal answers.

Everything loads on first use, so that `import hilbo` costs nothing and the parts that need no JAX stay without it.
"""

from typing import TYPE_CHECKING

import lazy_loader

_names, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "acquisition",
        "aggregation",
        "analysis",
        "bcm",
        "config",
        "ep",
        "ep_corrected",
        "errors",
        "exact",
        "hardware_bridge",
        "hierarchical",
        "hyperparameters",
        "identification",
        "joint",
        "kernels",
        "laplace",
        "likelihoods",
        "ordinal_gp",
        "paper_tables",
        "passivity",
        "people",
        "plotting",
        "power",
        "preferences",
        "protocol",
        "report",
        "search_space",
        "session",
        "simulate",
        "statistics",
        "study",
        "validation",
        "validation_table",
        "viscoelastic",
    ],
    submod_attrs={
        "config": ["Study"],
        "errors": ["InputError"],
        "ordinal_gp": ["RBF", "OrdinalGP", "OrdinalProbit", "Posterior", "Trials", "fit"],
        "session": ["Session"],
    },
)

if TYPE_CHECKING:  # the same names for type checkers and editors; a test compares the two lists
    from hilbo import acquisition as acquisition
    from hilbo import aggregation as aggregation
    from hilbo import analysis as analysis
    from hilbo import bcm as bcm
    from hilbo import config as config
    from hilbo import ep as ep
    from hilbo import ep_corrected as ep_corrected
    from hilbo import errors as errors
    from hilbo import exact as exact
    from hilbo import hardware_bridge as hardware_bridge
    from hilbo import hierarchical as hierarchical
    from hilbo import hyperparameters as hyperparameters
    from hilbo import identification as identification
    from hilbo import joint as joint
    from hilbo import kernels as kernels
    from hilbo import laplace as laplace
    from hilbo import likelihoods as likelihoods
    from hilbo import ordinal_gp as ordinal_gp
    from hilbo import paper_tables as paper_tables
    from hilbo import passivity as passivity
    from hilbo import people as people
    from hilbo import plotting as plotting
    from hilbo import power as power
    from hilbo import preferences as preferences
    from hilbo import protocol as protocol
    from hilbo import report as report
    from hilbo import search_space as search_space
    from hilbo import session as session
    from hilbo import simulate as simulate
    from hilbo import statistics as statistics
    from hilbo import study as study
    from hilbo import validation as validation
    from hilbo import validation_table as validation_table
    from hilbo import viscoelastic as viscoelastic
    from hilbo.config import Study as Study
    from hilbo.errors import InputError as InputError
    from hilbo.ordinal_gp import RBF as RBF
    from hilbo.ordinal_gp import OrdinalGP as OrdinalGP
    from hilbo.ordinal_gp import OrdinalProbit as OrdinalProbit
    from hilbo.ordinal_gp import Posterior as Posterior
    from hilbo.ordinal_gp import Trials as Trials
    from hilbo.ordinal_gp import fit as fit
    from hilbo.session import Session as Session

    __version__: str


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import version  # slow to import, and rarely asked for

        return version("hilbo")
    return _names(name)
