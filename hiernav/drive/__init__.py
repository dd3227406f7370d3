"""What `deploy/run_loop.py` does: a robot, its loop, and the worlds or goals it drives to."""
