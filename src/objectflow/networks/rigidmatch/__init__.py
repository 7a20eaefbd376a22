"""`rigidmatch`: global matching, objects as a set, motions by solving. Pure torch modules, one step a file."""

from objectflow.networks.rigidmatch.network import RigidMatch
from objectflow.networks.rigidmatch.outputs import RigidMatchOutput
from objectflow.networks.rigidmatch.settings import RigidMatchSettings

__all__ = ["RigidMatch", "RigidMatchOutput", "RigidMatchSettings"]
