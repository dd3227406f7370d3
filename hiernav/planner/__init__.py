"""The waypoint generator: data set, network, training (torch)."""
