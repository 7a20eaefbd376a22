"""The paper's networks: SceneFlowNet-s, -c and -c-vl."""
