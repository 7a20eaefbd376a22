"""The kinds of networks: by their name in files of weights, the class of each and that of its settings."""

from __future__ import annotations

from typing import NamedTuple

from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.sceneflownet.network import SceneFlowNet
from objectflow.networks.sceneflownet.settings import NetworkSettings

Network = SceneFlowNet | RigidMatch
Settings = NetworkSettings | RigidMatchSettings


class NetworkKind(NamedTuple):
    """A network's class, which is called with its settings, and the class of these settings."""

    network: type[SceneFlowNet] | type[RigidMatch]
    settings: type[NetworkSettings] | type[RigidMatchSettings]


KINDS: dict[str, NetworkKind] = {
    "sceneflownet": NetworkKind(SceneFlowNet, NetworkSettings),
    "rigidmatch": NetworkKind(RigidMatch, RigidMatchSettings),
}


def kind_of(settings: Settings) -> str:
    """The kind of the network that has these settings."""
    return next(name for name, kind in KINDS.items() if type(settings) is kind.settings)


def make_network(settings: Settings) -> Network:
    """A network with random weights."""
    network: Network = KINDS[kind_of(settings)].network(settings)  # type: ignore[arg-type]  # they belong together
    return network
