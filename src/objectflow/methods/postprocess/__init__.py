"""Postprocessing of a network's output, one step per module; `pipeline` defines their order."""
