"""The steps between a network's output and the result; `pipeline` is their order."""
