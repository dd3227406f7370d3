"""Films of episodes: what a pair of policies does, seen from above and through MuJoCo's camera."""
