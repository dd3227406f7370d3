"""The low-level skill: environment, soft actor-critic, training (torchrl)."""
