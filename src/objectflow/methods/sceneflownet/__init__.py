"""The paper's method: SceneFlowNet, grouping and averaged rigid motions."""
