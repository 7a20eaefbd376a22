"""The networks as pure torch modules: no data set, no NumPy, and no files except weights."""

from objectflow.networks.sceneflownet.backbone import load_backbone
from objectflow.networks.sceneflownet.network import SceneFlowNet
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput, scene_flow
from objectflow.networks.sceneflownet.settings import NetworkSettings

__all__ = ["NetworkSettings", "SceneFlowNet", "SceneFlowNetOutput", "load_backbone", "scene_flow"]
