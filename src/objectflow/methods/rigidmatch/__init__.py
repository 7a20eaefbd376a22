"""The default method: the network RigidMatch and the steps around it."""
