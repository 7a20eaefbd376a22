"""The paper's method: the SceneFlowNet network, grouping of pixels, and averaged rigid motions."""
