"""The population artefact: members that play anywhere the library is installed.

`load_population(path)[m]` needs neither Ray, RLlib, Hydra nor MLflow.
"""

from popgen.population.manifest import Manifest, MemberInfo
from popgen.population.store import Population, PopulationWriter, check_compatible, load_population

__all__ = ["Manifest", "MemberInfo", "Population", "PopulationWriter", "check_compatible", "load_population"]
