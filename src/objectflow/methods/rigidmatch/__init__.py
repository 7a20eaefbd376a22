"""The default method: the RigidMatch network with its decoding and postprocessing."""
